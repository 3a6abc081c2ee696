"""BMP and TGA images, written by Pillow."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes import ring_lights, write_capture
from splinecli import capture_warnings
from splinecli.capture import read_capture
from splinecli.capture.formats.facts import read_header
from splinecli.capture.formats.images import decode_image
from splinecli.errors import InputError

RGB = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)


@pytest.mark.parametrize(("suffix", "options"), [(".bmp", {}), (".tga", {}), (".tga", {"compression": "tga_rle"})])
@pytest.mark.parametrize(("mode", "channels"), [("RGB", 3), ("L", 1), ("P", 3)])
def test_pixels(tmp_path: Path, suffix: str, options: dict[str, str], mode: str, channels: int) -> None:
    picture = Image.fromarray(RGB).convert(mode)
    picture.save(tmp_path / f"image{suffix}", **options)
    path = tmp_path / f"image{suffix}"
    expected = np.asarray(picture.convert("RGB" if mode == "P" else mode)).reshape(7, 5, channels)
    np.testing.assert_array_equal(decode_image(path), expected)
    facts = read_header(path)
    assert facts.size == ((7, 5, channels), 1) and facts.curve.curve == 1 and facts.white_level is None


@pytest.mark.parametrize("suffix", [".bmp", ".tga"])
def test_damage(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"image{suffix}"
    Image.fromarray(RGB).save(path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:10], b"BM" + bytes(40)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"damaged|found an image|empty"):
            decode_image(path)


def test_pictures_that_are_no_photographs_are_left_out(tmp_path: Path) -> None:
    pictures, lights = np.full((6, 4, 5), 100, np.uint8), ring_lights(6)
    folder = write_capture(tmp_path / "owl", pictures, lights, names="owl.{}.png")
    Image.fromarray(RGB).save(folder / "owl.mask.bmp")
    Image.fromarray(RGB).save(folder / "owl_normal.tga")
    capture = read_capture(folder)
    assert capture.n_lights == 6
    (found,) = [w for w in capture.warnings if w.kind == capture_warnings.IMAGES_LEFT_OUT]
    assert str(found).startswith("owl.mask.bmp and 1 more: left out")
    # If all of them have such names, these say nothing.
    assert read_capture(write_capture(tmp_path / "a", pictures, lights, names="mask_of_a_king_{}.png")).n_lights == 6


def test_a_picture_of_another_size_without_a_light_is_left_out(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "owl", np.full((6, 4, 5), 100, np.uint8), ring_lights(6))
    Image.fromarray(RGB[:2]).save(folder / "thumb.png")
    capture = read_capture(folder)
    assert (capture.n_lights, capture.mask.shape) == (6, (4, 5))
    (found,) = [w for w in capture.warnings if w.kind == capture_warnings.IMAGES_LEFT_OUT]
    assert str(found).startswith("thumb.png: left out, because light_directions.txt has no light for it")
    Image.fromarray(np.full((4, 5), 100, np.uint8)).save(folder / "006.png")
    with pytest.raises(InputError, match="found 6 light directions, expected 8"):
        read_capture(folder)
