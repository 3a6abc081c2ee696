"""One process at a time holds a folder, on systems with either kind of lock."""

import errno
import os
import sys
import types
from pathlib import Path
from unittest.mock import Mock

import pytest

from splinecli.errors import OutputError
from splinecli.system.publishing import LOCK, BusyError, locked


@pytest.fixture(params=["posix", "windows"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The locks of this system, or those of Windows as its documentation describes them."""
    fcntl = pytest.importorskip("fcntl", reason="this system has no such locks")
    if request.param == "windows":

        def locking(handle: int, mode: int, count: int) -> None:
            assert (mode, count) == (2, 1)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise PermissionError(errno.EACCES, "Permission denied") from None

        windows = types.SimpleNamespace(locking=locking, LK_NBLCK=2)
        monkeypatch.setitem(sys.modules, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", windows)
    return str(request.param)


@pytest.mark.usefixtures("system")
def test_a_folder_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    with (
        locked(tmp_path / "run"),
        pytest.raises(BusyError, match="run: another splinecli process is writing into this folder"),
        locked(tmp_path / "run"),
    ):
        pytest.fail("two at once")
    with locked(tmp_path / "run"):
        pass
    assert not (tmp_path / "run" / LOCK).exists()


@pytest.mark.usefixtures("system")
def test_one_at_a_time_also_while_the_lock_file_is_removed(tmp_path: Path) -> None:
    """Each process adds one to a number in a file: with two at once, some would be lost."""
    number, children = tmp_path / "number", []
    number.write_text("0")
    for _ in range(3):
        child = os.fork()
        if child == 0:
            for _ in range(20):
                with locked(tmp_path, wait=True):
                    number.write_text(str(int(number.read_text()) + 1))
            os._exit(0)
        children.append(child)
    assert all(os.waitpid(child, 0)[1] == 0 for child in children)
    assert number.read_text() == "60"


def test_the_lock_file_of_another_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / LOCK).touch()
    monkeypatch.setattr(os, "open", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied")))
    message = r"\.lock: this lock file belongs to another user.*remove the file\. Otherwise choose another -o"
    with pytest.raises(OutputError, match=message), locked(tmp_path):
        pytest.fail("it has no lock")
    monkeypatch.undo()
    assert (tmp_path / LOCK).exists()


def test_a_lock_file_that_nobody_holds(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()
    with locked(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()
