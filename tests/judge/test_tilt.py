"""Lights that are all tilted together."""

import numpy as np
from pytest import approx
from scipy.spatial.transform import Rotation

from scenes import cap_directions, parametrize, sphere, tilted
from splinecli.judge.tilt import curl_of, find_tilt, fitted_map
from splinecli.maths.normals import angle_between_deg

SIZE = 72
LIGHTS = cap_directions(12, 50, 3, even=True)


def surface(name):
    if name == "bumps":
        y, x = np.mgrid[:SIZE, :SIZE] / SIZE * 9
        heights = np.sin(x) * np.cos(0.7 * y) + 0.6 * np.sin(1.3 * x + 2 * y)
        down, right = np.gradient(heights * 5)
        return tilted(-right, down).reshape(-1, 3), np.ones((SIZE, SIZE), bool)
    normals, inside = sphere(SIZE)
    return np.float64(normals[inside]), inside


def turned(degrees, towards_deg):
    """Return the lights tilted by so many degrees towards an azimuth."""
    azimuth = np.radians(towards_deg)
    # The view axis turns towards (cos, sin) about an axis at a right angle to it.
    axis = np.radians(degrees) * np.array((-np.sin(azimuth), np.cos(azimuth), 0))
    return Rotation.from_rotvec(axis).apply(LIGHTS)


@parametrize("name", "bumps ball")
@parametrize(("degrees", "towards_deg"), [(10, 40), (15, 200), (30, 310)])
def test_a_tilt_is_found_and_undone(name, degrees, towards_deg):
    normals, mask = surface(name)
    observed, given = (normals @ LIGHTS.T).clip(0), turned(degrees, towards_deg)
    tilt = find_tilt(fitted_map(observed, mask, given), mask)
    assert tilt.degrees == approx(degrees, abs=2.5)
    assert abs((tilt.towards_deg - towards_deg + 180) % 360 - 180) < 15
    assert angle_between_deg(given @ tilt.matrix.T, LIGHTS).max() < 3
    assert tilt.curl * tilt.left == approx(
        curl_of(fitted_map(observed, mask, LIGHTS), mask), abs=0.02
    )


@parametrize("name", "bumps ball")
def test_right_lights_are_not_tilted(name):
    normals, mask = surface(name)
    tilt = find_tilt(fitted_map((normals @ LIGHTS.T).clip(0), mask, LIGHTS), mask)
    assert tilt.degrees < 3 or tilt.left > 0.9


def test_a_line_of_pixels_shows_no_tilt():
    for shape in ((1, 30), (30, 1)):
        line = np.ones(shape, bool)
        assert find_tilt(np.ones((*shape, 3)), line) is None
        assert np.isnan(curl_of(np.ones((*shape, 3)), line))
