"""Masks and values that are probably wrong, from the files to the warnings of `infer` and `info`."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes import shade, sphere, spiral_lights, write_capture

LIGHTS = spiral_lights(10, 55, 12)


def ball(*, background: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Images (F, H, W) from 0 to 1 of a ball before a plane of this brightness, and its mask."""
    normals, mask = sphere(80)
    normals, mask = (np.pad(array, ((16, 16), (16, 16), *((0, 0),) * (array.ndim - 2))) for array in (normals, mask))
    plane = background * np.random.default_rng(1).uniform(0.6, 1, mask.shape)[..., None] * LIGHTS[:, 2]
    images = np.where(mask[..., None], 0.7 * shade(normals, LIGHTS, noise=0.002), plane)
    return np.moveaxis(images, 2, 0), mask


def stored(images: np.ndarray, full_scale: int = 65_535) -> np.ndarray:
    return np.rint(images * full_scale).astype(np.uint16)


def codes(run, *command: object) -> list[str]:
    result = run("info", *command, "--json")
    assert result.code == 0
    return json.loads(result.out)["warning_codes"]


@pytest.mark.parametrize("background", [0.0, 0.6])
def test_an_inverted_mask(run, background):
    images, mask = ball(background=background)
    right = write_capture(Path("right"), stored(images), LIGHTS, mask=mask)
    wrong = write_capture(Path("wrong"), stored(images), LIGHTS, mask=~mask)
    assert codes(run, right) == []
    found = codes(run, wrong)
    assert "mask_inverted" in found and "dark_images" not in found
    result = run("infer", wrong, "--method", "ls", "--strict")
    assert result.code == 3 and "mask.png excludes a bright area in the middle" in result.err


def test_a_mask_around_a_dark_hole_is_right(run):
    images, mask = ball(background=0.6)
    images[:, mask] *= 0.02
    assert "mask_inverted" not in codes(run, write_capture(Path("frame"), stored(images), LIGHTS, mask=~mask))


def test_twelve_bits_in_files_of_sixteen(run):
    images, mask = ball()
    folder = write_capture(Path("twelve"), stored(images, 4095), LIGHTS, mask=mask)
    result = run("info", folder, "--json")
    assert json.loads(result.out)["warning_codes"] == ["white_level"]
    assert "as from a camera of 12 bits in 16-bit files" in result.err and "--white-level 4095" in result.err
    assert codes(run, folder, "--white-level", 4095) == []


def test_dark_values_of_sixteen_bits_are_dark(run):
    """Shifted to fill 16 bits, as PNG asks for, values of 12 bits have a common divisor."""
    images, mask = ball()
    dark = stored(images / 40, 4095) * np.uint16(16)
    assert codes(run, write_capture(Path("dark"), dark, LIGHTS, mask=mask)) == ["dark_images"]


@pytest.mark.parametrize("others", [False, True])
def test_one_file_of_another_scale(run, others):
    images, mask = ball()
    values = stored(images, 4095 if others else 65_535)
    values[4] = stored(images[4], 65_535 if others else 4095)
    folder = write_capture(Path("mixed"), values, LIGHTS, mask=mask)
    assert "image_scale" in codes(run, folder)
    result = run("infer", folder, "--method", "ls", "--strict")
    assert result.code == 3 and "004.png is 16 times " + ("brighter" if others else "darker") in result.err
    picture = cv2.imread(str(folder / "004.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "004.png"), picture // 16 if others else picture * np.uint16(16))
    assert "image_scale" not in codes(run, folder)
