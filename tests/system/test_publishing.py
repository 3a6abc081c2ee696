"""Sets of files replace earlier ones, whenever the process is killed and whatever somebody put into
the folder.

Single files appear complete or not at all. One process at a time holds a folder, on systems with
either kind of lock.
"""

import errno
import os
import sys
import types
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from kills import content, killed_at_every_step, missing_syncs, record_calls
from scenes import parametrize, put, refuses
from splinecli.errors import OutputError
from splinecli.system import files
from splinecli.system.files import UNFINISHED, parse_json, write_bytes, write_text
from splinecli.system.publishing import (
    LOCK,
    UNDONE,
    BusyError,
    held_folder,
    locked,
    locked_file,
    new_files,
)

REPORT = "report.json"
OLD = {REPORT: b"old", "a.txt": b"old a", "only old.txt": b"old", "pictures/1.png": b"old 1"}
NEW = {REPORT: b"new", "a.txt": b"new a", "only new.txt": b"new", "pictures/2.png": b"new 2"}
MINE = {"notes.txt": b"mine"}


def write(folder, contents):
    for name, value in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(value)


def publish(folder, contents=NEW):
    with held_folder(folder), new_files(folder, report=REPORT, stale=OLD) as new:
        for name, value in contents.items():
            new.write(name, value)


FULL = OSError(errno.ENOSPC, "No space left on device")


@parametrize("first", [True, False])
def test_a_folder_with_a_report_is_whole_after_a_kill_at_any_step(tmp_path, first):
    reports, old = [], MINE if first else OLD | MINE
    for folder in killed_at_every_step(tmp_path, lambda folder: write(folder, old), publish):
        found = []
        left = content(folder)
        with held_folder(folder, found.append):
            pass
        after = content(folder)
        assert (found == [f"{folder}: {UNDONE}"]) == any(name.endswith(UNFINISHED) for name in left)
        reports.append(after.get(REPORT))
        if REPORT in after:
            assert after in (old, NEW | MINE)
        else:  # files of one run only
            assert after.items() <= (OLD | MINE).items() or after.items() <= (NEW | MINE).items()
        publish(folder)
        assert content(folder) == NEW | MINE
    # The earlier report, then none, then the new one, whose place in the folder is all that is left
    # to sync.
    assert reports == sorted(
        reports, key=[MINE.get(REPORT) if first else b"old", None, b"new"].index
    )
    assert reports.count(None) > 5


def test_a_message_names_the_file_that_was_asked_for(tmp_path, monkeypatch):
    def save_half(file, *_, **__):
        file.write(b"half")
        raise FULL

    monkeypatch.setattr("splinecli.system.publishing.np.save", save_half)
    with pytest.raises(OutputError) as caught, new_files(tmp_path, report=REPORT) as new:
        new.write("b.txt", b"whole")
        new.write("pictures/1.png", np.zeros(3))
    assert caught.value.path == tmp_path / "pictures" / "1.png"
    assert not list(tmp_path.iterdir())


def test_ctrl_c_between_renames_leaves_no_report(tmp_path, monkeypatch):
    """At any rename, the last one included, it stays a KeyboardInterrupt, and no hidden file is
    left.
    """
    replace, calls = Path.replace, []

    def interrupt(path, target):
        calls.append(path)
        if len(calls) == last:
            raise KeyboardInterrupt
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", interrupt)
    for last in range(1, len(NEW) + 1):
        folder = tmp_path / str(last)
        write(folder, OLD)
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            publish(folder)
        assert REPORT not in content(folder)
        assert content(folder).items() <= NEW.items()


def test_a_folder_in_the_place_of_a_file(tmp_path):
    (tmp_path / "a.txt").mkdir()
    (tmp_path / "pictures").touch()
    with refuses(r"a\.txt: found a folder, expected a file", OutputError):
        publish(tmp_path)
    (tmp_path / "a.txt").rmdir()
    with refuses("pictures: found a file, expected a folder", OutputError):
        publish(tmp_path)
    assert content(tmp_path) == {"pictures": b""}


LINKS = {
    "link": lambda path, target: path.symlink_to(target),
    "dangling link": lambda path, target: path.symlink_to(target.with_name("new")),
    "loop": lambda path, _: path.symlink_to(path),
    "link to a folder": lambda path, target: path.symlink_to(target.parent),
    "hard link": lambda path, target: path.hardlink_to(target),
    "pipe": lambda path, _: os.mkfifo(path),
}


@parametrize("kind", LINKS)
@parametrize("name", [REPORT, "a.txt", "only old.txt", "pictures/1.png"])
def test_what_stands_in_a_file_s_place_is_replaced_and_not_followed(tmp_path, kind, name):
    folder, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write(elsewhere, {"precious": b"mine"})
    (folder / name).parent.mkdir(parents=True)
    LINKS[kind](folder / name, elsewhere / "precious")
    publish(folder)
    assert content(folder) == NEW
    assert content(elsewhere) == {"precious": b"mine"}
    assert not any(path.is_symlink() for path in folder.rglob("*"))


def test_a_link_in_the_place_of_a_subfolder_is_refused(tmp_path):
    folder, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    write(elsewhere, {"1.png": b"mine"})
    write(folder, {REPORT: b"old"})
    (folder / "pictures").symlink_to(elsewhere)
    for contents in (NEW, {REPORT: b"new"}):  # with a file to write there, or only one to remove
        with refuses("pictures: found a link, expected a folder", OutputError) as caught:
            publish(folder, contents)
        assert caught.value.exit_code == 5
    assert content(elsewhere) == {"1.png": b"mine"}


def test_a_folder_made_for_nothing_goes_again(tmp_path):
    (tmp_path / "old").mkdir()
    for name in ("new/deeper", "old"):
        with pytest.raises(ZeroDivisionError), held_folder(tmp_path / name):
            raise ZeroDivisionError
    assert names_in(tmp_path) == ["old"]


def test_what_a_killed_process_was_writing_goes(tmp_path):
    folder = tmp_path / "out"
    mine = MINE | {
        ".draft.unfinished/a": b"mine",
        ".b.unfinished": b"mine",
        f".mine{UNFINISHED}/a": b"mine",
    }
    write(folder, mine | {f".0123456789abcdef{UNFINISHED}": b"half"})
    write(tmp_path, {"elsewhere": b"mine"})
    link = folder / f".link{UNFINISHED}"
    link.symlink_to(tmp_path / "elsewhere")
    found = []
    with held_folder(folder, found.append):
        assert content(folder) == {LOCK: b"", **mine, link.name: b"mine"}
    assert found == [f"{folder}: {UNDONE}"]
    assert link.is_symlink()


def test_everything_is_on_the_disk_before_an_earlier_file_goes(tmp_path):
    """The order of syncs and of changes, as a power cut would see it."""
    folder = tmp_path / "new" / "out"
    publish(folder, OLD)
    calls = record_calls(lambda: publish(folder))
    assert not list(missing_syncs(calls, REPORT))
    without_syncs = [call for call in calls if call[0] != "sync"]
    assert len(list(missing_syncs(without_syncs, REPORT))) > len(NEW)


def test_the_names_of_new_folders_are_on_the_disk(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr("splinecli.system.files.sync", synced.append)
    files.write_bytes(tmp_path / "a" / "b" / "c.txt", b"")
    assert {tmp_path, tmp_path / "a", tmp_path / "a" / "b"} <= set(synced)
    synced.clear()
    with held_folder(tmp_path / "d" / "e"):
        assert {tmp_path, tmp_path / "d"} <= set(synced)


@pytest.fixture(params=["posix", "windows"])
def system(request, monkeypatch):
    """The locks of this system, or those of Windows as its documentation describes them."""
    fcntl = pytest.importorskip("fcntl", reason="this system has no such locks")
    if request.param == "windows":

        def locking(handle, mode, count):
            assert mode == 2
            assert count == 1
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise PermissionError(errno.EACCES, "Permission denied") from None

        windows = types.SimpleNamespace(locking=locking, LK_NBLCK=2)
        monkeypatch.setitem(sys.modules, "fcntl", None)
        monkeypatch.setitem(sys.modules, "msvcrt", windows)
    return str(request.param)


@pytest.mark.usefixtures("system")
def test_a_folder_is_held_by_one_at_a_time(tmp_path):
    with (
        locked(tmp_path / "run"),
        refuses("run: another splinecli process is writing to this folder", BusyError),
        locked(tmp_path / "run"),
    ):
        pytest.fail("two at once")
    with locked(tmp_path / "run"):
        pass
    assert not (tmp_path / "run" / LOCK).exists()


@pytest.mark.usefixtures("system")
def test_one_at_a_time_also_while_the_lock_file_is_removed(tmp_path):
    """Each process adds one to a number in a file: with two at once, some would be lost."""
    number, children = tmp_path / "number", []
    put(number, "0")
    for _ in range(3):
        child = os.fork()
        if child == 0:
            for _ in range(20):
                with locked(tmp_path, wait=True):
                    put(number, str(int(number.read_text()) + 1))
            os._exit(0)
        children.append(child)
    assert all(os.waitpid(child, 0)[1] == 0 for child in children)
    assert number.read_text() == "60"


def test_files_that_a_process_has_locked_are_not_left_ones(tmp_path):
    running, left = (tmp_path / f".{name}.splinecli-unfinished" for name in ("running", "left"))
    left.touch()
    warnings = []
    with locked_file(running):
        with held_folder(tmp_path, warnings.append):
            assert running.exists() and not left.exists()
        with held_folder(tmp_path, warnings.append):
            assert running.exists()
    assert len(warnings) == 1 and not any(tmp_path.iterdir())


def test_the_lock_file_of_another_user(tmp_path, monkeypatch):
    (tmp_path / LOCK).touch()
    monkeypatch.setattr(
        os, "open", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    )
    message = (
        r"\.lock: this lock file belongs to another user.*remove the file\. Otherwise, choose "
        r"another -o"
    )
    with refuses(message, OutputError), locked(tmp_path):
        pytest.fail("it has no lock")
    monkeypatch.undo()
    assert (tmp_path / LOCK).exists()


def names_in(folder):
    return [path.name for path in folder.iterdir()]


def test_a_new_file_in_folders_that_do_not_exist_yet(tmp_path):
    (tmp_path / "plain").touch()
    path = tmp_path / "a" / "b" / "out.txt"
    write_text(path, "déjà vu\n")
    assert path.read_bytes() == "déjà vu\n".encode()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert names_in(path.parent) == ["out.txt"]


def test_a_full_disk_and_ctrl_c_leave_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "out.bin"
    write_bytes(path, b"old")

    for failure, seen in (
        (OSError(28, "full"), OutputError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ):
        monkeypatch.setattr(Path, "replace", Mock(side_effect=failure))
        with pytest.raises(seen):
            write_bytes(path, b"new")
        assert path.read_bytes() == b"old"
        assert names_in(tmp_path) == ["out.bin"]


def test_folders_made_for_nothing_go_again(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "splinecli.system.files.sync", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with refuses("No space left", OutputError):
        write_bytes(tmp_path / "a" / "b" / "out.bin", b"content")
    assert names_in(tmp_path) == []


@parametrize("text", ["[" * 200_000, '{"a": ' + "9" * 400 + "}", "9" * 5000, "{", ""])
def test_json_that_cannot_be_used_is_a_value_error(text):
    with pytest.raises(ValueError):
        parse_json(text)


def test_equal_files_are_compared_with_one_of_each_group(tmp_path, monkeypatch):
    """All pairs of hundreds of copies would take half a minute."""
    paths = [tmp_path / str(number) for number in range(60)]
    for number, path in enumerate(paths):
        path.write_bytes(b"ab"[number % 2 : number % 2 + 1] + bytes(9999))
    paths[9].write_bytes(b"a")
    read = Mock(wraps=files.file_sha256)
    monkeypatch.setattr(files, "file_sha256", read)
    found = files.equal_files(paths)
    assert read.call_count == 59
    assert found == [(n % 2, n) for n in range(2, 60) if n != 9]
