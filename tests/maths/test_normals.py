"""Unit normals, angles and pictures."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.maths.normals import Convention, angle_between_deg, decode_picture, encode_picture, unit


def random_normals(count: int, seed: int = 0) -> NDArray[np.float64]:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_unit_keeps_directions_and_zero_vectors() -> None:
    scaled = unit(np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [0.0, -1e-30, 0.0]]))
    np.testing.assert_allclose(scaled, [[0.6, 0, 0.8], [0, 0, 0], [0, -1, 0]], rtol=1e-15)


# A step of 1 / 65535 in (n + 1) / 2 is off by at most 1 / 65535 in each component of n, sqrt(3) of that in length:
# 0.0015 degrees. With 8 bits that is 0.39 degrees.
@pytest.mark.parametrize(("bits", "limit_deg"), [(16, 0.0016), (8, 0.4)])
def test_encode_and_decode_round_trip(bits: int, limit_deg: float) -> None:
    normals = random_normals(20_000).reshape(100, 200, 3)
    picture = encode_picture(normals, np.ones((100, 200), bool), bits=bits)
    assert picture.dtype == (np.uint16 if bits == 16 else np.uint8)
    error = angle_between_deg(decode_picture(picture), normals)
    assert error.max() < limit_deg
    # The limit is about the worst case, so the step really is this coarse.
    assert error.max() > limit_deg / 2


def test_known_colours() -> None:
    normals = np.array([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]])
    picture = encode_picture(normals, np.array([[True, True, True]]), bits=8)
    # 127.5 rounds to the even 128; 1.6 / 2 * 255 = 204; 1.8 / 2 * 255 = 229.5 rounds to 230 (229.5 is exact).
    np.testing.assert_array_equal(picture, [[[128, 128, 255], [255, 128, 128], [128, 204, 230]]])


def test_directx_flips_green_alone() -> None:
    normals, mask = random_normals(64).reshape(8, 8, 3), np.ones((8, 8), bool)
    flipped = encode_picture(normals, mask, convention="directx")
    np.testing.assert_array_equal(flipped, encode_picture(normals * (1, -1, 1), mask))
    opengl = encode_picture(normals, mask)
    np.testing.assert_array_equal(flipped[..., [0, 2]], opengl[..., [0, 2]])
    # Green runs the other way: the two add up to full scale, but for rounding.
    assert np.abs(flipped[..., 1].astype(int) + opengl[..., 1] - 65535).max() <= 1


@pytest.mark.parametrize("convention", ["opengl", "directx"])
def test_black_outside_the_mask_and_zero_when_read_back(convention: Convention) -> None:
    normals = random_normals(4).reshape(2, 2, 3).astype(np.float32)
    mask = np.array([[True, False], [False, True]])
    picture = encode_picture(normals, mask, convention=convention)
    assert not picture[~mask].any()
    decoded = decode_picture(picture)
    assert not decoded[~mask].any()
    np.testing.assert_allclose(np.linalg.norm(decoded[mask], axis=1), 1)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 45.0, 90.0, 179.999, 180 - 1e-7, 180.0])
def test_angles_from_0_to_180(degrees: float) -> None:
    radians = np.radians(degrees)
    a = np.array([1.0, 0.0, 0.0])
    b = np.array([np.cos(radians), np.sin(radians), 0.0])
    assert angle_between_deg(a, b) == pytest.approx(degrees, rel=1e-6, abs=1e-12)


def test_angles_are_never_nan() -> None:
    # float32 unit vectors, whose products with themselves lie on either side of 1.
    normals = random_normals(10_000).astype(np.float32)
    same, opposite = angle_between_deg(normals, normals), angle_between_deg(normals, -normals)
    assert same.max() < 1e-5
    assert opposite.min() > 180 - 1e-5


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_black_and_mid_gray_are_no_normals(dtype: type[np.unsignedinteger]) -> None:
    top = np.iinfo(dtype).max
    half = top // 2
    picture = np.array([[0, 0, 0], [half] * 3, [half + 1] * 3, [half, half, top]], dtype)
    decoded = decode_picture(picture)
    assert not decoded[:3].any()
    np.testing.assert_allclose(decoded[3], [0, 0, 1], atol=0.01)
