"""Decoders of files: what they raise for damaged ones, as errors that name the file, and what C libraries print."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splinecli.errors import InputError, SplinecliError
from splinecli.system.machine import is_out_of_memory

DAMAGED, COPY_AGAIN = "the image is damaged and cannot be read", "Copy or export it again"
"""Problem and hint for a damaged image."""


@contextmanager
def damage_as_input_error(path: Path, problem: str, hint: str | None = None) -> Iterator[None]:
    """Turn whatever a reader raises for a damaged file, one of a dozen types, into an InputError."""
    try:
        yield
    except SplinecliError:
        raise
    except PermissionError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise InputError(problem, path=path, hint=hint) from error


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
