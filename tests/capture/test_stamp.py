"""Stamps change with every file of a capture, and only then."""

import os
from pathlib import Path

import numpy as np
import pytest

from capture.conftest import WriteImage
from scenes import write_capture
from splinecli.capture import RadiometricCalibration, open_capture
from splinecli.capture.files import digest

OTHERS = ("light_directions.txt", "light_intensities.txt", "mask.png", "normals_gt.npy", "ambient.png")


@pytest.fixture
def folder(tmp_path: Path, write_image: WriteImage) -> Path:
    """A capture with every kind of file."""
    write_image("vase/ambient.png", np.full((4, 5), 100, np.uint16))
    write_image("flat.png", np.full((4, 5), 60_000, np.uint16))
    images = np.full((3, 4, 5), 500, np.uint16) + 1000 * np.arange(3, dtype=np.uint16)[:, None, None]
    lights = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
    mask, normals = np.ones((4, 5), bool), np.tile(np.float32((0, 0, 1)), (4, 5, 1))
    return write_capture(
        tmp_path / "vase", images, lights, mask=mask, normals=normals, intensities=np.ones((3, 3)), names="{}.png"
    )


def stamp(folder: Path) -> str:
    flat = RadiometricCalibration(flat_field=(folder.parent / "flat.png",))
    return digest(open_capture(folder, radiometry=flat).stamp)


@pytest.mark.parametrize("name", ["1.png", "../flat.png"])
def test_images_are_stamped_by_their_time(folder: Path, name: str) -> None:
    before = stamp(folder)
    assert stamp(folder) == before
    os.utime(folder / name, ns=(1, 1))
    assert stamp(folder) != before


@pytest.mark.parametrize("name", OTHERS)
def test_other_files_are_stamped_by_their_content(folder: Path, name: str, write_image: WriteImage) -> None:
    before = stamp(folder)
    content = (folder / name).read_bytes()
    os.utime(folder / name, ns=(1, 1))
    assert stamp(folder) == before
    if name.endswith(".png"):
        write_image(f"vase/{name}", np.full((4, 5), 7, np.uint16))
    else:
        (folder / name).write_bytes(content + (b"# a comment\n" if name.endswith(".txt") else b" "))
    assert stamp(folder) != before


def test_pixel_sizes_are_stamped(folder: Path) -> None:
    (folder / "light_directions.txt").rename(folder / "light_positions.txt")
    stamps = set()
    for size in ("0.1", "0.2"):
        (folder / "pixel_size.txt").write_text(size)
        stamps.add(stamp(folder))
    assert len(stamps) == 2
