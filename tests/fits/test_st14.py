"""ST14, on scenes that obey its model."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from scenes import cap_directions, halfway
from splinecli.fits.st14 import solve_st14
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import MethodOptions, make_estimator
from splinecli.methods.estimator import LeastSquares

Array = NDArray[np.float64]


def half_cosines(normals: Array, lights: Array) -> tuple[Array, Array]:
    """n.h (P, F) and l.h (F,)."""
    bisectors = halfway(lights)
    return normals @ bisectors.T, (lights * bisectors).sum(axis=1)


def bipolynomial(normals: Array, lights: Array) -> Array:
    """Observations (P, F) under nine random coefficients a pixel, as the model's definition has it."""
    half, difference = half_cosines(normals, lights)
    coefficients = np.random.default_rng(5).uniform(-0.3, 0.3, (len(normals), 3, 3))
    coefficients[:, 0, 0] = 1
    powers = np.arange(3)
    reflectance: Array = np.einsum(
        "pab,pfa,fb->pf", coefficients, (1 - half[..., None]) ** powers, (1 - difference[..., None]) ** powers
    )
    return reflectance * (normals @ lights.T)


def estimate(observations: Array, lights: Array) -> Array:
    estimator = make_estimator("st14", MethodOptions(device="cpu"))
    return estimator.estimate(observations.astype(np.float32), lights).astype(np.float64)


def solved(observations: Array, lights: Array) -> Array:
    scaled = observations / observations.max(axis=1, keepdims=True)
    normals: Array = solve_st14(torch.from_numpy(scaled), torch.from_numpy(lights)).numpy()
    return normals


# All lights are within 38 degrees of the camera, all normals within 50: nothing is shadowed.
TRUTH = cap_directions(300, 50, 0, even=True)
LIGHTS = cap_directions(96, 38, 1, even=True)
OBSERVATIONS = bipolynomial(TRUTH, LIGHTS)


def with_highlights(observations: Array, untouched: int) -> Array:
    """All but the lowest of a pixel's observations up to six times as bright."""
    rank = observations.argsort(axis=1).argsort(axis=1)
    gain = np.random.default_rng(7).uniform(0, 5, observations.shape)
    return observations * (1 + gain * (rank >= untouched))


def test_exact_under_its_model() -> None:
    assert OBSERVATIONS.min() > 0
    # The prior weighs no more than the noise it is left with, which is rounding.
    assert angle_between_deg(solved(OBSERVATIONS, LIGHTS), TRUTH).max() < 0.005
    assert angle_between_deg(estimate(OBSERVATIONS, LIGHTS), TRUTH).max() < 0.02


def test_highlights_in_the_brightest_observations_change_nothing() -> None:
    bright = with_highlights(OBSERVATIONS, untouched=60)
    assert angle_between_deg(LeastSquares().estimate(bright, LIGHTS), TRUTH).mean() > 20
    # They raise the threshold of shadows, so fewer observations are kept than without them.
    assert angle_between_deg(estimate(bright, LIGHTS), TRUTH).max() < 0.1


@pytest.mark.parametrize(("count", "cast"), [(4, 0.0), (6, 0.0), (10, 0.0), (64, 0.1)])
def test_exact_on_lambertian_scenes_with_shadows(count: int, cast: float) -> None:
    lights, truth = cap_directions(count, 70, 3, even=True), cap_directions(300, 60, 4, even=True)
    observations = np.maximum(truth @ lights.T, 0)
    assert (observations == 0).any()
    # Fewer than four may be three in one plane.
    reached = (observations > 0).sum(axis=1) >= 4
    # Cast shadows are seldom quite black.
    observations[np.random.default_rng(2).uniform(size=observations.shape) < cast] *= 0.05
    assert angle_between_deg(estimate(observations, lights), truth)[reached].max() < 0.001


@pytest.mark.parametrize(("count", "untouched"), [(10, 8), (96, 60)])
def test_noise_and_highlights_cost_less_than_in_least_squares(count: int, untouched: int) -> None:
    lights = cap_directions(count, 38, 3, even=True)
    noise = np.random.default_rng(6).normal(1, 0.01, (len(TRUTH), count))
    observations = with_highlights(bipolynomial(TRUTH, lights) * noise, untouched)
    error = angle_between_deg(estimate(observations, lights), TRUTH).mean()
    assert error < 0.25 * angle_between_deg(LeastSquares().estimate(observations, lights), TRUTH).mean()
