"""Least squares, on scenes where it is exact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.methods.least_squares import LeastSquares
from splinecli.normals import angle_between_deg


def lights(count: int) -> NDArray[np.float64]:
    azimuth = np.arange(count) * 2.4
    zenith = np.radians(np.linspace(5, 35, count))
    return np.stack(
        (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)), axis=1
    )


def normals(count: int, limit_deg: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    azimuth, zenith = rng.uniform(0, 2 * np.pi, count), np.radians(rng.uniform(0, limit_deg, count))
    return np.stack(
        (np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)), axis=1
    )


@pytest.mark.parametrize("count", [3, 4, 10, 96])
def test_exact_without_shadows(count: int) -> None:
    truth = normals(500, 50)
    albedo = np.random.default_rng(1).uniform(0.01, 100, (500, 1))
    # All lights are within 35 degrees of the camera, all normals within 50: nothing is shadowed.
    observations = albedo * (truth @ lights(count).T)
    assert observations.min() > 0
    assert angle_between_deg(LeastSquares().estimate(observations, lights(count)), truth).max() < 1e-5


def test_solves_the_normal_equations() -> None:
    observations = np.random.default_rng(0).uniform(size=(50, 10))
    directions = lights(10)
    estimate = LeastSquares().estimate(observations, directions)
    expected = np.linalg.lstsq(directions, observations.T, rcond=None)[0].T
    np.testing.assert_allclose(
        estimate, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12
    )


def test_dark_pixels_face_the_camera() -> None:
    observations = np.array([[0, 0, 0, 0], [1, 1, 1, 1]], np.float32)
    estimate = LeastSquares().estimate(observations, lights(4))
    np.testing.assert_array_equal(estimate[0], (0, 0, 1))
    assert np.linalg.norm(estimate[1]) == pytest.approx(1)


def test_float32_observations_are_solved_in_float64() -> None:
    truth = normals(100, 50)
    observations = (truth @ lights(10).T).astype(np.float32)
    estimate = LeastSquares().estimate(observations, lights(10))
    assert estimate.dtype == np.float64
    # What is left is the rounding of the observations, 6e-8 of each.
    assert angle_between_deg(estimate, truth).max() < 3e-5
