"""Sets of output files, in folders that one process at a time writes into.

Each new file is written under a random hidden name and synced. When all are complete, the earlier
report is removed, then the earlier files, the new ones are renamed to their places, and the new
report comes last. So a folder with a report is complete. A folder without one is unfinished, and
its work is repeated. A later process never acts on instructions in a folder, and never follows a
link in it.
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

LOCK = ".lock"  # the lock file in a folder that one process at a time may write into


class BusyError(OutputError):
    """Another process writes into the folder."""


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Make a folder and lock it; `wait` for another process that has locked it, instead of raising
    BusyError.

    Raises OutputError if another user left a lock file that this process may not open, or OSError
    if the folder cannot be made or written.
    """
    with locked_file(folder / LOCK, wait=wait):
        yield


@contextmanager
def locked_file(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Make a file and its folder, lock the file as `locked` does, and remove it at the end."""
    file = _locked_file(path, wait=wait)
    try:
        yield
    finally:
        # Windows does not remove an open file. On other systems, a process that locks a removed
        # file detects this.
        if os.name == "nt":
            file.close()
        with suppress(OSError):
            path.unlink()
        file.close()


def _locked_file(path: Path, *, wait: bool) -> IO[str]:
    """Return a lock file, open and locked, which is created as needed."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = _open_lock(path)
        except FileNotFoundError:  # another process removed the folder, because it was empty
            continue
        except PermissionError:
            if not path.exists():
                raise
            raise OutputError(
                "this lock file belongs to another user, who may be writing into the folder",
                path,
                hint="If no splinecli process of that user runs, remove the file."
                " Otherwise choose another -o",
            ) from None
        try:
            got = _try_lock(file)
        except OSError:  # some network drives have no locks
            return file
        # The last owner of a lock file removes it, and others recreate it.
        with suppress(FileNotFoundError):
            if got and os.path.samestat(path.stat(), os.fstat(file.fileno())):
                return file
        file.close()
        if not got and not wait:
            raise BusyError(
                "another splinecli process is writing into this folder",
                path.parent,
                hint="Wait for it to end, or choose another -o",
            )
        if not got:
            time.sleep(0.02)


def _open_lock(path: Path) -> IO[str]:
    """Open a lock file, which is created as needed. Raises OutputError if it is not a file, but for
    example a pipe.
    """
    # A pipe would wait for its other end without O_NONBLOCK. A link might lead anywhere.
    flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0)
    refused = OutputError("is not a file, so it cannot lock the folder", path, hint="Remove it")
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
    """Lock an open file, unless another process has locked it. Raises OSError if locks are not
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


Content = bytes | str | NDArray[Any]  # of a file; see NewFiles.write
UNDONE = "an interrupted run left unfinished files, which are removed"


@contextmanager
def held_folder(
    folder: Path, warn: Callable[[str], object] = lambda _: None, *, wait: bool = False
) -> Iterator[None]:
    """Make a folder, lock it, and remove the unfinished files that killed processes left directly
    in it.

    A folder that was made here and is empty at the end is removed, as are its parents. `warn`
    receives a sentence about the files of a killed process. Raises BusyError if another process has
    locked the folder, unless it waits for that, or OutputError if the folder cannot be made or
    written.
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
                except OutputError:  # another user's, which may be removed but not opened
                    path.unlink()
                    left.append(path)
            if left:
                warn(f"{folder}: {UNDONE}")
        yield


class NewFiles:
    """New files of a folder that have hidden names until all are complete; see new_files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.hidden: dict[str, Path] = {}

    @property
    def sizes(self) -> dict[str, int]:
        """The bytes of each complete file by its name."""
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
    """Yield a collector of new files. After the block, they replace the earlier ones.

    The caller must hold the folder (see held_folder). If the block fails, the earlier files are
    kept unchanged. A process that ends during the replacement leaves a folder without a report.
    Raises OutputError if a file cannot be written.

    `report` names the file that describes the others: removed first, written last. It is None if
    the caller ensures that no report names a file that changes. `stale` names earlier files that
    are removed if no new file replaces them.
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
    """Raise OutputError if a folder is in fact a link, which may lead anywhere."""
    if folder.is_symlink():
        raise OutputError(
            "found a link, expected a folder", folder, hint="Remove it, or choose another -o"
        )


def is_plain(path: Path) -> bool:
    """Return whether the path is a file, and not a link to one."""
    return path.is_file() and not path.is_symlink()


def _check_place(path: Path, folder: Path) -> None:
    """Raise OutputError if no file can be renamed to a path in a folder or its subfolders."""
    if path.is_dir() and not path.is_symlink():
        raise OutputError("found a folder, expected a file", path)
    if path.parent == folder:
        return
    refuse_link(path.parent)
    if path.parent.exists() and not path.parent.is_dir():
        raise OutputError("found a file, expected a folder", path.parent)


def _remove(path: Path, folder: Path) -> None:
    """Remove a file or a link. A folder of that name is kept. Raises OutputError as _check_place
    does, or OSError.
    """
    if path.parent != folder:
        refuse_link(path.parent)
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
