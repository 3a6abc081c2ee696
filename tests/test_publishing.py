"""Sets of files replace earlier ones as a whole, whenever the process is killed."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from kills import content, killed_at
from splinecli import files
from splinecli.capture.paths import check_file
from splinecli.errors import InputError, OutputError
from splinecli.files import COMPLETE, UNFINISHED
from splinecli.locks import LOCK
from splinecli.publishing import DRAFT, FINISHED, UNDONE, held_folder, new_files

REPORT = "report.json"
OLD = {REPORT: b"old", "a.txt": b"old a", "only old.txt": b"old", "pictures/1.png": b"old 1"}
NEW = {REPORT: b"new", "a.txt": b"new a", "only new.txt": b"new", "pictures/2.png": b"new 2"}
MINE = {"notes.txt": b"mine"}


def write(folder: Path, contents: dict[str, bytes]) -> None:
    for name, value in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(value)


def publish(folder: Path, contents: dict[str, bytes] = NEW) -> None:
    with held_folder(folder), new_files(folder, report=REPORT, stale=OLD) as stage:
        write(stage, contents)


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


def test_a_message_names_the_file_that_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def write_directly(stage: Path) -> None:
        write(stage, {"b.txt": b"whole", "pictures/1.png": b"half"})
        fail()

    def write_by_rename(stage: Path) -> None:
        monkeypatch.setattr("splinecli.files.sync", fail)
        files.write_bytes(stage / "pictures" / "1.png", b"half")

    for work in (write_directly, write_by_rename):
        with pytest.raises(OutputError) as caught, new_files(tmp_path, report=REPORT) as stage:
            work(stage)
        assert caught.value.path == tmp_path / "pictures" / "1.png"
        assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize(
    "plan",
    [
        "{",
        "[]",
        '{"remove": ["../kept"], "report": "report.json"}',
        '{"remove": ["a\\u0000"], "report": "report.json"}',
        '{"remove": [1], "report": "report.json"}',
        '{"remove": [], "report": ""}',
        '{"remove": [], "report": "."}',
    ],
)
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


def test_a_folder_made_for_nothing_goes_again(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "new" / "deeper"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "old"):
        raise ZeroDivisionError
    assert (tmp_path / "old").exists()


def test_what_a_killed_process_was_writing_goes(tmp_path: Path) -> None:
    ours = {f"{DRAFT}/files/a": b"", f".checkpoint.safetensors.x1{UNFINISHED}": b"half"}
    mine = MINE | {".draft.unfinished/a": b"mine", ".b.unfinished": b"mine", f".mine{UNFINISHED}/a": b"mine"}
    write(tmp_path, ours | mine)
    found: list[str] = []
    with held_folder(tmp_path, found.append):
        assert content(tmp_path) == {LOCK: b"", **mine}
    assert found == [f"{tmp_path}: {UNDONE}"]


def test_everything_is_on_the_disk_before_an_earlier_file_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order of syncs and of changes, as a power cut would see it."""
    folder = tmp_path / "new" / "out"
    publish(folder, OLD)
    events: list[tuple[str, str]] = []
    sync, rename, unlink, replace = files.sync, Path.rename, Path.unlink, Path.replace

    def record(kind: str, path: Path) -> None:
        events.append((kind, path.relative_to(tmp_path).as_posix()))

    def follow(kind: str, change: Callable[..., object]) -> Callable[..., object]:
        def changed(path: Path, *args: object, **options: object) -> object:
            record(kind, path)
            return change(path, *args, **options)

        return changed

    for module in ("files", "publishing"):
        monkeypatch.setattr(f"splinecli.{module}.sync", follow("sync", sync))
    for name, change in (("rename", rename), ("unlink", unlink), ("replace", replace)):
        monkeypatch.setattr(Path, name, follow(name, change))
    publish(folder)
    marked = next(place for place, (kind, _) in enumerate(events) if kind == "rename")
    draft = f"new/out/{DRAFT}"
    staged = {draft, f"{draft}/plan.json", f"{draft}/files", f"{draft}/files/pictures"}
    assert staged | {f"{draft}/files/{name}" for name in NEW} <= {path for _, path in events[:marked]}
    assert events[marked + 1] == ("sync", "new/out")
    last = max(place for place, (kind, _) in enumerate(events) if kind == "replace")
    assert {("sync", "new/out"), ("sync", "new/out/pictures")} <= set(events[last + 1 :]) | set(
        events[marked:last]
    )
    assert ("sync", "new/out") in events[last + 1 :]


def test_the_names_of_new_folders_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr("splinecli.files.sync", synced.append)
    files.write_bytes(tmp_path / "a" / "b" / "c.txt", b"")
    assert {tmp_path, tmp_path / "a", tmp_path / "a" / "b"} <= set(synced)
    synced.clear()
    with held_folder(tmp_path / "d" / "e"):
        assert {tmp_path, tmp_path / "d"} <= set(synced)


def test_no_reader_takes_a_file_from_an_unfinished_folder(tmp_path: Path) -> None:
    write(tmp_path, {"lights.txt": b"0 0 1", f"{COMPLETE}/files/report.json": b"{}"})
    with pytest.raises(
        InputError, match=r"lights\.txt: lies in a folder with new files of an interrupted run"
    ):
        check_file(tmp_path / "lights.txt", "a file")
