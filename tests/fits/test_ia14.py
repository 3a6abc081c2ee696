"""IA14 and its batched solver, against a library for quadratic programmes, SciPy, and scenes with such an inverse."""

from math import comb

import numpy as np
import pytest
import quadprog
import torch
from numpy.typing import NDArray

from scenes import cap_directions, halfway
from splinecli.fits.ia14 import fit
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import MethodOptions, make_estimator

Array = NDArray[np.float64]
ON_CPU = MethodOptions(device="cpu")


def bernstein(x: Array, degree: int) -> Array:
    return np.stack([comb(degree, i) * x**i * (1 - x) ** (degree - i) for i in range(degree + 1)], axis=-1)


def rendered(normals: Array, lights: Array, seed: int) -> Array:
    """Diffuse and a Blinn-Phong highlight of random strength and width, with attached shadows; largest 1."""
    rng = np.random.default_rng(seed)
    strength, exponent = rng.uniform(0, 2, (len(normals), 1)), rng.uniform(5, 80, (len(normals), 1))
    shading = (normals @ lights.T).clip(0)
    observations: Array = shading * (1 + strength * (normals @ halfway(lights).T).clip(0) ** exponent)
    return observations / observations.max(axis=1, keepdims=True)


def test_lambertian_is_exact() -> None:
    for count in (4, 10, 96):
        truth, lights = cap_directions(300, 70, 0, even=True), cap_directions(count, 60, 1, even=True)
        observations = (truth @ lights.T).clip(0)
        truth = truth[(observations > 0).sum(axis=1) >= 4]
        observations = (truth @ lights.T).clip(0) * 7
        # What is left is float32 and, for lights nearly in a plane, the ridge.
        found = make_estimator("ia14", ON_CPU).estimate(observations.astype(np.float32), lights)
        assert np.median(angle_between_deg(found, truth)) < 1e-4
        assert angle_between_deg(found, truth).max() < 0.02


def objective_of(
    intensities: Array, lights: Array, prior_weight: float
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """The whole programme of one pixel, over x = (n, c_10 .. c_24): no variable eliminated, no increments.

    Returns H with the objective x'Hx / 2, the mean of g as a row m'x, the monotonicity as C x >= 0, and which
    lights are used.
    """
    floor = min(0.2 * np.quantile(intensities, 0.6), np.sort(intensities)[-3])
    used = (intensities >= floor) & (intensities > 0)
    x, directions_used = intensities[used], lights[used]
    products = bernstein(x, 2)[:, 1:, None] * bernstein(directions_used[:, 2], 4)[:, None, :]
    g = np.concatenate((np.zeros((len(x), 3)), products.reshape(len(x), 10)), axis=1)
    normal = np.concatenate((directions_used, np.zeros((len(x), 10))), axis=1)
    steps = np.kron([[1, 0], [-1, 1]], np.eye(5))
    monotone = np.concatenate((np.zeros((10, 3)), steps), axis=1)
    unitless = 2 * x.mean() * monotone
    centred = unitless - unitless.mean(axis=0)
    hessian = 2 * ((normal - g).T @ (normal - g) + prior_weight * centred.T @ centred / 10)
    return hessian, g.mean(axis=0), monotone, used


@pytest.mark.parametrize("count", [10, 96])
@pytest.mark.parametrize("kind", ["random", "rendered"])
def test_optimum_is_the_librarys(kind: str, count: int) -> None:
    lights = cap_directions(count, 60, 5, even=True)
    truth = cap_directions(100, 60, 6, even=True)
    if kind == "random":
        observations = np.random.default_rng(7).uniform(size=(100, count))
        observations /= observations.max(axis=1, keepdims=True)
    else:
        observations = rendered(truth, lights, 7)
    normals, increments = fit(torch.as_tensor(observations), torch.as_tensor(lights))
    for intensities, n, d in zip(observations, normals.numpy(), increments.numpy(), strict=True):
        hessian, mean, monotone, used = objective_of(intensities, lights, prior_weight=0.01)
        # On the constraint mean'x = 1 the added term is constant; the library asks for a definite hessian.
        definite = hessian + np.outer(mean, mean) + 1e-10 * np.eye(13)
        constraints = np.concatenate((mean[None], monotone)).T
        bounds = np.array([1.0] + [0.0] * 10)
        expected = quadprog.solve_qp(definite, np.zeros(13), constraints, bounds, 1)[0]
        c = np.cumsum(d / (2 * intensities[used].mean()), axis=0)
        found = np.concatenate((n, c.ravel()))
        assert mean @ found == pytest.approx(1, rel=1e-12)
        assert (monotone @ found).min() > -1e-12
        optimum = expected @ hessian @ expected
        assert found @ hessian @ found == pytest.approx(optimum, rel=1e-6, abs=1e-9)
        assert angle_between_deg(n[None], expected[None, :3]).item() < 0.01
