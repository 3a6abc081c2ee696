"""Outputs appear whole or not at all."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from splinecli.errors import OutputError

LOCK = ".lock"
"""A file in a folder that one process at a time writes into."""


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file by renaming a finished temporary one beside it. Raises OutputError."""
    temporary: Path | None = None
    with refusals_as_output_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            temporary = Path(name)
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            temporary.chmod(0o666 & ~current_umask())
            temporary.replace(path)
        finally:
            # Also on Ctrl-C: nothing half-written stays behind.
            if temporary is not None:
                temporary.unlink(missing_ok=True)


@contextmanager
def refusals_as_output_errors(path: Path) -> Iterator[None]:
    """Raise OutputError, naming the path, where the system refuses what is done inside."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror or error})", path=path, hint="Choose another place with -o"
        ) from error


def check_writable(folder: Path) -> None:
    """Raise OutputError where `folder` is no folder, or could not be made or written into."""
    place = folder
    try:
        while not place.exists():
            place = place.parent
    except OSError as error:
        raise OutputError(f"cannot be a folder ({error.strerror})", path=folder) from error
    if not place.is_dir():
        raise OutputError(
            "is a file; the results need a folder", path=place, hint="Choose another place with -o"
        )
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError("may not be written into", path=place, hint="Choose another place with -o")


def check_free(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise OutputError where the folder holds one of the names and may not lose it, or could not be written into."""
    check_writable(folder)
    for name in () if overwrite else names:
        if (folder / name).exists():
            raise OutputError(
                f"holds {name} already", path=folder, hint="Add --overwrite, or choose another place with -o"
            )


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Make the folder and keep other processes of splinecli from writing into it. Raises OutputError.

    A folder that was made for what then failed, and is still empty, goes again.
    """
    made = not folder.exists()
    with refusals_as_output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("a")
    try:
        _lock(lock, folder)
        yield
    except BaseException:
        if made and [path.name for path in folder.iterdir()] == [LOCK]:
            (folder / LOCK).unlink()
            folder.rmdir()
        raise
    finally:
        # Otherwise the file stays: without it two processes could hold locks on two files of one name.
        lock.close()


def _lock(file: IO[str], folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise OutputError(
            "another splinecli is writing into it", path=folder, hint="Wait for it, or choose another -o"
        ) from error


def write_text(path: Path, content: str) -> None:
    """write_bytes of UTF-8 text; what of a file's name is no text comes as escapes."""
    write_bytes(path, content.encode(errors="backslashreplace"))


def current_umask() -> int:
    """The permissions that new files of this process do not get."""
    current = os.umask(0)
    os.umask(current)
    return current
