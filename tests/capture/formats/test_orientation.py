"""EXIF orientations: one for all images, or none at all."""

from pathlib import Path

import pytest
from PIL import Image, ImageFile

from splinecli.capture.formats.exif import UPRIGHT, common_orientation
from splinecli.capture.formats.facts import read_facts
from splinecli.errors import InputError


def write(folder: Path, name: str, orientation: int | None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("L", (4, 3), 90).save(folder / name, exif=exif)
    return folder / name


@pytest.mark.parametrize(("tag", "expected"), [(None, UPRIGHT), (1, UPRIGHT), (6, 6), (42, UPRIGHT)])
def test_one_orientation(tmp_path: Path, tag: int | None, expected: int) -> None:
    images = [write(tmp_path, "a.jpg", tag), write(tmp_path, "b.tif", tag), write(tmp_path, "c.png", tag)]
    assert common_orientation([read_facts(image) for image in images]) == expected


def test_the_pixels_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoding takes seconds for an image of 24 megapixels."""
    image = write(tmp_path, "c.png", 6)
    monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    assert common_orientation([read_facts(image)]) == 6


def test_different_orientations_are_refused(tmp_path: Path) -> None:
    images = [write(tmp_path, "a.jpg", None), write(tmp_path, "b.jpg", 1), write(tmp_path, "c.jpg", 8)]
    with pytest.raises(InputError, match=r"c\.jpg: found EXIF orientation 8, expected 1 as in a\.jpg"):
        common_orientation([read_facts(image) for image in images])
