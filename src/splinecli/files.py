"""Output files that appear complete or not at all, and checks of output folders."""

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
"""The lock file in a folder that only one process at a time may write into."""


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that it appears complete or not at all.

    The content goes to a temporary file in the same folder, which is then renamed. Folders are made as needed.

    Raises:
        OutputError: the file cannot be written.
    """
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
            # This also runs on Ctrl-C, so no partial file is left.
            if temporary is not None:
                temporary.unlink(missing_ok=True)


@contextmanager
def refusals_as_output_errors(path: Path) -> Iterator[None]:
    """Turn an OSError inside the context into an OutputError that names the path."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror or error})", path=path, hint="Choose another place with -o"
        ) from error


def check_writable(folder: Path) -> None:
    """Check that a folder exists or can be made, and that files can be written into it.

    Raises:
        OutputError: the path is a file, or permissions do not allow it.
    """
    place = folder
    try:
        while not place.exists():
            place = place.parent
    except OSError as error:
        raise OutputError(f"cannot be a folder ({error.strerror})", path=folder) from error
    if not place.is_dir():
        raise OutputError(
            "found a file, expected a folder for the results", path=place, hint="Choose another place with -o"
        )
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError(
            "no permission to write into this folder", path=place, hint="Choose another place with -o"
        )


def check_free(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Check that a folder can be written into and has none of the named files, unless they may be replaced.

    Raises:
        OutputError: one of the files exists and `overwrite` is False, or check_writable fails.
    """
    check_writable(folder)
    for name in () if overwrite else names:
        if (folder / name).exists():
            raise OutputError(
                f"{name} already exists in this folder",
                path=folder,
                hint="Add --overwrite, or choose another place with -o",
            )


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Make a folder and lock it, so that no other process of splinecli writes into it.

    If the context fails, a folder that was made here and is still empty is removed.

    Raises:
        OutputError: the folder cannot be made, or another process has locked it.
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
        # The lock file stays. If it were removed, two processes could lock two files of the same name.
        lock.close()


def _lock(file: IO[str], folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # this system has no such locks
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise OutputError(
            "another splinecli process is writing into this folder",
            path=folder,
            hint="Wait for it to end, or choose another -o",
        ) from error


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text as write_bytes does. Characters of file names that are not valid text become escapes."""
    write_bytes(path, content.encode(errors="backslashreplace"))


def current_umask() -> int:
    """Return the file mode creation mask of this process."""
    current = os.umask(0)
    os.umask(current)
    return current
