"""Output files appear complete or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from splinecli.errors import OutputError
from splinecli.files import held_folder, write_bytes, write_text


def names_in(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_writes_into_folders_that_do_not_exist_yet(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b" / "out.txt", "déjà vu\n")
    assert (tmp_path / "a" / "b" / "out.txt").read_bytes() == "déjà vu\n".encode()
    assert names_in(tmp_path / "a" / "b") == ["out.txt"]


def test_replaces_an_older_file_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "out.bin"
    write_bytes(path, b"a longer content")
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert names_in(tmp_path) == ["out.bin"]


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    write_bytes(tmp_path / "written", b"")
    assert (tmp_path / "written").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_folder_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        write_bytes(tmp_path / "file" / "out.bin", b"content")
    assert caught.value.exit_code == 5
    assert caught.value.path == tmp_path / "file" / "out.bin"
    assert names_in(tmp_path) == ["file"]
    assert (tmp_path / "file").read_text() == "in the way"


def test_a_folder_in_the_file_s_place(tmp_path: Path) -> None:
    (tmp_path / "out.bin").mkdir()
    with pytest.raises(OutputError):
        write_bytes(tmp_path / "out.bin", b"content")
    assert names_in(tmp_path) == ["out.bin"]


def test_a_full_disk_and_ctrl_c_leave_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.bin"
    write_bytes(path, b"old")

    for failure, seen in ((OSError(28, "No space left on device"), OutputError), (KeyboardInterrupt(),) * 2):

        def fail(*_: object, failure: BaseException = failure) -> None:
            raise failure

        monkeypatch.setattr(Path, "replace", fail)
        with pytest.raises(seen if isinstance(seen, type) else type(seen)):
            write_bytes(path, b"new")
        assert path.read_bytes() == b"old"
        assert names_in(tmp_path) == ["out.bin"]


def test_a_folder_is_written_into_by_one_at_a_time(tmp_path: Path) -> None:
    pytest.importorskip("fcntl", reason="this system has no such locks")
    folder = tmp_path / "run"
    with held_folder(folder):
        with (
            pytest.raises(OutputError, match=r"run: another splinecli process is writing into this folder"),
            held_folder(folder),
        ):
            pytest.fail("two at once")
        (folder / "content").touch()
    with held_folder(folder):
        assert (folder / "content").exists()


def test_a_folder_made_for_nothing_goes_again(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "new"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    with pytest.raises(ZeroDivisionError), held_folder(tmp_path / "old"):
        raise ZeroDivisionError
    assert (tmp_path / "old").exists()
