"""Least squares against LAPACK."""

import numpy as np
import pytest

from scenes import spiral_lights
from splinecli.methods.estimator import LeastSquares


@pytest.mark.parametrize("count", [3, 4, 10, 96])
def test_solves_the_normal_equations(count: int) -> None:
    observations = np.random.default_rng(0).uniform(size=(50, count))
    directions = spiral_lights(count)
    estimate = LeastSquares().estimate(observations, directions)
    expected = np.linalg.lstsq(directions, observations.T, rcond=None)[0].T
    np.testing.assert_allclose(estimate, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)
