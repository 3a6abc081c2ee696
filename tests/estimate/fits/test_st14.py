"""ST14 and IA14, on scenes that obey their models; the solver of IA14 against quadratic programmes
and SciPy.
"""

from math import comb

import numpy as np
import quadprog
import torch
from numpy.random import default_rng
from pytest import approx

from scenes import cap_directions, halfway, parametrize
from splinecli.estimate.fits.ia14 import fit_ia14
from splinecli.estimate.fits.st14 import solve_st14
from splinecli.estimate.methods import MethodOptions, make_estimator
from splinecli.estimate.methods.estimator import LeastSquares
from splinecli.maths.normals import angle_between_deg


def half_cosines(normals, lights):
    """n.h (P, F) and l.h (F,)."""
    bisectors = halfway(lights)
    return normals @ bisectors.T, (lights * bisectors).sum(axis=1)


def bipolynomial(normals, lights):
    """Observations (P, F) under nine random coefficients a pixel,
    as the model's definition has it.
    """
    half, difference = half_cosines(normals, lights)
    coefficients = default_rng(5).uniform(-0.3, 0.3, (len(normals), 3, 3))
    coefficients[:, 0, 0] = 1
    powers = np.arange(3)
    reflectance = np.einsum(
        "pab,pfa,fb->pf",
        coefficients,
        (1 - half[..., None]) ** powers,
        (1 - difference[..., None]) ** powers,
    )
    return reflectance * (normals @ lights.T)


def estimate(observations, lights):
    estimator = make_estimator("st14", MethodOptions(device="cpu"))
    return np.float64(estimator.estimate(np.float32(observations), lights))


def solved(observations, lights):
    scaled = observations / observations.max(axis=1, keepdims=True)
    return solve_st14(torch.from_numpy(scaled), torch.from_numpy(lights)).numpy()


# All lights are within 38 degrees of the camera, all normals within 50: nothing is shadowed.
TRUTH = cap_directions(300, 50, 0, even=True)
LIGHTS = cap_directions(96, 38, 1, even=True)
OBSERVATIONS = bipolynomial(TRUTH, LIGHTS)


def with_highlights(observations, untouched):
    """All but the lowest of a pixel's observations up to six times as bright."""
    rank = observations.argsort(axis=1).argsort(axis=1)
    gain = default_rng(7).uniform(0, 5, observations.shape)
    return observations * (1 + gain * (rank >= untouched))


def test_exact_under_its_model():
    assert OBSERVATIONS.min() > 0
    # The prior weighs no more than the noise it is left with, which is rounding.
    assert angle_between_deg(solved(OBSERVATIONS, LIGHTS), TRUTH).max() < 0.005
    assert angle_between_deg(estimate(OBSERVATIONS, LIGHTS), TRUTH).max() < 0.02


@parametrize("count, cast", [(4, 0.0), (6, 0.0), (10, 0.0), (64, 0.1)])
def test_exact_on_lambertian_scenes_with_shadows(count, cast):
    lights, truth = cap_directions(count, 70, 3, even=True), cap_directions(300, 60, 4, even=True)
    observations = np.maximum(truth @ lights.T, 0)
    assert (observations == 0).any()
    # Fewer than four may be three in one plane.
    reached = (observations > 0).sum(axis=1) >= 4
    # Cast shadows are seldom quite black.
    observations[default_rng(2).uniform(size=observations.shape) < cast] *= 0.05
    assert angle_between_deg(estimate(observations, lights), truth)[reached].max() < 0.001


@parametrize("count, untouched", [(10, 8), (96, 60)])
def test_noise_and_highlights_cost_less_than_in_least_squares(count, untouched):
    lights = cap_directions(count, 38, 3, even=True)
    noise = default_rng(6).normal(1, 0.01, (len(TRUTH), count))
    observations = with_highlights(bipolynomial(TRUTH, lights) * noise, untouched)
    error = angle_between_deg(estimate(observations, lights), TRUTH).mean()
    assert (
        error
        < 0.25 * angle_between_deg(LeastSquares().estimate(observations, lights), TRUTH).mean()
    )


def bernstein(x, degree):
    return np.stack(
        [comb(degree, i) * x**i * (1 - x) ** (degree - i) for i in range(degree + 1)], axis=-1
    )


def rendered(normals, lights, seed):
    """Diffuse and a Blinn-Phong highlight of random strength and width, with attached shadows;
    largest 1.
    """
    rng = default_rng(seed)
    strength, exponent = rng.uniform(0, 2, (len(normals), 1)), rng.uniform(5, 80, (len(normals), 1))
    shading = (normals @ lights.T).clip(0)
    observations = shading * (1 + strength * (normals @ halfway(lights).T).clip(0) ** exponent)
    return observations / observations.max(axis=1, keepdims=True)


def objective_of(intensities, lights, prior_weight):
    """The whole programme of one pixel, over x = (n, c_10 .. c_24): no variable eliminated, no
    increments.

    Returns H with the objective x'Hx / 2, the mean of g as a row m'x, the monotonicity as C x >= 0,
    and which lights are used.
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


@parametrize("count", [10, 96])
def test_optimum_is_the_librarys(count):
    lights = cap_directions(count, 60, 5, even=True)
    truth = cap_directions(100, 60, 6, even=True)
    observations = rendered(truth, lights, 7)
    normals, increments = fit_ia14(torch.as_tensor(observations), torch.as_tensor(lights))
    for intensities, n, d in zip(observations, normals.numpy(), increments.numpy(), strict=True):
        hessian, mean, monotone, used = objective_of(intensities, lights, prior_weight=0.01)
        # On the constraint mean'x = 1 the added term is constant; the library asks for a definite
        # hessian.
        definite = hessian + np.outer(mean, mean) + 1e-10 * np.eye(13)
        constraints = np.concatenate((mean[None], monotone)).T
        bounds = np.array([1.0] + [0.0] * 10)
        expected = quadprog.solve_qp(definite, np.zeros(13), constraints, bounds, 1)[0]
        c = np.cumsum(d / (2 * intensities[used].mean()), axis=0)
        found = np.concatenate((n, c.ravel()))
        assert mean @ found == approx(1, rel=1e-12)
        assert (monotone @ found).min() > -1e-12
        optimum = expected @ hessian @ expected
        assert found @ hessian @ found == approx(optimum, rel=1e-6, abs=1e-9)
        assert angle_between_deg(n[None], expected[None, :3]).item() < 0.01
