"""What EXIF tags say of the images: exposures and orientations, one of each for all, written by Pillow."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile
from PIL.TiffImagePlugin import IFDRational

from splinecli.capture import open_capture
from splinecli.capture.formats.facts import UPRIGHT, Exposure, common_orientation, find_exposure, read_header
from splinecli.errors import InputError

EXIF = 0x8769


def write(path: Path, seconds: tuple[int, int] | None = (1, 60), f_number: float = 8.0, iso: int = 100) -> Path:
    image = Image.fromarray(np.full((6, 8, 3), 90, np.uint8))
    tags = Image.Exif()
    tags[0x010F] = "Maker"  # without any tag of its own Pillow leaves all out
    if seconds is not None:
        tags.get_ifd(EXIF).update({0x829A: IFDRational(*seconds), 0x829D: f_number, 0x8827: iso})
    image.save(path, exif=tags)
    return path


def capture(folder: Path, *exposures: tuple[int, int] | None) -> Path:
    folder.mkdir(exist_ok=True)
    for number, seconds in enumerate(exposures):
        write(folder / f"{number}.jpg", seconds)
    (folder / "lights.txt").write_text("0 0 1\n0.5 0 1\n0 0.5 1\n")
    return folder


def test_reading(tmp_path: Path) -> None:
    for suffix in ("jpg", "png"):
        assert find_exposure(read_header(write(tmp_path / f"a.{suffix}"))) == Exposure(1 / 60, 8.0, 100)
        assert find_exposure(read_header(write(tmp_path / f"b.{suffix}", None))) is None


def test_mixed_exposures_are_divided_out(tmp_path: Path) -> None:
    folder = capture(tmp_path / "mixed", (1, 60), (1, 60), (1, 30))
    for options in ({}, {"intensities": "equal"}):  # equal lamps do not make equal exposures
        source = open_capture(folder, **options)
        # The third image got twice the light of the others; the mean is 4 / 3.
        np.testing.assert_allclose(source.light_intensities[:, 1], [0.75, 0.75, 1.5])
        assert (source.intensities_known, source.intensities_measured) == (bool(options), False)
        assert source.warnings[0].code == "exif_exposure"
        assert "from 1/60 s, f/8, ISO 100 to 1/30 s, f/8, ISO 100." in str(source.warnings[0])
    write(folder / "1.jpg", None)
    message = r"2\.jpg: found an exposure of 1/30 s, f/8, ISO 100, expected 1/60 s, f/8, ISO 100 as in 0\.jpg"
    with pytest.raises(InputError, match=message):
        open_capture(folder)
    # Intensities say how the images compare.
    (folder / "light_intensities.txt").write_text("1\n1\n2\n")
    assert open_capture(folder).n_lights == 3


def test_exposures_that_are_one(tmp_path: Path) -> None:
    open_capture(capture(tmp_path / "rounded", (1, 60), (10, 610), None))
    folder = capture(tmp_path / "balanced", (1, 60), (1, 60), (1, 60))
    write(folder / "1.jpg", (1, 120), iso=200)
    open_capture(folder)


def turned(folder: Path, name: str, orientation: int | None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("L", (4, 3), 90).save(folder / name, exif=exif)
    return folder / name


@pytest.mark.parametrize(("tag", "expected"), [(None, UPRIGHT), (1, UPRIGHT), (6, 6), (42, UPRIGHT)])
def test_one_orientation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tag: int | None, expected: int) -> None:
    """The pixels are not decoded, which takes seconds for 24 megapixels."""
    images = [turned(tmp_path, "a.jpg", tag), turned(tmp_path, "b.tif", tag), turned(tmp_path, "c.png", tag)]
    monkeypatch.setattr(ImageFile.ImageFile, "load", None)
    assert common_orientation([read_header(image) for image in images]) == expected


def test_different_orientations_are_refused(tmp_path: Path) -> None:
    images = [turned(tmp_path, "a.jpg", None), turned(tmp_path, "b.jpg", 1), turned(tmp_path, "c.jpg", 8)]
    with pytest.raises(InputError, match=r"c\.jpg: found EXIF orientation 8, expected 1 as in a\.jpg"):
        common_orientation([read_header(image) for image in images])
