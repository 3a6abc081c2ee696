"""Captures as people have them: names, formats and folders that are not the usual ones, and what is said of them.

The oracle is a matte sphere: whatever its files are called, the normals are those of its geometry.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import scenes
from splinecli.calibration.balls import find_ball_files
from splinecli.capture import CaptureSource, open_capture
from splinecli.inference import estimate_normals
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import make_estimator

SIZE = 32
LIGHTS = scenes.spiral_lights(12, 40)
NORMALS, DISC = scenes.sphere(SIZE, 0.6)
PICTURES = np.rint(np.moveaxis(scenes.shade(NORMALS, LIGHTS), -1, 0) * 50_000).astype(np.uint16)
MASK = DISC.astype(np.uint8) * 255

Change = Callable[[Path], Path | None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a capture without a mask."""
    return scenes.write_capture(tmp_path / "cat", PICTURES, LIGHTS)


def check(source: CaptureSource, mask: np.ndarray | None = DISC) -> list[str]:
    """Compare the normals with the geometry, and return the codes of the warnings."""
    capture = source.read()
    assert mask is None or (capture.mask == mask).all()
    normals = estimate_normals(capture, make_estimator("ls")).normal_map
    inside = capture.mask & DISC
    # 16-bit values, without shadows: least squares is exact to a few thousandths of a degree.
    assert angle_between_deg(normals[inside], NORMALS[inside]).max() < 0.1
    return [warning.code for warning in capture.warnings]


def picture(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image)


@pytest.mark.parametrize("name", ["cat_mask.png", "cat.mask.tif", "mask_1.png", "../cat_mask.png", "../cat.mask.bmp"])
def test_masks_by_name(folder: Path, name: str) -> None:
    picture(folder / name, MASK)
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert str(source.warnings[0]).startswith(f"{Path(name).name} is used as the mask, by its name.")


def test_two_masks_are_named_and_none_is_used(folder: Path) -> None:
    picture(folder / "mask_left.png", MASK)
    picture(folder / "mask_right.png", MASK)
    picture(folder / "mask_small.png", MASK[::2, ::2])
    source = open_capture(folder)
    assert check(source, np.ones_like(DISC)) == ["mask_choice"]
    expected = "mask_left.png, mask_right.png: none is used as the mask. Choose one with --mask FILE."
    assert str(source.warnings[0]) == expected
    assert check(open_capture(folder, mask=folder / "mask_left.png")) == ["images_left_out"]


def test_alpha_is_a_mask_if_there_is_no_other(folder: Path) -> None:
    for number, image in enumerate(PICTURES):
        picture(folder / f"{number:03}.png", np.dstack([image] * 3 + [MASK.astype(np.uint16) * 257]))
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert "The alpha channel of 000.png is used as the mask." in str(source.warnings[0])
    picture(folder / "mask.png", np.full_like(MASK, 255))
    assert check(open_capture(folder), np.ones_like(DISC)) == []


def test_ball_masks(folder: Path) -> None:
    (folder / "light_directions.txt").unlink()
    picture(folder / "chrome.mask.png", MASK)
    files = find_ball_files(folder)
    assert len(files.images) == 12 and files.mask == folder / "chrome.mask.png"


@pytest.mark.parametrize("listed", [False, True])
def test_images_in_a_folder_of_their_own(folder: Path, listed: bool) -> None:
    (folder / "images").mkdir()
    for path in folder.glob("*.png"):
        path.rename(folder / "images" / path.name)
    if listed:
        (folder / "filenames.txt").write_text("".join(f"{number:03}.png\n" for number in range(12)))
    picture(folder / "cat_mask.png", MASK)
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert source.files.name == "cat" and len(source.files.images) == 12


def test_bmp_ground_truth(folder: Path) -> None:
    picture(folder / "normals_gt.bmp", np.rint((NORMALS[..., ::-1] + 1) * 127.5).astype(np.uint8))
    truth = open_capture(folder, mask=None).read().ground_truth
    assert truth is not None and angle_between_deg(truth[DISC], NORMALS[DISC]).max() < 1
