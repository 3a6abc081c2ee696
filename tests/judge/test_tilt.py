"""Lights that are all tilted together."""

import numpy as np
from pytest import approx
from scipy.spatial.transform import Rotation

from judged import judgement_of
from scenes import as_capture, bumps, cap_directions, parametrize, sphere
from splinecli.judge.tilt import curl_of, find_tilt, fitted_map
from splinecli.maths.normals import angle_between_deg
from splinecli.records.capture_warnings import LIGHTS_TILTED

SIZE = 72
LIGHTS = cap_directions(12, 50, 3, even=True)


def surface(name):
    if name == "bumps":
        return bumps(SIZE).reshape(-1, 3), np.ones((SIZE, SIZE), bool)
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


def test_a_capture_under_tilted_lights_is_warned_of_and_mended():
    normals, mask = surface("ball")
    observed = (normals @ LIGHTS.T).clip(0)
    right, tilted_by_15 = (
        judgement_of(as_capture(observed, lights, mask), intensities=np.ones(12))
        for lights in (LIGHTS, turned(15, 200))
    )
    assert right.warnings == ()
    (warning,) = tilted_by_15.warnings
    assert warning.kind is LIGHTS_TILTED and warning.error_deg == approx(15, abs=3)
    assert angle_between_deg(tilted_by_15.mended_lights, LIGHTS).max() < 3


def test_a_line_of_pixels_shows_no_tilt():
    for shape in ((1, 30), (30, 1)):
        line = np.ones(shape, bool)
        assert find_tilt(np.ones((*shape, 3)), line) is None
        assert np.isnan(curl_of(np.ones((*shape, 3)), line))
