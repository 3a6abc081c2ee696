"""What lies at a path, where the system may also refuse to tell: names too long, loops of links, no permission."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from splinecli.errors import InputError

StrPath = str | os.PathLike[str]
"""A path in any form that the standard library takes."""


def find_mode(path: Path) -> int | None:
    """The mode (see stat) of what lies at the path, links followed; None for nothing.

    Raises:
        InputError: the system does not tell.
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None


def is_file(path: Path) -> bool:
    """Whether a file lies there, as far as the system tells."""
    return stat.S_ISREG(_mode_or_zero(path))


def is_folder(path: Path) -> bool:
    """Whether a folder lies there, as far as the system tells."""
    return stat.S_ISDIR(_mode_or_zero(path))


def resolve(path: Path) -> Path:
    """The path without links and "..". Raises InputError where the system does not tell."""
    try:
        return path.resolve()
    except RuntimeError:  # Python before 3.13, for a loop
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
