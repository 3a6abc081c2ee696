"""Write sets of output files to folders to which only one process at a time writes.

Each new file is written under a random hidden name and synced. When all are complete, the earlier
report is removed, then the earlier files. The new files are renamed to their places, and the new
report comes last. Therefore, a folder with a report is complete. A folder without a report is
unfinished, and its work is repeated. A later process never acts on instructions in a folder, and
never follows a link in it.
"""

import importlib
import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import OutputError
from splinecli.system import files
from splinecli.system.files import (
    UNFINISHED,
    check_writable,
    create_hidden,
    refusals_as_output_errors,
    sync,
)

LOCK = ".lock"  # the lock file in a folder to which only one process at a time may write


class BusyError(OutputError):
    """Another process is writing to the folder."""


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Create a folder and lock it. If it is locked, `wait` for the other process, or raise
    BusyError.

    Raises OutputError if a lock file of another user cannot be opened, or OSError if the folder
    cannot be created or written.
    """
    with locked_file(folder / LOCK, wait=wait):
        yield


@contextmanager
def locked_file(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Create a file and its folder, lock the file as `locked` does, and remove it at the end."""
    file = _locked_file(path, wait=wait)
    try:
        yield
    finally:
        # Windows cannot remove an open file. On other systems, a process that locks a removed file
        # detects this.
        if os.name == "nt":
            file.close()
        with suppress(OSError):
            path.unlink()
        file.close()


def _locked_file(path: Path, *, wait: bool) -> IO[str]:
    """Return an open and locked lock file, which is created if needed."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = _open_lock(path)
        except FileNotFoundError:  # another process removed the empty folder
            continue
        except PermissionError:
            if not path.exists():
                raise
            raise OutputError(
                "this lock file belongs to another user, who may be writing to the folder",
                path,
                hint="If no splinecli process of that user is running, remove the file. Otherwise,"
                " choose another -o",
            ) from None
        try:
            got = _try_lock(file)
        except OSError:  # some network drives have no locks
            return file
        # The last owner of a lock file removes it, so other processes create a new one.
        with suppress(FileNotFoundError):
            if got and os.path.samestat(path.stat(), os.fstat(file.fileno())):
                return file
        file.close()
        if not got and not wait:
            raise BusyError(
                "another splinecli process is writing to this folder",
                path.parent,
                hint="Wait until it has finished, or choose another -o",
            )
        if not got:
            time.sleep(0.02)


def _open_lock(path: Path) -> IO[str]:
    """Return an open lock file, which is created if needed.

    Raises OutputError if it is not a file but, for example, a pipe.
    """
    # Without O_NONBLOCK, a pipe would wait for its other end. A link might lead anywhere.
    flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
    refused = OutputError("the lock is not a file", path, hint="Remove it")
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
    """Lock an open file, and return whether it was free. Raises OSError if locks are not
    supported.
    """
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


Content = bytes | str | NDArray[Any]  # content of a file; see NewFiles.write
UNDONE = "unfinished files of an interrupted run were removed"


@contextmanager
def held_folder(
    folder: Path, warn: Callable[[str], object] = lambda _: None, *, wait: bool = False
) -> Iterator[None]:
    """Create and lock a folder, and remove unfinished files that killed processes left directly in
    it.

    If it was created here and is empty at the end, it is removed, including its parents. `warn` is
    called with a sentence about files of a killed process. If another process has locked the
    folder, BusyError is raised unless `wait` is set. Raises OutputError if the folder cannot be
    created or written.
    """
    check_writable(folder)
    with ExitStack() as stack:
        with refusals_as_output_errors(folder):
            made = stack.enter_context(files.made_folder(folder))
            stack.enter_context(locked(folder, wait=wait))
            files.sync_names(folder, *made)
            left = []
            for path in folder.glob(f".*{UNFINISHED}"):
                if not is_plain(path):
                    continue
                try:
                    with locked_file(path):
                        left.append(path)
                except BusyError:
                    pass  # the probe of another running batch
                except OutputError:  # a file of another user that can be removed but not opened
                    path.unlink()
                    left.append(path)
            if left:
                warn(f"{folder}: {UNDONE}")
        yield


class NewFiles:
    """New files of a folder, which have hidden names until all are complete; see new_files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.hidden: dict[str, Path] = {}

    @property
    def sizes(self) -> dict[str, int]:
        """The size of each complete file in bytes, by name."""
        return {name: path.stat().st_size for name, path in sorted(self.hidden.items())}

    def write(self, name: str, content: Content) -> None:
        """Write a new file. Its name may include a subfolder. Raises OutputError.

        An array is written as NPY, text as UTF-8 with escapes for invalid characters.
        """
        _check_place(self._folder / name, self._folder)
        with refusals_as_output_errors(self._folder / name):
            with create_hidden(self._folder) as file:
                self.hidden[name] = Path(file.name)
                if isinstance(content, np.ndarray):
                    np.save(file, content, allow_pickle=False)
                elif isinstance(content, bytes):
                    file.write(content)
                else:
                    file.write(content.encode(errors="backslashreplace"))
            sync(self.hidden[name])

    def publish(self, report: str | None, stale: Iterable[str]) -> None:
        """Remove the earlier files, and rename the new ones to their places, the report last.

        Raises OSError.
        """
        if report is not None:
            _remove(self._folder / report, self._folder)
            sync(self._folder)
        for name in (*self.hidden, *stale):
            _remove(self._folder / name, self._folder)
        for name in sorted(self.hidden, key=lambda name: name == report):
            place = self._folder / name
            if name == report:
                sync(self._folder)
            place.parent.mkdir(exist_ok=True)
            self.hidden[name].replace(place)
            if place.parent != self._folder:
                sync(place.parent)
        sync(self._folder)


@contextmanager
def new_files(folder: Path, *, report: str | None, stale: Iterable[str] = ()) -> Iterator[NewFiles]:
    """Yield a collector of new files, which replace the earlier ones after the block.

    The caller must hold the folder (see held_folder). If the block fails, the earlier files remain
    unchanged. If the process ends during the replacement, the folder has no report. Raises
    OutputError if a file cannot be written.

    Args:
        report: the file that describes the others, which is removed first and written last. None if
            the caller ensures that no report describes a file that changes.
        stale: earlier files, which are removed if they are not replaced.
    """
    new = NewFiles(folder)
    try:
        yield new
        with refusals_as_output_errors(folder):
            new.publish(report, stale)
    finally:
        for path in new.hidden.values():
            path.unlink(missing_ok=True)


def refuse_link(folder: Path) -> None:
    """Raise OutputError if a folder is a link, which may lead anywhere."""
    if folder.is_symlink():
        raise OutputError(
            "found a link, expected a folder", folder, hint="Remove it, or choose another -o"
        )


def is_plain(path: Path) -> bool:
    """Return whether the path is a file and not a link."""
    return path.is_file() and not path.is_symlink()


def _check_place(path: Path, folder: Path) -> None:
    """Raise OutputError if a file cannot be renamed to this path in a folder or its subfolders."""
    if path.is_dir() and not path.is_symlink():
        raise OutputError("found a folder, expected a file", path)
    if path.parent == folder:
        return
    refuse_link(path.parent)
    if path.parent.exists() and not path.parent.is_dir():
        raise OutputError("found a file, expected a folder", path.parent)


def _remove(path: Path, folder: Path) -> None:
    """Remove a file or a link, but not a folder.

    Raises OutputError as _check_place does, or OSError.
    """
    if path.parent != folder:
        refuse_link(path.parent)
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
