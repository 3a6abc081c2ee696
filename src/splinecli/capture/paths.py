"""What is at a path. The system may refuse to answer: names that are too long, loops of links, no permission."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splinecli.errors import InputError

_OPEN_FILES = ("/dev/fd/", "/proc/self/fd/", "/dev/stdin")

_KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}

StrPath = str | os.PathLike[str]  # a path in any form that the standard library takes


def find_mode(path: Path) -> int | None:
    """Return the mode (see stat) of what is at the path, following links; None for nothing. Raises InputError."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None
    except ValueError:
        raise _unreadable(path, "a zero byte in its name") from None


def check_file(path: Path, expected: str, *, pipe: bool = False) -> None:
    """Raise InputError unless there is a file. Anything else, such as a device, might never end or never begin.

    With `pipe`, the shell's process substitution `<(...)` may stand in its place, see is_substitution.
    """
    mode = find_mode(path)
    if mode is None:
        raise InputError("the file does not exist", path=path)
    if not (stat.S_ISREG(mode) or (pipe and is_substitution(path))):
        raise InputError(f"found {_KINDS.get(stat.S_IFMT(mode), 'a device')}, expected {expected}", path=path)


@contextmanager
def reading(path: Path, what: str = "file") -> Iterator[None]:
    """Turn an error of the system while a file is read into an InputError that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"the {what} cannot be read ({error.strerror})", path=path) from None


def is_found_file(path: Path) -> bool:
    """Return whether an entry of a folder, with the name of a file that is read, is a file; False for a folder.

    Raises InputError for anything else, such as a pipe or a broken link. To pass over it would hide that.
    """
    if is_folder(path):
        return False
    check_file(path, "a file")
    return True


def is_substitution(path: Path) -> bool:
    """Return whether the path is a pipe that the shell has opened for this process: `<(...)`, or standard input."""
    try:
        return str(path).startswith(_OPEN_FILES) and stat.S_ISFIFO(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Return whether there is a folder; False also if the system refuses to answer."""
    return os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises for a name that is too long


def resolve(path: Path) -> Path:
    """Return the path without links and "..". Raises InputError where the system refuses to answer."""
    try:
        return path.resolve()
    except RuntimeError:  # for a loop of links, before Python 3.13
        raise _unreadable(path, os.strerror(errno.ELOOP)) from None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None


def _unreadable(path: Path, reason: str | None) -> InputError:
    return InputError(f"cannot be read ({reason})", path=path)
