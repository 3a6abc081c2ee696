"""Strengths of lights from a matte ball or card, by Lambert's law."""

import numpy as np
from numpy.testing import assert_allclose

from scenes import parametrize, refuses, to_uint16, vectors, write_capture, write_image
from splinecli.capture.linearise import RadiometricCalibration
from splinecli.lights.calibration.balls import find_ball_files
from splinecli.lights.calibration.circle import Circle
from splinecli.lights.calibration.lamps import measure_light_intensities

BALL = Circle(40.0, 42.0, 30.0)
INTENSITIES = vectors("1 0.8 0.6; 0.5 0.5 0.7; 1.3 1.2 1")
LIGHTS = np.array([(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, -0.48, np.sqrt(1 - 0.48**2))])


def write(folder, images, mask):
    return write_capture(folder, to_uint16(images * 65535), None, mask=mask, names="{}.png")


def ball_images():
    y, x = np.indices((84, 80)).astype(np.float64)
    normals = np.nan_to_num(BALL.normals(x, y))
    cosine = np.clip(np.einsum("hwi,fi->fhw", normals, LIGHTS), 0, None)
    return 0.5 * cosine[..., None] * INTENSITIES[:, None, None]


@parametrize("target", "card ball")
@parametrize("brightest", [1.25, 3.0])
def test_12_bit_values_in_16_bit_files(tmp_path, target, brightest, rng):
    """One lamp is clipped at 4095, for a share of the target or for all of a card, and no tag says
    so.
    """
    lights = np.tile((0.0, 0.0, 1.0), (4, 1))
    intensities = np.array((1.0, 1.0, 1.0, brightest))
    y, x = np.indices((84, 80)).astype(np.float64)
    cosine = np.nan_to_num(BALL.normals(x, y))[..., 2] if target == "ball" else 1 + (x - 40) / 400
    light = 0.78 * cosine * intensities[:, None, None] * rng.normal(1, 0.01, (4, 84, 80))
    mask = BALL.inside((84, 80)) if target == "ball" else None
    folder = write(
        tmp_path / "gray", np.rint(4095 * light.clip(0, 1))[..., None].repeat(3, 3) / 65535, mask
    )
    if (target, brightest) == ("card", 3.0):
        with refuses(r"3\.png: the target is dark or overexposed"):
            measure_light_intensities(find_ball_files(folder), lights, target)
        return
    found = measure_light_intensities(find_ball_files(folder), lights, target)
    # Only the rim of the ball is left under the brightest lamp, where half a pixel counts most.
    assert_allclose(found[:, 0] / found[0, 0], intensities, rtol=0.03)


def test_images_and_masks_of_another_size_and_a_ball_without_a_mask(tmp_path):
    folder = write(tmp_path / "card", np.full((3, 20, 30, 3), 0.5), None)
    with refuses("images of the gray ball need a mask"):
        measure_light_intensities(find_ball_files(folder), LIGHTS, "ball")
    write_image(folder / "1.png", np.full((20, 31), 30_000, np.uint16))
    with refuses(r"1\.png: found an image of 31 x 20 pixels, expected 30 x 20 as in 0\.png"):
        measure_light_intensities(find_ball_files(folder), LIGHTS, "card")
    write_image(folder / "1.png", np.full((20, 30), 30_000, np.uint16))
    write_image(folder / "mask.png", np.full((10, 30), 255, np.uint8))
    with refuses(r"mask\.png: found a mask of 30 x 10 pixels, expected 30 x 20 as in 0\.png"):
        measure_light_intensities(find_ball_files(folder), LIGHTS, "card")


@parametrize("exposure", [1.0, 1.7], ids=["whole", "partly saturated"])
def test_a_ball(tmp_path, exposure):
    images = (ball_images() * exposure).clip(0, 1)
    assert (images == 1).any() == (exposure > 1)
    folder = write(tmp_path / "gray", images, BALL.inside(images.shape[1:3]))
    found = measure_light_intensities(find_ball_files(folder), LIGHTS, "ball")
    assert_allclose(found, INTENSITIES / INTENSITIES.mean(), rtol=0.01)


@parametrize(("gamma", "ambient"), [(1.0, 0.0), (2.2, 0.0), (1.0, 0.1)])
def test_a_card(tmp_path, gamma, ambient):
    images = np.ones((3, 20, 30, 1)) * 0.4 * (LIGHTS[:, 2, None] * INTENSITIES)[:, None, None]
    folder = write(tmp_path / "card", (images + ambient) ** (1 / gamma), None)
    if ambient:
        stored = np.full((20, 30, 3), round(ambient * 65535), np.uint16)
        write_image(folder / "ambient.png", stored)
    radiometry = RadiometricCalibration(gamma)
    found = measure_light_intensities(
        find_ball_files(folder), LIGHTS, "card", radiometry=radiometry
    )
    assert_allclose(found, INTENSITIES / INTENSITIES.mean(), rtol=1e-3)
