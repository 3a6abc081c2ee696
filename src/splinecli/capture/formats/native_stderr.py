"""What C libraries print to file descriptor 2, caught while they decode."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_STDERR_LOCK = threading.Lock()


@contextmanager
def native_stderr() -> Iterator[list[str]]:
    """Catch what C libraries print to stderr; after the block, the list contains it.

    This replaces file descriptor 2, which belongs to the whole process. So one thread at a time may do it, and only
    around decoding. What other threads print meanwhile is lost, unless they print elsewhere: see stderr_is_apart.
    """
    messages: list[str] = []
    with _STDERR_LOCK, tempfile.TemporaryFile() as store:
        try:
            if sys.stderr is not None:
                sys.stderr.flush()
            original = os.dup(2)
        except (OSError, ValueError):  # there is no stderr to protect
            yield messages
            return
        try:
            os.dup2(store.fileno(), 2)
            yield messages
        finally:
            os.dup2(original, 2)
            os.close(original)
            store.seek(0)
            messages.append(store.read(1 << 16).decode(errors="replace"))


def stderr_is_apart() -> bool:
    """Return whether Python's stderr is not file descriptor 2, so that nothing is lost while native_stderr catches."""
    try:
        return sys.stderr is None or sys.stderr.fileno() != 2
    except (OSError, ValueError):  # a stream without a descriptor
        return True
