"""Noise of the light directions: its size, and that lights stay above the horizon."""

import numpy as np
import pytest

from splinecli.evaluation.trial_capture import tilt_lights
from splinecli.maths.normals import angle_between_deg, unit


def test_angles_have_the_wanted_root_mean_square() -> None:
    lights = np.tile(unit(np.array([[0.3, -0.4, 1.0]])), (20_000, 1))
    tilted = tilt_lights(lights, 4.0, np.random.default_rng(0))
    angles = angle_between_deg(tilted, lights)
    # The standard error of the root mean square of n Gaussians is sigma / sqrt(2 n) = 0.02.
    assert np.sqrt((angles**2).mean()) == pytest.approx(4.0, abs=0.08)
    # No direction is preferred: the mean is the light, shortened by the mean cosine.
    assert angle_between_deg(unit(tilted.mean(axis=0)), lights[0]) < 0.15
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1)


def test_lights_stay_above_the_horizon() -> None:
    azimuth = np.linspace(0, 2 * np.pi, 5000)
    lights = unit(np.stack([np.cos(azimuth), np.sin(azimuth), np.full(5000, 0.001)], axis=1))
    assert (tilt_lights(lights, 30.0, np.random.default_rng(0))[:, 2] > 0).all()
