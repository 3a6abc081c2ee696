"""Least squares, on scenes where it is exact."""

import numpy as np
import pytest

from scenes import cap_directions, spiral_lights
from splinecli.maths.normals import angle_between_deg
from splinecli.methods.least_squares import LeastSquares


@pytest.mark.parametrize("count", [3, 4, 10, 96])
def test_exact_without_shadows(count: int) -> None:
    truth = cap_directions(500, 50)
    albedo = np.random.default_rng(1).uniform(0.01, 100, (500, 1))
    # All lights are within 35 degrees of the camera, all normals within 50: nothing is shadowed.
    observations = albedo * (truth @ spiral_lights(count).T)
    assert observations.min() > 0
    assert angle_between_deg(LeastSquares().estimate(observations, spiral_lights(count)), truth).max() < 1e-5


def test_solves_the_normal_equations() -> None:
    observations = np.random.default_rng(0).uniform(size=(50, 10))
    directions = spiral_lights(10)
    estimate = LeastSquares().estimate(observations, directions)
    expected = np.linalg.lstsq(directions, observations.T, rcond=None)[0].T
    np.testing.assert_allclose(estimate, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)
