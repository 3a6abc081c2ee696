"""White levels and saturated observations, against analytic images; and the object, found by its
brightness.
"""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.random import default_rng
from numpy.testing import assert_array_equal

from scenes import (
    codes,
    parametrize,
    refuses,
    shade,
    sphere_cap,
    spiral_lights,
    to_uint16,
    with_chunk,
    write_capture,
)
from splinecli.capture.formats.images import decode_image, to_linear
from splinecli.capture.reader import CaptureOptions, open_capture
from splinecli.errors import InputError
from splinecli.images.mask import find_object
from splinecli.images.saturation import Saturation, find_saturated, look_at, restore_saturated
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.recipe import prepare_capture, read_capture
from splinecli.records.white_level import WhiteLevel

SIDE = 60
LIGHTS = spiral_lights(12, 50)
FULL_SCALE = WhiteLevel(65_535, "full scale")


def sphere(*, noise=0.01):
    """Images (F, H, W) of a matte sphere, which fills the picture, with a largest value of about 1;
    its normals.
    """
    normals, rng = sphere_cap(SIDE), default_rng(3)
    albedo = rng.uniform(0.6, 1, (SIDE, SIDE)) if noise else 1.0
    images = albedo * np.moveaxis(shade(normals, LIGHTS), 2, 0)
    return images * rng.normal(1, noise, images.shape), normals


def clip(images, level, exposure=2.0):
    return np.uint16(np.minimum(np.rint(images * exposure * level), level))


def find(images, *, given=None, stated=None):
    """The white level of images (F, H, W), and the number of their saturated observations."""
    found = tuple(
        look_at(image.reshape(-1, 1), Path("0.png"), given=given, stated=stated) for image in images
    )
    saturation = Saturation(images[0].size, found, given)
    number = 0 if saturation.flags is None else int(saturation.flags.sum())
    assert number == saturation.n_saturated.sum()
    return saturation.white_level, number


@parametrize("level", [4095, 1023, 16_383, 4095 << 4, 15_600, 3839])
@parametrize("exposure", [1.1, 2.0, 4.0])
def test_levels_below_full_scale_are_found(level, exposure):
    images = clip(sphere()[0], level, exposure)
    assert find(images) == (WhiteLevel(level, "images"), np.count_nonzero(images == level))


def test_the_file_s_full_scale_is_the_level_where_it_is_reached():
    images = clip(sphere()[0], 65_535)
    assert find(images) == (FULL_SCALE, np.count_nonzero(images == 65_535))
    eight_bit = np.uint8(clip(sphere()[0], 255))
    assert find(eight_bit) == (WhiteLevel(255, "full scale"), np.count_nonzero(eight_bit == 255))


def bright(scale):
    return np.uint16(np.rint(sphere()[0] * scale).clip(0))


def with_background(value, scale=20_000):
    images = bright(scale)
    images[:, :, :30] = value
    return images


def posterised(levels, step):
    return np.uint16(np.rint(sphere()[0] / sphere()[0].max() * (levels - 1)) * step)


def ring_over_a_plane():
    """Without noise: a flat patch that is equally bright under all lights of a ring, on a darker
    textured plane.
    """
    texture = default_rng(0).uniform(0.2, 0.99, (SIDE, SIDE))
    texture[10:40, 10:40] = 1
    return np.uint16(np.repeat(np.rint(texture * 30_000)[None], 12, axis=0))


def patches_of_a_cube():
    """Without noise: three faces, each of one value under each light, under two rings of lights."""
    images = np.zeros((12, SIDE, SIDE), np.uint16)
    for number in range(12):
        images[number, :30] = 40_000 if number < 6 else 30_000
        images[number, 30:, :30] = 5000 + 2000 * (number % 6)
        images[number, 30:, 30:] = 17_000 - 2000 * (number % 6)
    return images


def normalised_to_12_bits():
    """Each image scaled so that its brightest pixel is 4095."""
    images = sphere(noise=0)[0]
    return to_uint16(images / images.max(axis=(1, 2), keepdims=True) * 4095)


NOT_CLIPPED = {
    "12 bits, not clipped": bright(4000),
    "dark": bright(37),
    "dark, without noise": to_uint16(sphere(noise=0)[0] * 500),
    "each normalised": normalised_to_12_bits(),
    "black background": with_background(0),
    "flat bright background": with_background(25_000),
    "flat background at 4095": with_background(4095, 3000),
    "dark object before a brighter background": with_background(40, 30),
    "six values": posterised(6, 8000),
    "forty values": posterised(40, 1000),
    "8 bits in 16": posterised(200, 257),
    "flat patch under a ring of lights": ring_over_a_plane(),
    "constant patches": patches_of_a_cube(),
    "black": np.zeros((12, SIDE, SIDE), np.uint16),
    "constant": np.full((12, SIDE, SIDE), 4095, np.uint16),
}


@parametrize("name", NOT_CLIPPED)
def test_what_is_not_clipped_is_not_saturated(name):
    assert find(NOT_CLIPPED[name]) == (FULL_SCALE, 0)


def test_one_clipped_image_is_not_enough():
    images = bright(3000)
    images[0] = clip(sphere()[0], 4095)[0]
    assert find(images)[1] == 0
    images[5] = clip(sphere()[0], 4095)[5]
    assert find(images)[0] == WhiteLevel(4095, "images")


@parametrize("stored", [4095, 4095 << 4, 65_535])
def test_levels_that_the_files_state(stored):
    """A stated number of bits, whether or not the program shifted or scaled them to 16."""
    images = bright(100)
    images[3, 0, 0] = stored
    level, number = find(images, stated=4095)
    assert number == 1
    assert level == (WhiteLevel(stored, "file") if stored < 65_535 else FULL_SCALE)
    assert find(bright(100), stated=4095) == (WhiteLevel(4095, "file"), 0)


def test_a_given_level_is_used_as_it_is():
    images = clip(sphere()[0], 4095)
    assert find(images, given=4000) == (WhiteLevel(4000, "given"), np.count_nonzero(images >= 4000))
    assert find(images / 4095, given=1) == (
        WhiteLevel(1, "given"),
        np.count_nonzero(images == 4095),
    )
    assert find(images / 4095) == (None, 0)
    with refuses(r"0\.png: the white level is 4095, but 8-bit pixels end at 255\. Lower"):
        find(np.uint8(images), given=4095)


def ls_error_deg(folder, normals, **settings):
    capture = prepare_capture(open_capture(folder, CaptureOptions(**settings)))
    solution = np.linalg.lstsq(LIGHTS, np.float64(capture.observations.T), rcond=None)[0]
    return float(angle_between_deg(unit(solution.T), normals.reshape(-1, 3)).mean())


def test_12_bit_images_are_restored_like_16_bit_ones(tmp_path):
    images, normals = sphere()
    folder = write_capture(tmp_path / "vase", clip(images, 4095), LIGHTS)
    capture = prepare_capture(open_capture(folder))
    assert capture.white_level == WhiteLevel(4095, "images")
    assert {"white_level", "saturated"} <= set(codes(capture))
    stored = read_capture(folder, as_stored=True)
    assert stored.restored is None
    assert stored.white_level == capture.white_level
    assert (capture.observations > stored.observations)[~capture.restored].sum() == 0
    brighter = (capture.observations > stored.observations).any(axis=1)
    assert_array_equal(capture.restored.any(axis=1), brighter)
    found = ls_error_deg(folder, normals)
    full = ls_error_deg(write_capture(tmp_path / "full", clip(images, 65_535), LIGHTS), normals)
    assert found == pytest.approx(full, abs=0.02)
    assert found < 0.5 * ls_error_deg(folder, normals, white_level=65_535)
    assert ls_error_deg(folder, normals, white_level=4095) == found


@parametrize("bits, level", [((12,), 4095), ((16,), None), ((12, 12, 12), 4095), ((5, 6, 5), None)])
def test_png_states_its_bits(tmp_path, bits, level):
    images = bright(100)
    images[0, 0, 0] = 4095  # one pixel alone would not tell
    if len(bits) == 3:
        images = np.repeat(images[..., None], 3, axis=-1)
    folder = write_capture(tmp_path / "vase", images, LIGHTS)
    for path in folder.glob("*.png"):
        path.write_bytes(with_chunk(path.read_bytes(), b"sBIT", bytes(bits)))
    assert prepare_capture(open_capture(folder)).white_level == (
        WhiteLevel(level, "file") if level else FULL_SCALE
    )
    # not all of them
    (folder / "011.png").write_bytes(cv2.imencode(".png", images[11])[1].tobytes())
    assert prepare_capture(open_capture(folder)).white_level == FULL_SCALE


@parametrize(
    "tag, value, level",
    [(281, 4095, 4095), (281, 4001, None), (50717, 3839, 3839), (50717, 65_535, None)],
)
def test_tiff_states_its_level(tmp_path, tag, value, level):
    folder = tmp_path / "vase"
    folder.mkdir()
    for number, image in enumerate(bright(100)):
        tifffile.imwrite(folder / f"{number}.tif", image, extratags=[(tag, "H", 1, value, True)])
    np.savetxt(folder / "lights.txt", LIGHTS)
    assert prepare_capture(open_capture(folder)).white_level == (
        WhiteLevel(level, "file") if level else FULL_SCALE
    )


def write_12_bit_tiff(path, image):
    """A TIFF of 12 bits a sample, by its specification."""
    bits = "".join(f"{value:012b}" for value in image.ravel())
    data = int(bits, 2).to_bytes(len(bits) // 8, "big")
    tags = [
        (256, image.shape[1]),
        (257, image.shape[0]),
        (258, 12),
        (259, 1),
        (262, 1),
        (273, 8),
        (277, 1),
    ]
    tags += [(278, image.shape[0]), (279, len(data))]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    header, table = (
        b"II*\0" + struct.pack("<I", 8 + len(data)),
        struct.pack("<H", len(tags)) + entries + bytes(4),
    )
    path.write_bytes(header + data + table)


def test_tiff_of_12_bits_a_sample(tmp_path):
    images = clip(sphere()[0], 4095)
    for number, image in enumerate(images):
        write_12_bit_tiff(tmp_path / f"{number}.tif", image)
    np.savetxt(tmp_path / "lights.txt", LIGHTS)
    capture = prepare_capture(open_capture(tmp_path))
    assert capture.white_level.origin == "file"
    assert capture.restored is not None
    assert np.count_nonzero(capture.restored) <= np.count_nonzero(images == 4095)


GRID_LIGHTS = unit(np.array([(x, y, 1.4) for x in (-1, 0, 1) for y in (-1, 0, 1)], dtype=float))


def matte(pixels):
    """Observations (pixels, 9) of matte surfaces that look to the camera, of every albedo."""
    rng = default_rng(3)
    normals = rng.normal(size=(pixels, 3)) * (0.3, 0.3, 0.1) + (0, 0, 1)
    normals *= rng.uniform(0.3, 1, (pixels, 1)) / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.maximum(normals @ GRID_LIGHTS.T, 0)


def clipped_at(level):
    """500 matte pixels: true, which of their observations are saturated, and all as stored and as
    restored.
    """
    truth = matte(500)
    stored = np.float32(np.minimum(truth, level))
    restored = stored.copy()
    restore_saturated(restored, truth >= level, GRID_LIGHTS)
    return truth, truth >= level, stored, restored


def test_fewer_than_three_others_still_bound_them():
    truth, saturated, stored, restored = clipped_at(0.25)
    few = ((~saturated).sum(axis=1) > 0) & ((~saturated).sum(axis=1) < 3)
    assert few.sum() > 20
    assert np.isfinite(restored).all()
    assert np.abs(restored - truth)[few].mean() < 0.9 * np.abs(stored - truth)[few].mean()


@parametrize(
    "pixels, expected",
    [
        (np.array([[255, 3, 3], [254, 254, 254]], np.uint8), [True, False]),
        (np.array([[65_535], [255]], np.uint16), [True, False]),
        (np.array([[1.0], [1e9]], np.float32), [False, False]),
    ],
)
def test_full_scale_is_saturated(pixels, expected):
    assert find_saturated(pixels).tolist() == expected


WIDTH = 120


def disc(x, y, radius):
    rows, columns = np.mgrid[:WIDTH, :WIDTH]
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def test_the_largest_part_with_its_holes_filled(rng):
    thing, crumb, pupil = disc(50, 60, 30), disc(105, 15, 8), disc(45, 55, 6)
    brightness = np.where(thing, 0.4, 0.004) + np.where(crumb, 0.6, 0)
    brightness[pupil] = 0.003  # black paint
    brightness[10, 60] = 5.0  # a hot pixel
    brightness *= rng.uniform(0.8, 1.2, brightness.shape)
    found = find_object(np.float32(brightness))
    assert (found != thing).mean() < 0.005
    assert found[pupil].all()
    assert not found[crumb].any()
    with pytest.raises(InputError, match="several areas are bright"):
        wide = np.where(disc(100, 15, 14), 0.6, brightness)
        find_object(wide.astype(np.float32), is_requested=False)


@parametrize(
    "brightness, said",
    [(np.zeros((WIDTH, WIDTH)), "are black"), (np.full((WIDTH, WIDTH), 0.5), "covers 100.0 %")],
)
def test_nothing_stands_out(brightness, said):
    with refuses(said):
        find_object(np.float32(brightness))


@parametrize(
    "place",
    "DiLiGenT/pmsData/ballPNG DiLiGenT/pmsData/catPNG uw/gray uw/horse synth/L17/bowl_S",
)
def test_real_objects(shared_data, place):
    """Intersection over union with the masks that people drew."""
    source = open_capture(shared_data / place)
    images = [to_linear(decode_image(path), path).mean(axis=2) for path in source.files.images[::4]]
    mask = source.read_mask(images[0].shape)
    found = find_object(np.mean(images, axis=0))
    assert (found & mask).sum() > 0.85 * (found | mask).sum()
