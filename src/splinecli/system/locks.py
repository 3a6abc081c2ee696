"""Locks of folders: one process at a time writes into a folder. A lock ends with its process, however that ends."""

import importlib
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from splinecli.errors import OutputError

LOCK = ".lock"  # the lock file in a folder that one process at a time may write into
_SECONDS_BETWEEN_TRIES = 0.02


class RefusedFolderError(OutputError):
    """One folder is refused. Others may be fine, so a batch goes on."""


class BusyError(RefusedFolderError):
    """Another process writes into the folder."""


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Make a folder and lock it.

    `wait` waits for another process that has locked the folder, instead of raising BusyError.

    Raises:
        BusyError: another process has locked the folder.
        RefusedFolderError: another user left a lock file, which this process may not open.
        OSError: the folder cannot be made or written.
    """
    file = _locked_file(folder, wait=wait)
    try:
        yield
    finally:
        # Windows removes no file that is open. Elsewhere, whoever locks the file after it is removed sees that.
        if os.name == "nt":
            file.close()
        with suppress(OSError):
            (folder / LOCK).unlink()
        file.close()


def _locked_file(folder: Path, *, wait: bool) -> IO[str]:
    """Return the open lock file of a folder, which is made as needed."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            file = _open_lock(folder / LOCK)
        except FileNotFoundError:  # another process removed the folder, because it was empty
            continue
        except PermissionError:
            if not (folder / LOCK).exists():
                raise
            raise RefusedFolderError(
                "this lock file belongs to another user, who may be writing into the folder",
                path=folder / LOCK,
                hint="If no splinecli process of that user runs, remove the file. Otherwise choose another -o",
            ) from None
        try:
            got = _try_lock(file)
        except OSError:  # some network drives have no locks
            return file
        if got and _is_current(file, folder / LOCK):
            return file
        file.close()
        if not got and not wait:
            raise BusyError(
                "another splinecli process is writing into this folder",
                path=folder,
                hint="Wait for it to end, or choose another -o",
            )
        if not got:
            time.sleep(_SECONDS_BETWEEN_TRIES)


def _open_lock(path: Path) -> IO[str]:
    """Open a lock file, which is made as needed. Raises OutputError where there is something else, such as a pipe."""
    # A pipe would wait for its other end without O_NONBLOCK. A link might lead anywhere.
    flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
    refused = RefusedFolderError("is not a file, so it cannot lock the folder", path=path, hint="Remove it")
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o666)
    except (FileNotFoundError, PermissionError):
        raise
    except OSError:
        if os.path.lexists(path):  # a link, a folder or a socket
            raise refused from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise refused
    return os.fdopen(descriptor, "r+")


def _try_lock(file: IO[str]) -> bool:
    """Lock an open file, unless another process has locked it. Raises OSError where there are no locks."""
    try:
        import fcntl
    except ImportError:
        windows: Any = importlib.import_module("msvcrt")
        try:
            windows.locking(file.fileno(), windows.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_current(file: IO[str], path: Path) -> bool:
    """Return whether an open file is still the one at the path: its last owner removes it, and others make it anew."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
