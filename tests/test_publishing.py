"""Sets of files replace earlier ones as a whole, whenever the process is killed."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from kills import content, killed_at
from splinecli.errors import OutputError
from splinecli.publishing import COMPLETE, DRAFT, FINISHED, LOCK, UNDONE, BusyError, held_folder, new_files

REPORT = "report.json"
OLD = {REPORT: b"old", "a.txt": b"old a", "only old.txt": b"old", "pictures/1.png": b"old 1"}
NEW = {REPORT: b"new", "a.txt": b"new a", "only new.txt": b"new", "pictures/2.png": b"new 2"}
MINE = {"notes.txt": b"mine"}


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, value in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(value)


def publish(folder: Path, files: dict[str, bytes] = NEW) -> None:
    with held_folder(folder), new_files(folder, report=REPORT, stale=OLD) as stage:
        write(stage, files)


def test_new_files_replace_earlier_ones_and_leave_others(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    publish(folder, OLD)
    assert content(folder) == OLD
    write(folder, MINE)
    publish(folder)
    assert content(folder) == NEW | MINE


@pytest.mark.parametrize("first", [True, False])
def test_a_kill_at_any_step_ends_in_old_or_new(tmp_path: Path, first: bool) -> None:
    ends, step = [], 0
    while True:
        folder = tmp_path / str(step)
        old = MINE if first else OLD | MINE
        write(folder, old)
        if not killed_at(step, lambda folder=folder: publish(folder)):
            break
        left = content(folder)
        if left.get(REPORT) == b"new":
            assert {
                name: left[name] for name in NEW
            } == NEW  # a report speaks the truth, also before the next start
        elif REPORT in left:
            assert {name: left[name] for name in old} == old
        found: list[str] = []
        with held_folder(folder, found.append):
            pass
        after = content(folder)
        assert after in (old, NEW | MINE), step
        if left != after and set(left) != {*after, LOCK}:
            assert found == [f"{folder}: {FINISHED if after == NEW | MINE else UNDONE}"]
        ends.append(after == old)
        step += 1
    # Up to the one rename that decides it, the old files stay; from then on, the new ones come.
    assert ends == sorted(ends, reverse=True)
    assert 5 < sum(ends) < len(ends) - 5


def test_a_failure_keeps_the_earlier_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(tmp_path, OLD)

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("splinecli.publishing.sync", fail)
    with pytest.raises(OutputError, match="No space left on device"):
        publish(tmp_path)
    assert content(tmp_path) == OLD


def test_ctrl_c_between_moves_finishes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(tmp_path, OLD)
    replace, calls = Path.replace, []

    def interrupt(path: Path, target: Path) -> Path:
        calls.append(path)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        publish(tmp_path)
    assert content(tmp_path) == NEW


def test_a_folder_in_the_place_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.txt").mkdir()
    (tmp_path / "pictures").touch()
    with pytest.raises(OutputError, match=r"a\.txt: found a folder, expected a file"):
        publish(tmp_path)
    (tmp_path / "a.txt").rmdir()
    with pytest.raises(OutputError, match="pictures: found a file, expected a folder"):
        publish(tmp_path)
    assert content(tmp_path) == {"pictures": b""}


@pytest.mark.parametrize("plan", ["{", "[]", '{"remove": ["../kept"], "report": "report.json"}'])
def test_a_hostile_plan_removes_nothing(tmp_path: Path, plan: str) -> None:
    write(tmp_path, {"kept": b"", f"out/{COMPLETE}/plan.json": plan.encode(), f"out/{COMPLETE}/files/a": b""})
    with pytest.raises(OutputError, match=r"plan\.json is damaged"), held_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "kept").exists()
    absolute = json.dumps({"remove": [str(tmp_path / "kept")], "report": REPORT})
    write(tmp_path, {f"out/{COMPLETE}/plan.json": absolute.encode()})
    with pytest.raises(OutputError, match=r"plan\.json is damaged"), held_folder(tmp_path / "out"):
        pass
    assert (tmp_path / "kept").exists()


def test_a_folder_is_written_into_by_one_at_a_time(tmp_path: Path) -> None:
    pytest.importorskip("fcntl", reason="this system has no such locks")
    folder = tmp_path / "run"
    with held_folder(folder):
        with (
            pytest.raises(BusyError, match=r"run: another splinecli process is writing into this folder"),
            held_folder(folder),
        ):
            pytest.fail("two at once")
        (folder / "content").touch()
    with held_folder(folder):
        assert (folder / "content").exists()
    assert content(folder) == {"content": b""}


def test_one_at_a_time_also_while_the_lock_file_is_removed(tmp_path: Path) -> None:
    """Each process adds one to a number in a file: with two at once, some would be lost."""
    number, children = tmp_path / "number", []
    number.write_text("0")
    for _ in range(4):
        child = os.fork()
        if child == 0:
            for _ in range(50):
                with held_folder(tmp_path, wait=True):
                    number.write_text(str(int(number.read_text()) + 1))
            os._exit(0)
        children.append(child)
    assert all(os.waitpid(child, 0)[1] == 0 for child in children)
    assert number.read_text() == "200"


def test_a_folder_made_for_nothing_goes_again(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "new" / "deeper"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "old"):
        raise ZeroDivisionError
    assert (tmp_path / "old").exists()


def test_what_a_killed_process_was_writing_goes(tmp_path: Path) -> None:
    write(tmp_path, {f"{DRAFT}/files/a": b"", ".checkpoint.safetensors.x1.unfinished": b"half", **MINE})
    with held_folder(tmp_path):
        assert content(tmp_path) == {LOCK: b"", **MINE}
