"""Photographs stored in other ways than linear: all come back to the light that was there."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from scenes import (
    codes,
    parametrize,
    refuses,
    to_uint16,
    vectors,
    with_chunk,
    write_capture,
    write_image,
)
from splinecli.capture import CaptureOptions, RadiometricCalibration, open_capture
from splinecli.capture.formats.facts import read_header
from splinecli.capture.linearise import linear_light
from splinecli.recipe import prepare_capture, read_capture

LIGHTS = vectors("0 0 1; 0.5 0 1; 0 0.5 1; -0.5 0 1")


@pytest.fixture
def light():
    """What reached the camera: four images (4, 9, 11, 3)."""
    return default_rng(0).uniform(0.05, 0.6, (4, 9, 11, 3))


def store(folder, images):
    return write_capture(folder, to_uint16(images * 65535), LIGHTS, names="{}.png")


def write(path, image):
    return write_image(path, to_uint16(image * 65535)[..., ::-1])


def srgb(linear):
    """The published curve, IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def observed(folder, **settings):
    return prepare_capture(
        open_capture(folder, CaptureOptions(radiometry=RadiometricCalibration(**settings)))
    ).observations


def expected(light):
    return light.mean(axis=3).reshape(4, -1).T


def test_transfer_curves_are_undone(tmp_path, light):
    for name, stored, gamma in (
        ("linear", light, 1.0),
        ("srgb", srgb(light), None),
        ("gamma", light ** (1 / 2.2), 2.2),
    ):
        folder = store(tmp_path / name, stored)
        assert_allclose(observed(folder, curve=gamma), expected(light), atol=3e-5)
    assert np.abs(observed(tmp_path / "srgb") - expected(light)).max() > 0.1


@parametrize("found", [True, False], ids=["found", "named"])
@parametrize("gamma", [1.0, None])
def test_ambient_light_is_taken_off(tmp_path, light, gamma, found):
    ambient = default_rng(1).uniform(0, 0.3, light.shape[1:])
    encode = srgb if gamma is None else np.asarray
    folder = store(tmp_path / "capture", encode(light + ambient))
    path = write((folder if found else tmp_path) / "Ambient.png", encode(ambient))
    settings = {} if found else {"ambient": path}
    capture = prepare_capture(
        open_capture(folder, CaptureOptions(radiometry=RadiometricCalibration(gamma, **settings)))
    )
    assert_allclose(capture.observations, expected(light), atol=6e-5)
    assert ("ambient_subtracted" in codes(capture)) == found


@parametrize("one", [True, False], ids=["one for all", "one each"])
def test_falloff_is_divided_out(tmp_path, light, one):
    falloff = default_rng(2).uniform(0.5, 1.5, light.shape)
    falloff = np.broadcast_to(falloff[:1], light.shape) if one else falloff
    folder = store(tmp_path / "capture", light * falloff)
    flats = tuple(
        write(tmp_path / f"flat/{n}.png", 0.5 * falloff[n]) for n in range(1 if one else 4)
    )
    mean = falloff.mean(axis=(1, 2, 3), keepdims=True)
    assert_allclose(observed(folder, flat_field=flats), expected(light * mean), rtol=2e-4)


def test_some_pixels_are_as_among_all(tmp_path, light):
    """Under ambient light, with a flat field for all images and one for each."""
    rng = default_rng(3)
    folder, wanted = store(tmp_path / "capture", light), np.array([3, 40, 41, 98])
    ambient = write(tmp_path / "ambient.png", rng.uniform(0, 0.05, light.shape[1:]))
    flats = tuple(
        write(tmp_path / f"flat/{n}.png", rng.uniform(0.3, 0.6, light.shape[1:])) for n in range(4)
    )
    for flat_field in (flats, flats[:1]):
        source = open_capture(
            folder,
            CaptureOptions(
                radiometry=RadiometricCalibration(ambient=ambient, flat_field=flat_field)
            ),
        )
        every = list(
            source.read_pixels(np.ones((9, 11), np.bool_), range(4), lambda pixels: pixels)
        )
        some = source.read_pixels(
            np.ones((9, 11), np.bool_), range(4), lambda pixels: pixels, wanted=wanted
        )
        for whole, part in zip(every, some, strict=True):
            assert_array_equal(part.linear, whole.linear[wanted])
            assert_array_equal(part.values, whole.values)


def test_files_that_do_not_fit(tmp_path, light):
    folder = store(tmp_path / "capture", light)
    small, black = (
        write(tmp_path / "small.png", light[0, :5]),
        write(tmp_path / "black.png", 0 * light[0]),
    )
    for settings, message in (
        ({"ambient": small}, r"small\.png: found an image of 11 x 5 pixels, expected 11 x 9"),
        ({"flat_field": (small,)}, r"small\.png: found an image of 11 x 5 pixels, expected 11 x 9"),
        ({"flat_field": (small, small)}, "found 2 flat-field images, expected 1 or 4"),
        ({"flat_field": (black,)}, r"black\.png: the flat-field image is black"),
    ):
        with refuses(message):
            observed(folder, **settings)


def test_images_that_say_they_are_for_a_screen(tmp_path, light):
    png = write(tmp_path / "plain.png", light[0]).read_bytes()
    for name, content, encoded in (
        ("plain", png, False),
        ("srgb", with_chunk(png, b"sRGB", b"\0"), True),
        ("gamma", with_chunk(png, b"gAMA", (45_455).to_bytes(4, "big")), True),
        ("linear", with_chunk(png, b"gAMA", (100_000).to_bytes(4, "big")), False),
        ("jpeg", cv2.imencode(".jpg", np.zeros((9, 11, 3), np.uint8))[1].tobytes(), True),
        ("tiff", b"II*\0", False),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        assert (read_header(path).curve.curve is None) == encoded, name
    folder = store(tmp_path / "capture", light)
    assert "display_encoded" not in codes(read_capture(folder))
    (folder / "2.png").write_bytes(with_chunk((folder / "2.png").read_bytes(), b"sRGB", b"\0"))
    assert "display_encoded" in codes(read_capture(folder))
    srgb_source = open_capture(folder, CaptureOptions(radiometry=RadiometricCalibration(None)))
    assert "display_encoded" not in codes(srgb_source)
    mixed = observed(folder)
    for image in folder.glob("*.png"):
        image.write_bytes(with_chunk(image.read_bytes(), b"sRGB", b"\0"))
    assert_array_equal(observed(folder), mixed)  # it is asked to be linear
    capture = read_capture(folder)
    assert "display_decoded" in codes(capture) and "display_encoded" not in codes(capture)
    assert_array_equal(capture.observations, observed(folder, curve=None))
    assert (capture.observations < mixed).all()
    assert open_capture(folder).stamp != srgb_source.stamp


def test_linear_8_bit_values_lie_between_rounded_and_cut_ones():
    """The mean mistake is a quarter of a step in both cases. Black stays black; 16 bits and encoded
    values stay.
    """
    light = np.linspace(1, 254, 100_001) / 255
    rounded, cut = (
        linear_light(np.uint8(steps(255 * light)), Path("a.png")) for steps in (np.rint, np.floor)
    )
    assert (rounded - light).mean() * 255 == pytest.approx(0.25, abs=0.01)
    assert (cut - light).mean() * 255 == pytest.approx(-0.25, abs=0.01)
    zero_and_one = np.arange(2, dtype=np.uint8)
    assert_allclose(linear_light(zero_and_one, Path("a.png")) * 255, (0, 1.25), rtol=1e-6)
    assert_allclose(linear_light(zero_and_one, Path("a.jpg"), 2.2) * 255**2.2, (0, 1), rtol=1e-5)
    assert_allclose(
        linear_light(np.uint16(zero_and_one), Path("a.png")) * 65_535, (0, 1), rtol=1e-6
    )
