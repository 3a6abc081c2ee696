"""Highlights and directions, against a ball whose reflections are followed to the lamp."""

import numpy as np

from scenes import parametrize, pinhole, refuses, to_uint16, write_image
from splinecli.lights.calibration.balls import (
    ball_centre,
    calibrate_ball,
    find_ball_files,
    find_highlight,
    reflect,
)
from splinecli.lights.calibration.circle import Circle
from splinecli.maths.normals import angle_between_deg, unit

BALL = Circle(103.3, 88.7, 61.4)
DISTANT = pinhole(1e6, 104.5, 89.5)


@parametrize("full_scale", [None, 1.0])
def test_directions_come_back(render_ball, lights, full_scale):
    for light in lights:
        picture = render_ball(light)
        picture = picture if full_scale is None else picture.clip(0, full_scale)
        highlight = find_highlight(picture, BALL, full_scale=full_scale)
        # A pixel of this ball is 1.9 degrees of light near its middle, and more towards its rim.
        place = np.array([(highlight.x, highlight.y)])
        assert (
            angle_between_deg(
                reflect(ball_centre(BALL.outline, DISTANT), place, DISTANT)[1][0], light
            )
            < 0.7
        )
        assert (highlight.saturated > 0.1) == (full_scale is not None)


def test_sparkles_and_windows_are_no_lamps(render_ball, lights):
    picture = render_ball(lights[3]).clip(0, 1)
    expected = find_highlight(picture, BALL)
    picture[110, 80] = 1.0
    found = find_highlight(picture, BALL)
    assert found.x == expected.x
    assert found.y == expected.y
    picture[60:110, 70:130] = 20
    with refuses("too wide for a lamp"):
        find_highlight(picture, BALL)
    for picture in (
        render_ball(np.array([0.0, 0.6, -0.8]), lamp=0.03),
        np.zeros((180, 210), np.float32),
    ):
        with refuses("found no highlight"):
            find_highlight(picture, BALL)


def test_highlights_near_the_rim(tmp_path, render_ball):
    picture = render_ball(unit(np.array((1.0, 0.0, -0.3))), lamp=0.9)
    write_image(tmp_path / "1.png", to_uint16(picture * 65535))
    with refuses(r"1\.png: .*level with the ball or behind it"):
        calibrate_ball(find_ball_files(tmp_path), circle=BALL)


@parametrize("distance", [6.0, 50.0, 9e3])
@parametrize("side", [0.0, 0.3])
def test_the_centre_of_a_ball_seen_from_near(distance, side):
    """Points of a sphere of radius 1 at which the line of sight touches it, seen by a pinhole
    camera.
    """
    centre = distance * np.array((side, -0.1, -1.0)) / np.hypot(np.hypot(side, 0.1), 1)
    focal = 100 * distance
    matrix = pinhole(focal, 400, 300)
    towards = -centre / distance
    across = np.linalg.svd(towards[None])[2][1:]
    angle = np.linspace(0, 5, 300)[:, None]
    rim = np.sqrt(1 - distance**-2) * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
    touched = centre + towards / distance + rim
    image = touched[:, :2] / -touched[:, 2:] * (focal, -focal) + (400, 300)
    np.testing.assert_allclose(ball_centre(image, matrix), centre, rtol=1e-4, atol=1e-4 * distance)
