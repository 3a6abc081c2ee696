"""Output files appear complete or not at all."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from splinecli.errors import OutputError
from splinecli.system.files import parse_json, write_bytes, write_text


def names_in(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_a_new_file_in_folders_that_do_not_exist_yet(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    path = tmp_path / "a" / "b" / "out.txt"
    write_text(path, "déjà vu\n")
    assert path.read_bytes() == "déjà vu\n".encode()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert names_in(path.parent) == ["out.txt"]


def test_a_full_disk_and_ctrl_c_leave_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.bin"
    write_bytes(path, b"old")

    for failure, seen in ((OSError(28, "full"), OutputError), (KeyboardInterrupt(), KeyboardInterrupt)):
        monkeypatch.setattr(Path, "replace", Mock(side_effect=failure))
        with pytest.raises(seen):
            write_bytes(path, b"new")
        assert path.read_bytes() == b"old"
        assert names_in(tmp_path) == ["out.bin"]


def test_folders_made_for_nothing_go_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splinecli.system.files.sync", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OutputError, match="No space left"):
        write_bytes(tmp_path / "a" / "b" / "out.bin", b"content")
    assert names_in(tmp_path) == []


@pytest.mark.parametrize("text", ["[" * 200_000, '{"a": ' + "9" * 400 + "}", "9" * 5000, "{", ""])
def test_json_that_cannot_be_used_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError):
        parse_json(text)
