"""Let a command finish its work after the reader of its output has left, as `| head -1` does."""

from __future__ import annotations

import os
from typing import Any, TextIO


class UntilClosed:
    """A text stream that drops all output once its pipe is closed.

    With a plain stream, the next line that a command prints would raise an error and end the command's work.

    Args:
        stream: the stream to write to. All other attributes are this stream's.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text and return its length."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._mute()
            return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._mute()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _mute(self) -> None:
        """Send the stream to the null device, with what its buffer still has."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)
