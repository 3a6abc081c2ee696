"""What is at a path. The system may refuse to answer: names that are too long, loops of links, no permission."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from splinecli.errors import InputError

StrPath = str | os.PathLike[str]
"""A path in any form that the standard library takes."""


def find_mode(path: Path) -> int | None:
    """Return the mode (see stat) of what is at the path, following links; None for nothing.

    Raises:
        InputError: the system refuses to answer.
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None


def is_file(path: Path) -> bool:
    """Return whether there is a file; False also if the system refuses to answer."""
    return stat.S_ISREG(_mode_or_zero(path))


def is_folder(path: Path) -> bool:
    """Return whether there is a folder; False also if the system refuses to answer."""
    return stat.S_ISDIR(_mode_or_zero(path))


def resolve(path: Path) -> Path:
    """Return the path without links and "..". Raises InputError where the system refuses to answer."""
    try:
        return path.resolve()
    except RuntimeError:  # for a loop of links, before Python 3.13
        raise _unreadable(path, os.strerror(errno.ELOOP)) from None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None


def _mode_or_zero(path: Path) -> int:
    try:
        return path.stat().st_mode
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return 0


def _unreadable(path: Path, reason: str | None) -> InputError:
    return InputError(f"cannot be read ({reason})", path=path)
