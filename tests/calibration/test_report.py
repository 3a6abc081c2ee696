"""The report of a calibration, of lights whose errors are known."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.calibration.balls import BallCalibration, BallFiles, Highlight, View, combine_balls
from splinecli.calibration.circle import Circle
from splinecli.calibration.lamps import calibration_report, summary_lines
from splinecli.maths.normals import unit


def turned(directions: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Turn directions (F, 3) about the x axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return directions @ np.array([(1, 0, 0), (0, cosine, sine), (0, -sine, cosine)])


def ball(directions: NDArray[np.float64]) -> BallCalibration:
    files = BallFiles(Path("ball"), (Path("ball/1.png"),) * len(directions), None, None)
    highlights = tuple(Highlight(1.23456, 2.0, 0.25) for _ in directions)
    normals = unit(directions + np.array((0, 0, 1)))
    view = View(np.eye(3), "assumed distant", 1.0)
    return BallCalibration(files, Circle(50, 40, 30), "--circle", highlights, directions, normals, view, (100, 100))


def report(balls: list[BallCalibration], known: NDArray[np.float64] | None = None) -> dict:
    return calibration_report(combine_balls(balls), None, known, picture="calibration.png")


@pytest.fixture
def directions() -> NDArray[np.float64]:
    """Four lights (4, 3) in the plane x, z, so that all turn alike about the x axis where x is zero."""
    return unit(np.array([(0.0, 0.0, 1.0)] * 4))


def test_one_ball(directions: NDArray[np.float64]) -> None:
    found = report([ball(directions)])
    assert json.loads(json.dumps(found)) == found
    assert (found["n_lights"], found["disagreement_deg"], found["compared"]) == (4, None, None)
    assert found["light_intensities"] is None
    assert found["warnings"] == []
    assert found["balls"][0]["highlights"][0] == [1.235, 2.0]
    assert summary_lines(found) == [
        "ball: circle 50.0, 40.0, radius 30.0 pixels (from --circle, 100 % of the outline visible, spread 0.0 pixels)"
    ]


@pytest.mark.parametrize(("degrees", "warned"), [(9.8, False), (10.2, True)])
def test_balls_that_disagree(directions: NDArray[np.float64], degrees: float, warned: bool) -> None:
    # The mean of two directions lies half-way, so each differs from it by half the angle; the limit is 5 degrees.
    found = report([ball(directions), ball(turned(directions, degrees))])
    assert found["disagreement_deg"] == {"mean": degrees / 2, "largest": degrees / 2}
    assert bool(found["warnings"]) == warned
    assert f"the balls differ from their mean by {degrees / 2:.1f} degrees" in summary_lines(found)[-1]


def test_a_compared_file(directions: NDArray[np.float64]) -> None:
    lights = turned(directions, 40)
    found = report([ball(lights)], turned(lights, 2))
    assert found["compared"] == {"mean_deg": 2.0, "largest_deg": 2.0}
    assert found["warnings"] == []
    # The normal at the highlight halves the angle of 40 degrees.
    found = report([ball(lights)], turned(directions, 20))
    assert found["compared"] == {"mean_deg": 20.0, "largest_deg": 20.0}
    assert "the normals of the ball at the highlights instead of the light directions" in found["warnings"][0]
    # Directions that are wrong in another way are not mistaken for normals.
    assert report([ball(lights)], turned(lights, 20))["warnings"] == []
