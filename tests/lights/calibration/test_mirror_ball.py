"""Highlights of rendered mirror balls that are found, and others that are refused."""

import numpy as np

from scenes import refuses, to_uint16, write_image
from splinecli.lights.calibration.balls import (
    calibrate_ball,
    find_ball_files,
    find_highlight,
)
from splinecli.lights.calibration.circle import Circle
from splinecli.maths.normals import unit

BALL = Circle(103.3, 88.7, 61.4)


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
