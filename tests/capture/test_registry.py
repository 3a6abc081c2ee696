"""Which files of a folder are taken for what; stamps change with every file of a capture, and only
then.
"""

import os

import numpy as np
import pytest

from scenes import parametrize, put, refuses, vectors, write_capture
from splinecli.capture import (
    CaptureOptions,
    Overrides,
    RadiometricCalibration,
    find_capture_files,
    find_captures,
    open_capture,
)
from splinecli.capture.files import digest


def fill(folder, names):
    """Make empty files of these names."""
    for name in names.split():
        put(folder / name)
    return folder


def test_plain_folder_in_natural_order(tmp_path):
    folder = fill(
        tmp_path / "vase",
        "img10.png img2.PNG img1.png Img3.tif img04.jpeg notes.txt ._img1.png img5.exr"
        " sub/img6.png lights.txt light_intensities.txt Mask.png normals_gt.npy normal_gt.png"
        " normals.png error_map.png",
    )
    files = find_capture_files(folder)
    assert [path.name for path in files.images] == [
        "img1.png",
        "img2.PNG",
        "Img3.tif",
        "img04.jpeg",
        "img10.png",
    ]
    assert files.name == "vase"
    assert files.folder == folder
    assert files.light_directions == folder / "lights.txt"
    assert files.light_intensities == folder / "light_intensities.txt"
    assert files.mask == folder / "Mask.png"
    assert files.ground_truth == folder / "normals_gt.npy"


def test_diligent_and_the_order_of_filenames_txt(tmp_path):
    fill(
        tmp_path,
        "001.png 002.png 003.png light_directions.txt light_intensities.txt mask.png normal.txt",
    )
    (tmp_path / "filenames.txt").write_text("002.png\r\n\r\n001.png\r\n", encoding="utf-8-sig")
    files = find_capture_files(tmp_path)
    assert files.images == (tmp_path / "002.png", tmp_path / "001.png")
    assert files.mask == tmp_path / "mask.png"
    assert files.ground_truth == tmp_path / "normal.txt"
    fill(tmp_path, "Normal_gt.mat")
    assert find_capture_files(tmp_path).ground_truth == tmp_path / "Normal_gt.mat"


def test_overrides_go_first_and_are_no_photographs(tmp_path):
    folder = fill(
        tmp_path / "vase", "a.png b.png outline.png gt.tif lights.txt mask.png normal_gt.npy"
    )
    fill(tmp_path, "other.txt brightness.txt")
    given = {"lights": tmp_path / "other.txt", "intensities": tmp_path / "brightness.txt"}
    given |= {"mask": folder / "outline.png", "ground_truth": folder / "gt.tif"}
    files = find_capture_files(folder, Overrides(**given))
    assert [path.name for path in files.images] == ["a.png", "b.png"]
    found = (files.light_directions, files.light_intensities, files.mask, files.ground_truth)
    assert found == tuple(given.values())


def test_folders_that_are_no_capture(tmp_path):
    fill(tmp_path, "file empty/notes.txt dark/a.png dark/b.png")
    fill(tmp_path / "dataset", "b/a.png b/lights.txt a/a.png a/lights.txt")
    some = Overrides(lights=tmp_path / "file")
    for name, overrides, message in (
        ("nowhere", Overrides(), r"nowhere: the folder does not exist\."),
        ("file", Overrides(), r"found a file, expected a folder of images\."),
        (
            "empty",
            Overrides(),
            r"empty: the folder contains no images, but 1 \.txt file\. Images can be PNG, TIFF,",
        ),
        (
            "dataset",
            Overrides(),
            r"no images\. Pass one of the captures inside .*dataset, such as .*a\.",
        ),
        (
            "dark",
            Overrides(),
            r"found 2 images \(.*\) but no light file\. Normals require at least three photographs",
        ),
        (
            "dark",
            Overrides(lights=tmp_path / "file", mask=tmp_path / "none.png"),
            r"none\.png: the file does",
        ),
        ("dark", Overrides(lights=tmp_path), r"found a folder, expected a file\."),
    ):
        with refuses(message):
            find_capture_files(tmp_path / name, overrides)
    assert find_capture_files(tmp_path / "dark", some).light_directions == tmp_path / "file"


def test_wrong_filenames_txt(tmp_path):
    fill(tmp_path, "a.png lights.txt")
    for text, message in (
        (
            "a.png\n\nb.png\n",
            r':3: the image "b.png" does not exist\. Correct the name or remove the line\.',
        ),
        ("x" * 300, ':1: the image "x{300}" does not exist'),
        ("a.png\na.png\n", r':2: the image "a.png" is already listed on line 1\.'),
        ("\n\n", r": the list contains no images\."),
    ):
        put(tmp_path / "filenames.txt", text)
        with refuses(f"filenames.txt{message}"):
            find_capture_files(tmp_path)


def test_find_captures(tmp_path):
    fill(tmp_path / "set", "o10/a.png o10/lights.txt o2/a.png o2/light_directions.txt o3/a.png")
    fill(tmp_path / "set", "o4/lights.txt o5/lights.txt o5/filenames.txt readme.txt lights.txt")
    assert [path.name for path in find_captures(tmp_path / "set")] == ["o2", "o5", "o10"]
    assert find_captures(tmp_path / "set/o2") == [tmp_path / "set/o2"]


def test_find_captures_finds_none(tmp_path):
    fill(tmp_path, "set/o1/a.png set/o1/lights.txt empty/notes.txt")
    for name, message in (
        (
            ".",
            r"found no capture, expected folders .*Pass .*set instead, which contains captures\.",
        ),
        (
            "empty",
            r"empty: found no capture, expected folders of images with a light file \(.*\)\.$",
        ),
        ("nowhere", "the folder does not exist"),
    ):
        with refuses(message):
            find_captures(tmp_path / name)


def test_psbox(tmp_path):
    names = "Objects/b2.png Objects/b10.png LightProbe-1/ref.jpg light_directions.txt"
    folder = fill(tmp_path / "demo", names)
    files = find_capture_files(folder)
    assert files.images == (folder / "Objects/b2.png", folder / "Objects/b10.png")
    assert files.name == "demo"
    assert files.light_directions == folder / "light_directions.txt"
    assert files.mask is None
    assert files.ground_truth is None


def test_paths_that_the_system_refuses(tmp_path):
    folder = fill(tmp_path / "vase", "a.png lights.txt")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path, reason in (
        (tmp_path / ("x" * 300), "File name too long"),
        (loop, "Too many levels of symbolic links"),
    ):
        for call in (
            find_capture_files,
            find_captures,
            lambda p: find_capture_files(folder, Overrides(lights=p)),
        ):
            with refuses(rf"{path.name}: cannot be read \({reason}\)\.$"):
                call(path)
    (folder / "loop.png").symlink_to(folder / "loop.png")
    with refuses(r"loop\.png: cannot be read"):
        find_capture_files(folder)


OTHERS = (
    "light_directions.txt",
    "light_intensities.txt",
    "mask.png",
    "normals_gt.npy",
    "ambient.png",
)


@pytest.fixture
def folder(tmp_path, write_image):
    """A capture with every kind of file."""
    write_image("vase/ambient.png", np.full((4, 5), 100, np.uint16))
    write_image("flat.png", np.full((4, 5), 60_000, np.uint16))
    images = (
        np.full((3, 4, 5), 500, np.uint16) + 1000 * np.arange(3, dtype=np.uint16)[:, None, None]
    )
    lights = vectors("0 0 1; 0.6 0 0.8; 0 0.6 0.8")
    mask, normals = np.ones((4, 5), bool), np.tile(np.float32((0, 0, 1)), (4, 5, 1))
    return write_capture(
        tmp_path / "vase",
        images,
        lights,
        mask=mask,
        normals=normals,
        intensities=np.ones((3, 3)),
        names="{}.png",
    )


def stamp(folder):
    flat = RadiometricCalibration(flat_field=(folder.parent / "flat.png",))
    return digest(open_capture(folder, CaptureOptions(radiometry=flat)).stamp)


@parametrize("name", "1.png ../flat.png")
def test_images_are_stamped_by_their_time(folder, name):
    before = stamp(folder)
    assert stamp(folder) == before
    os.utime(folder / name, ns=(1, 1))
    assert stamp(folder) != before


@parametrize("name", OTHERS)
def test_other_files_are_stamped_by_their_content(folder, name, write_image):
    before = stamp(folder)
    content = (folder / name).read_bytes()
    os.utime(folder / name, ns=(1, 1))
    assert stamp(folder) == before
    if name.endswith(".png"):
        write_image(f"vase/{name}", np.full((4, 5), 7, np.uint16))
    else:
        (folder / name).write_bytes(content + (b"# a comment\n" if name.endswith(".txt") else b" "))
    assert stamp(folder) != before


def test_pixel_sizes_are_stamped(folder):
    (folder / "light_directions.txt").rename(folder / "light_positions.txt")
    stamps = set()
    for size in ("0.1", "0.2"):
        put(folder / "pixel_size.txt", size)
        stamps.add(stamp(folder))
    assert len(stamps) == 2
