"""Rotated or negated lights, half vectors and wrong rings of a dome are named, mended, and lower
the confidence.
"""

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from numpy.typing import NDArray

import scenes
from judged import warnings_of
from scenes import (
    as_capture,
    directions_at,
    halfway,
    parametrize,
    ring_lights,
    spiral_lights,
    square_grid,
    tilted,
    vectors,
)
from splinecli.judge.light_check import check_lights
from splinecli.judge.light_order import HALF_VECTORS
from splinecli.lights.rough_normals import cast_shadows
from splinecli.maths.normals import angle_between_deg
from splinecli.records import capture_warnings as kinds

Array = NDArray[np.float64]
SIZE = 56
SCATTERED = spiral_lights(14, 55, 12)
TWO_RINGS = np.concatenate((ring_lights(6, 55, 0.2), ring_lights(4, 30, 0.7)))


def ball():
    normals, inside = scenes.sphere(SIZE)
    return normals[inside], inside


def relief(seed, sign=1):
    """The normals (P, 3), mask and heights in pixels of steep bumps, or with sign -1 hollows, that
    fill the picture.
    """
    rng = default_rng(seed)
    x, y = square_grid(SIZE)
    z = np.zeros_like(x)
    for place in rng.uniform(-0.9, 0.9, (8, 2)):
        width = rng.uniform(0.12, 0.25)
        z += (
            sign * 1.6 * width * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 2 / width**2)
        )
    z_down, z_right = np.gradient(z, 2 / (SIZE - 1))
    normals = tilted(-z_right, z_down)
    return normals.reshape(-1, 3), np.ones((SIZE, SIZE), np.bool_), z * (SIZE - 1) / 2


def rotated(lights, degrees):
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.asarray(lights @ np.array(((cos, sin, 0), (-sin, cos, 0), (0, 0, 1))))


def shade(normals, lights, gloss=0.0):
    return scenes.shade(normals, lights, gloss=gloss, noise=0.005)


@parametrize("gloss", [0.0, 0.4])
@parametrize("lights", [TWO_RINGS, SCATTERED], ids=["two rings", "scattered"])
def test_half_vectors_are_named_and_mended(lights, gloss):
    for normals, mask, *_ in (ball(), relief(3)):
        check = check_lights(shade(normals, lights, gloss), mask, halfway(lights))
        assert check.order == HALF_VECTORS and check.best is None
        assert_allclose(check.mended, lights, atol=1e-6)


@parametrize("lights", [ring_lights(8, 45), TWO_RINGS, SCATTERED], ids=len)
def test_right_lights_near_the_axis_are_no_half_vectors(lights, rng):
    high = halfway(lights)
    texture = rng.uniform(0.5, 1, (SIZE * SIZE, 1))
    for normals, mask, *_ in (ball(), relief(3)):
        seen = shade(normals, high, 0.4)
        for observations in (
            seen,
            seen * texture[: len(seen)],
            (seen / seen.max()) ** (1 / 2.2),
            seen + 0.2,
        ):
            assert check_lights(observations, mask, high).order is None


def test_half_vectors_of_a_ring_change_the_albedo():
    """The images of a ring fit it at any elevation."""
    lights = ring_lights(8, 45)
    for gloss in (0.0, 0.3):
        check = check_lights(shade(ball()[0], lights, gloss), ball()[1], halfway(lights))
        assert check.order == HALF_VECTORS


@parametrize("degrees", [30, -40, 15, 160])
def test_a_rotation_about_the_view_axis_is_named_and_mended(degrees):
    normals, mask = ball()
    check = check_lights(shade(normals, SCATTERED, 0.3), mask, rotated(SCATTERED, degrees))
    assert check.best is not None and "about the view axis" in check.best.name
    # The angle is found in whole degrees.
    assert angle_between_deg(check.mended, SCATTERED).mean() < 1.5


def test_without_an_outline_a_rotation_leaves_two_readings():
    normals, mask, _ = relief(3)
    check = check_lights(shade(normals, SCATTERED), mask, rotated(SCATTERED, 30))
    assert check.best is not None and "about the view axis" in check.best.name
    assert check.mended is None, "bumps and hollows are exchanged in one of them"
    assert check.error_deg is not None and check.error_deg > 10


def check_relief(sign, *, negated, casts):
    normals, mask, heights = relief(7, sign)
    lights = spiral_lights(14, 72, 30)
    observations = shade(normals, lights)
    if casts:
        observations = (
            np.where(cast_shadows(heights, lights).reshape(observations.shape), 0.02, 1)
            * observations
        )
    return check_lights(observations, mask, lights * ((-1, -1, 1) if negated else (1, 1, 1)))


@parametrize("sign", [1, -1], ids=["bumps", "hollows"])
def test_cast_shadows_tell_a_bump_from_a_hollow(sign):
    right, wrong = (check_relief(sign, negated=negated, casts=True) for negated in (False, True))
    assert right.best is None and right.shadows_tell and not right.lacks_shadows
    assert wrong.best is not None and str(wrong.best.frame) == "x-left,y-down"


def test_bumps_without_shadows_that_read_as_hollows_are_left_open():
    assert not check_relief(1, negated=False, casts=False).lacks_shadows
    check = check_relief(1, negated=True, casts=False)
    assert check.lacks_shadows and check.best is None


def test_a_step_casts_the_shadow_of_its_height():
    heights = np.zeros((12, 30))
    heights[:, :10] = 5
    # From the left at 45 degrees, a step of 5 pixels between two pixels shades the next 4.5.
    cast = cast_shadows(heights, vectors("-1 0 1; 1 0 1; 0 0 1") / np.sqrt((2, 2, 1))[:, None])
    assert cast[6, :, 0].nonzero()[0].tolist() == [10, 11, 12, 13]
    assert not cast[..., 1:].any()


def dome(rings, per_ring, lowest, highest, jitter):
    """Lights from low to high with errors in degrees, so that rings overlap in elevation."""
    rng, lights = default_rng(1), []
    for place, elevation in enumerate(np.linspace(lowest, highest, rings)):
        azimuth = np.arange(per_ring) * 2 * np.pi / per_ring + 0.2 * place
        errors = np.radians(rng.normal(0, jitter, (2, per_ring)))
        lights.append(directions_at(azimuth + errors[0], np.radians(90 - elevation) + errors[1]))
    return np.concatenate(lights)


@parametrize("case", [(15, 75, 0.0), (10, 80, 1.0), (30, 48, 0.0), (30, 60, 2.0)], ids=str)
def test_every_second_ring_of_a_dome_with_x_negated(case):
    lights = dome(8, 8, *case)
    given = lights * (-1, 1, 1)
    for start in range(8, 64, 16):
        given[start : start + 8] = np.roll(given[start : start + 8], 1, axis=0)
    normals, mask = ball()
    check = check_lights(shade(normals, lights), mask, given)
    assert_allclose(check.mended, lights, atol=1e-6)
    again = check_lights(shade(normals, lights), mask, check.mended)
    assert again.order is None
    assert again.best is None
    # Without an outline, x or y is negated; which, the images do not tell.
    normals, mask, _ = relief(3)
    check = check_lights(shade(normals, lights), mask, given)
    assert check.best is not None and check.best.frame is not None
    assert {-1, 1} == {*check.best.frame.signs[:2]}


FAULTS = {
    "half vectors": (halfway(TWO_RINGS), kinds.LIGHT_FRAME),
    "rotated": (rotated(TWO_RINGS, 30), kinds.LIGHT_FRAME),
    "negated": (TWO_RINGS * (-1, -1, 1), kinds.LIGHT_FRAME),
    "reversed": (TWO_RINGS[::-1], kinds.LIGHT_ORDER),
    "shuffled": (default_rng(1).permutation(TWO_RINGS), kinds.LIGHT_ORDER),
}


@parametrize("fault", FAULTS)
def test_warnings_state_the_error_of_the_normals(fault):
    (normals, mask), (given, code) = ball(), FAULTS[fault]
    capture = as_capture(shade(normals, TWO_RINGS), given, mask)
    warnings = warnings_of(capture, intensities=np.ones(10))
    stated = [warning.error_deg for warning in warnings if warning.kind == code]
    assert stated and min(error or 0 for error in stated) > 10


@parametrize("kind", [kinds.IMAGE_INCONSISTENT, kinds.REPEATED_IMAGES], ids=["black", "repeated"])
def test_a_wrong_image_states_the_error_that_it_makes(kind):
    normals, mask = ball()
    observations = shade(normals, TWO_RINGS)
    observations[:, 3] = observations[:, 7] if kind == kinds.REPEATED_IMAGES else 0
    capture = as_capture(observations, TWO_RINGS, mask)
    first, *_ = warnings_of(capture, intensities=np.ones(10))
    assert first.kind == kind and first.error_deg is not None
