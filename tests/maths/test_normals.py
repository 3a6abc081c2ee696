"""Unit normals: angles, pictures, errors, and slopes and curvatures of analytic surfaces."""

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from scenes import assert_unit, parametrize, square_grid, tilted, vectors
from splinecli.maths.normals import (
    angle_between_deg,
    angular_error_map_deg,
    curvature_of_normals,
    decode_picture,
    encode_picture,
    gradient_of_normals,
    summarise_errors,
    unit,
)


def random_normals(count, seed=0):
    return unit(default_rng(seed).normal(size=(count, 3)))


def test_unit_keeps_directions_and_zero_vectors():
    scaled = unit(vectors("3 0 4; 0 0 0; 0 -1e-30 0"))
    assert_allclose(scaled, [[0.6, 0, 0.8], [0, 0, 0], [0, -1, 0]], rtol=1e-15)


# A step of 1 / 65535 in (n + 1) / 2 is off by at most 1 / 65535 in each component of n, sqrt(3) of
# that in length: 0.0015 degrees. With 8 bits that is 0.39 degrees.
@parametrize("bits, limit_deg", [(16, 0.0016), (8, 0.4)])
def test_encode_and_decode_round_trip(bits, limit_deg):
    normals = random_normals(20_000).reshape(100, 200, 3)
    picture = encode_picture(normals, np.ones((100, 200), bool), bits=bits)
    assert picture.dtype == (np.uint16 if bits == 16 else np.uint8)
    error = angle_between_deg(decode_picture(picture), normals)
    assert error.max() < limit_deg
    # The limit is about the worst case, so the step really is this coarse.
    assert error.max() > limit_deg / 2


def test_known_colours():
    normals = np.array([[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]])
    picture = encode_picture(normals, np.array([[True, True, True]]), bits=8)
    # 127.5 rounds to the even 128; 1.6 / 2 * 255 = 204; 1.8 / 2 * 255 = 229.5 rounds to 230 (229.5
    # is exact).
    assert_array_equal(picture, [[[128, 128, 255], [255, 128, 128], [128, 204, 230]]])


def test_directx_flips_green_alone():
    normals, mask = random_normals(64).reshape(8, 8, 3), np.ones((8, 8), bool)
    flipped = encode_picture(normals, mask, convention="directx")
    assert_array_equal(flipped, encode_picture(normals * (1, -1, 1), mask))


@parametrize("convention", "opengl directx")
def test_black_outside_the_mask_and_zero_when_read_back(convention):
    normals = np.float32(random_normals(4).reshape(2, 2, 3))
    mask = np.array([[True, False], [False, True]])
    picture = encode_picture(normals, mask, convention=convention)
    assert not picture[~mask].any()
    decoded = decode_picture(picture)
    assert not decoded[~mask].any()
    assert_unit(decoded[mask])


@parametrize("degrees", [0.0, 1e-7, 1e-3, 45.0, 90.0, 179.999, 180 - 1e-7, 180.0])
def test_angles_from_0_to_180(degrees):
    radians = np.radians(degrees)
    a = np.array([1.0, 0.0, 0.0])
    b = np.array([np.cos(radians), np.sin(radians), 0.0])
    assert angle_between_deg(a, b) == approx(degrees, rel=1e-6, abs=1e-12)


def test_angles_are_never_nan():
    # float32 unit vectors, whose products with themselves lie on either side of 1.
    normals = np.float32(random_normals(10_000))
    same, opposite = angle_between_deg(normals, normals), angle_between_deg(normals, -normals)
    assert same.max() < 1e-5
    assert opposite.min() > 180 - 1e-5


@parametrize("dtype", [np.uint8, np.uint16])
def test_black_and_mid_gray_are_no_normals(dtype):
    top = np.iinfo(dtype).max
    half = top // 2
    picture = np.array([[0, 0, 0], [half] * 3, [half + 1] * 3, [half, half, top]], dtype)
    decoded = decode_picture(picture)
    assert not decoded[:3].any()
    assert_allclose(decoded[3], [0, 0, 1], atol=0.01)


def test_error_map():
    truth = np.array([[[0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 1]]], np.float32)
    normals = np.array([[[0.5, 0, np.sqrt(0.75)], [0, 0, -1], [0, 0, 1], [0, 0, 1]]], np.float32)
    errors = angular_error_map_deg(normals, truth, np.array([[True, True, True, False]]))
    # Right by definition; flipped is 180, not 0; no truth; outside the mask.
    assert_allclose(errors, [[30, 180, np.nan, np.nan]], atol=1e-5)


def test_summary_of_a_known_list():
    errors = summarise_errors(np.array([np.nan, *range(11), np.nan]))
    # 0, 1, ... 10: mean and median 5, the ninth tenth at 9; five of eleven under 5, ten under 10.
    assert errors.mean == 5
    assert errors.median == 5
    assert errors.p90 == 9
    assert errors.under_5 == approx(5 / 11)
    assert errors.under_10 == approx(10 / 11)


def test_float32_maps_are_summed_in_float64():
    errors = summarise_errors(np.full(10_000_000, 0.1, np.float32))
    assert errors.mean == approx(float(np.float32(0.1)), rel=1e-9)


def test_nothing_to_summarise():
    assert summarise_errors(np.full((3, 3), np.nan, np.float32)) is None
    assert summarise_errors(np.array([])) is None


SIZE, REACH = 120, 60.0
X, Y = square_grid(SIZE, REACH * (1 - 1 / SIZE))
RADIUS = 75.0


def sphere(sign):
    """Normals of a ball (1) or of a bowl (-1), and a ragged mask."""
    inside = np.hypot(X, Y) < 55
    inside[50:60, 40:44] = False
    z = np.sqrt(RADIUS**2 - X**2 - Y**2, where=inside, out=np.ones_like(X))
    return np.float32(tilted(sign * X / z, sign * Y / z)), inside


@parametrize("sign", [1, -1])
def test_a_sphere(sign):
    normal_map, mask = sphere(sign)
    found = curvature_of_normals(normal_map, mask)
    expected = np.tile((sign / RADIUS, 1 / RADIUS**2), (len(found[mask]), 1))
    assert_allclose(found[mask], expected, rtol=0.02)
    assert np.isnan(found[~mask]).all()
    slopes = gradient_of_normals(normal_map, mask)
    assert_allclose(slopes[mask], -normal_map[mask][:, :2] / normal_map[mask][:, 2:], rtol=1e-5)


def test_a_cylinder_and_a_saddle():
    everywhere = np.ones(X.shape, bool)
    inner = np.hypot(X, Y) < 40
    around = np.sqrt(RADIUS**2 - X**2)
    cylinder = curvature_of_normals(tilted(X / around, 0 * X), everywhere)[inner]
    assert_allclose(cylinder[:, 0], 0.5 / RADIUS, rtol=0.02)
    assert_allclose(cylinder[:, 1], 0, atol=1e-6)
    # z = x y / R, whose curvature at the middle is -1/R^2 (Gauss) and 0 (mean).
    saddle = curvature_of_normals(tilted(-Y / 300, -X / 300), everywhere)[SIZE // 2, SIZE // 2]
    assert saddle[1] == approx(-1 / 300**2, rel=0.02) and abs(saddle[0]) < 1e-6


def test_a_steep_normal_has_no_slope():
    steep = np.tile(np.float32((0.9995, 0, 0.03)), (3, 3, 1))
    assert np.isnan(gradient_of_normals(steep, np.ones((3, 3), bool))).all()
