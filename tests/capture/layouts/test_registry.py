"""Which files of a folder are taken for what."""

from __future__ import annotations

from pathlib import Path

import pytest

from splinecli.capture import Overrides, find_capture_files, find_captures
from splinecli.errors import InputError


def fill(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def test_plain_folder_in_natural_order(tmp_path: Path) -> None:
    folder = fill(
        tmp_path / "vase",
        *(
            "img10.png",
            "img2.PNG",
            "img1.png",
            "Img3.tif",
            "img04.jpeg",
            "notes.txt",
            "._img1.png",
            "img5.exr",
        ),
        *(
            "lights.txt",
            "light_intensities.txt",
            "Mask.png",
            "normals_gt.npy",
            "normal_gt.png",
            "sub/img6.png",
        ),
        *("normals.png", "error_map.png"),
    )
    files = find_capture_files(folder)
    assert [path.name for path in files.images] == [
        "img1.png",
        "img2.PNG",
        "Img3.tif",
        "img04.jpeg",
        "img10.png",
    ]
    assert (files.name, files.folder) == ("vase", folder)
    assert files.light_directions == folder / "lights.txt"
    assert files.light_intensities == folder / "light_intensities.txt"
    assert files.mask == folder / "Mask.png"
    assert files.ground_truth == folder / "normals_gt.npy"


def test_plain_folder_in_the_order_of_filenames_txt(tmp_path: Path) -> None:
    fill(tmp_path, "a.png", "b.png", "c.png", "lights.txt")
    (tmp_path / "filenames.txt").write_text("c.png\r\n\r\na.png\r\n", encoding="utf-8-sig")
    assert [path.name for path in find_capture_files(tmp_path).images] == ["c.png", "a.png"]


def test_diligent(tmp_path: Path) -> None:
    fill(
        tmp_path,
        "001.png",
        "002.png",
        "light_directions.txt",
        "light_intensities.txt",
        "mask.png",
        "normal.txt",
    )
    (tmp_path / "filenames.txt").write_text("002.png\n001.png\n")
    files = find_capture_files(tmp_path)
    assert files.images == (tmp_path / "002.png", tmp_path / "001.png")
    assert files.mask == tmp_path / "mask.png"
    assert files.ground_truth == tmp_path / "normal.txt"
    fill(tmp_path, "Normal_gt.mat")
    assert find_capture_files(tmp_path).ground_truth == tmp_path / "Normal_gt.mat"


def test_overrides_go_first_and_are_no_photographs(tmp_path: Path) -> None:
    folder = fill(
        tmp_path / "vase",
        "a.png",
        "b.png",
        "outline.png",
        "gt.tif",
        "lights.txt",
        "mask.png",
        "normal_gt.npy",
    )
    other = fill(tmp_path, "other.txt", "brightness.txt")
    files = find_capture_files(
        folder,
        Overrides(
            lights=other / "other.txt",
            intensities=other / "brightness.txt",
            mask=folder / "outline.png",
            ground_truth=folder / "gt.tif",
        ),
    )
    assert [path.name for path in files.images] == ["a.png", "b.png"]
    assert files.light_directions == other / "other.txt"
    assert files.light_intensities == other / "brightness.txt"
    assert files.mask == folder / "outline.png"
    assert files.ground_truth == folder / "gt.tif"


def test_folders_that_are_no_capture(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: the folder does not exist\."):
        find_capture_files(tmp_path / "nowhere")
    fill(tmp_path, "file", "empty/notes.txt", "dark/a.png", "dark/b.png")
    with pytest.raises(InputError, match=r"found a file, expected a folder of images\."):
        find_capture_files(tmp_path / "file")
    with pytest.raises(InputError) as caught:
        find_capture_files(tmp_path / "empty")
    assert str(caught.value) == (
        f"{tmp_path / 'empty'}: the folder contains no images. PNG, TIFF, JPEG and RAW files count as images."
    )
    fill(tmp_path / "dataset", "b/a.png", "b/lights.txt", "a/a.png", "a/lights.txt")
    with pytest.raises(InputError) as caught:
        find_capture_files(tmp_path / "dataset")
    assert str(caught.value) == (
        f"{tmp_path / 'dataset'}: the folder contains no images."
        f" There are captures in {tmp_path / 'dataset'}, such as {tmp_path / 'dataset' / 'a'}: give these."
    )
    with pytest.raises(InputError) as caught:
        find_capture_files(tmp_path / "dark")
    assert str(caught.value) == (
        f"{tmp_path / 'dark'}: the folder contains 2 images but no light file"
        " (light_directions.txt, lights.txt, *.lp, lights.json or light_positions.txt)."
        " Pass --lights FILE, with one line x y z for each image."
        " 'splinecli calibrate' makes the file from images of a mirror ball."
    )
    assert (
        find_capture_files(tmp_path / "dark", Overrides(lights=tmp_path / "file")).light_directions
        == tmp_path / "file"
    )
    with pytest.raises(InputError, match=r"none\.png: the file does not exist\."):
        find_capture_files(tmp_path / "dark", Overrides(lights=tmp_path / "file", mask=tmp_path / "none.png"))
    with pytest.raises(InputError, match=r"found a folder, expected a file\."):
        find_capture_files(tmp_path / "dark", Overrides(lights=tmp_path))


@pytest.mark.parametrize("lights", ["lights.txt", "light_directions.txt"])
@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("a.png\n\nb.png\n", 3, 'the image "b.png" does not exist. Correct the name or remove the line.'),
        ("x" * 300, 1, f'the image "{"x" * 300}" does not exist. Correct the name or remove the line.'),
        ("a.png\na.png\n", 2, 'the image "a.png" is also on line 1.'),
        ("\n\n", None, "the list names no images."),
    ],
)
def test_wrong_filenames_txt(tmp_path: Path, lights: str, text: str, line: int | None, message: str) -> None:
    fill(tmp_path, "a.png", lights)
    path = tmp_path / "filenames.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        find_capture_files(tmp_path)
    assert str(caught.value) == (f"{path}: " if line is None else f"{path}:{line}: ") + message


def test_find_captures(tmp_path: Path) -> None:
    fill(tmp_path / "set", "o10/a.png", "o10/lights.txt", "o2/a.png", "o2/light_directions.txt", "o3/a.png")
    fill(tmp_path / "set", "o4/lights.txt", "o5/lights.txt", "o5/filenames.txt", "readme.txt", "lights.txt")
    assert [path.name for path in find_captures(tmp_path / "set")] == ["o2", "o5", "o10"]
    assert find_captures(tmp_path / "set/o2") == [tmp_path / "set/o2"]


def test_find_captures_finds_none(tmp_path: Path) -> None:
    fill(tmp_path, "set/o1/a.png", "set/o1/lights.txt", "empty/notes.txt")
    message = (
        "found no capture, expected folders of images with a light file"
        " (light_directions.txt, lights.txt, *.lp, lights.json or light_positions.txt)."
    )
    with pytest.raises(InputError) as caught:
        find_captures(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path}: {message} There are captures in {tmp_path / 'set'}: give that folder."
    )
    with pytest.raises(InputError) as caught:
        find_captures(tmp_path / "empty")
    assert str(caught.value) == f"{tmp_path / 'empty'}: {message}"
    with pytest.raises(InputError, match="the folder does not exist"):
        find_captures(tmp_path / "nowhere")


def test_psbox(tmp_path: Path) -> None:
    folder = fill(
        tmp_path / "demo", "Objects/b2.png", "Objects/b10.png", "LightProbe-1/ref.jpg", "light_directions.txt"
    )
    files = find_capture_files(folder)
    assert files.images == (folder / "Objects/b2.png", folder / "Objects/b10.png")
    assert (files.name, files.light_directions) == ("demo", folder / "light_directions.txt")
    assert (files.mask, files.ground_truth) == (None, None)


def test_paths_that_the_system_refuses(tmp_path: Path) -> None:
    folder = fill(tmp_path / "vase", "a.png", "lights.txt")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    long = tmp_path / ("x" * 300)
    reasons = {long: "File name too long", tmp_path / "loop": "Too many levels of symbolic links"}
    for path, reason in reasons.items():
        for call in (
            lambda path: find_capture_files(path),
            lambda path: find_captures(path),
            lambda path: find_capture_files(folder, Overrides(lights=path)),
            lambda path: find_capture_files(folder, Overrides(mask=path)),
        ):
            with pytest.raises(InputError) as caught:
                call(path)
            assert str(caught.value) == f"{path}: cannot be read ({reason})."
    loop = folder / "loop.png"
    loop.symlink_to(loop)
    with pytest.raises(InputError, match=r"loop\.png: cannot be read"):
        find_capture_files(folder)
