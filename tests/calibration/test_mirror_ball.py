"""Highlights and directions, against a ball whose reflections are followed to the lamp."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import Render
from splinecli.calibration.balls import ball_centre, check_in_front, find_highlight, reflect
from splinecli.calibration.circle import Circle
from splinecli.errors import InputError
from splinecli.maths.normals import angle_between_deg

BALL = Circle(103.3, 88.7, 61.4)
DISTANT = np.array(((1e6, 0, 104.5), (0, 1e6, 89.5), (0, 0, 1)))


def direction_at(ball: Circle, x: float, y: float) -> NDArray[np.float64]:
    return reflect(ball_centre(ball.outline, DISTANT), np.array([(x, y)]), DISTANT)[1][0]


@pytest.mark.parametrize("full_scale", [None, 1.0])
def test_directions_come_back(render_ball: Render, lights: NDArray[np.float64], full_scale: float | None) -> None:
    for light in lights:
        picture = render_ball(light)
        picture = picture if full_scale is None else picture.clip(0, full_scale)
        highlight = find_highlight(picture, BALL, full_scale=full_scale)
        # A pixel of this ball is 1.9 degrees of light near its middle, and more towards its rim.
        assert angle_between_deg(direction_at(BALL, highlight.x, highlight.y), light) < 0.7
        assert (highlight.saturated > 0.1) == (full_scale is not None)


def test_a_sparkle_is_no_lamp(render_ball: Render, lights: NDArray[np.float64]) -> None:
    picture = render_ball(lights[3]).clip(0, 1)
    expected = find_highlight(picture, BALL)
    picture[110, 80] = 1.0
    found = find_highlight(picture, BALL)
    assert (found.x, found.y) == (expected.x, expected.y)


def test_no_highlight(render_ball: Render) -> None:
    behind = np.array([0.0, 0.6, -0.8])
    for picture in (render_ball(behind, lamp=0.03), np.zeros((180, 210), np.float32)):
        with pytest.raises(InputError, match="found no highlight"):
            find_highlight(picture, BALL)


def test_a_window_is_no_lamp(render_ball: Render, lights: NDArray[np.float64]) -> None:
    picture = render_ball(lights[0])
    picture[60:110, 70:130] = 20
    with pytest.raises(InputError, match="too wide for a lamp"):
        find_highlight(picture, BALL)


@pytest.mark.parametrize("x", [0.75, 0.99, 1.2])
def test_highlights_near_the_rim(x: float) -> None:
    direction = direction_at(BALL, BALL.x + x * BALL.radius, BALL.y)
    with pytest.raises(InputError, match="level with the ball or behind it"):
        check_in_front(direction, np.array((0.0, 0.0, -1.0)))


@pytest.mark.parametrize("distance", [6.0, 50.0, 9e3])
@pytest.mark.parametrize("side", [0.0, 0.3])
def test_the_centre_of_a_ball_seen_from_near(distance: float, side: float) -> None:
    """Points of a sphere of radius 1 at which the line of sight touches it, seen by a pinhole camera."""
    centre = distance * np.array((side, -0.1, -1.0)) / np.hypot(np.hypot(side, 0.1), 1)
    focal = 100 * distance
    matrix = np.array(((focal, 0, 400), (0, focal, 300), (0, 0, 1.0)))
    towards = -centre / distance
    across = np.linalg.svd(towards[None])[2][1:]
    angle = np.linspace(0, 5, 300)[:, None]
    rim = np.sqrt(1 - distance**-2) * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
    touched = centre + towards / distance + rim
    image = touched[:, :2] / -touched[:, 2:] * (focal, -focal) + (400, 300)
    np.testing.assert_allclose(ball_centre(image, matrix), centre, rtol=1e-4, atol=1e-4 * distance)
