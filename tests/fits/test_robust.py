"""The methods that fit a Lambertian pixel and leave out what does not fit: IW12, L1, trimmed LS."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog

from splinecli.fits.least_squares import (
    RIDGE,
    SMALLEST_VARIANCE,
    solve_iw12,
    solve_l1,
    solve_trimmed,
    weighted_least_squares,
)
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import MethodOptions, make_estimator

ROBUST = ("iw12", "l1", "ls-trimmed")
Pixels = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def estimate(name: str, observations: NDArray[np.floating], lights: NDArray[np.float64]) -> NDArray[np.floating]:
    return make_estimator(name, MethodOptions(device="cpu")).estimate(observations.astype(np.float32), lights)


@pytest.mark.parametrize("name", ROBUST)
def test_exact_on_matte_pixels(name: str, matte_pixels: Pixels) -> None:
    normals, lights, observations = matte_pixels
    # What is left is the rounding of the observations to float32, 6e-8 of each.
    assert angle_between_deg(estimate(name, observations, lights), normals).max() < 1e-3


@pytest.mark.parametrize("name", ROBUST)
def test_exact_in_spite_of_a_highlight_and_a_cast_shadow(name: str, matte_pixels: Pixels) -> None:
    normals, lights, observations = matte_pixels
    spoilt = observations.copy()
    rows = np.arange(len(spoilt))
    spoilt[rows, observations.argmax(axis=1)] *= 1.7  # highlights lie where it is bright
    spoilt[rows, observations.argsort(axis=1)[:, 5]] = 0
    wrong = angle_between_deg(estimate("ls", spoilt, lights), normals)
    found = angle_between_deg(estimate(name, spoilt, lights), normals)
    assert wrong.mean() > 8
    # 2 of 12 observations are no model's: a sparse error. IW12's variances stop at a thousandth.
    assert found.max() < 0.1


def test_iw12_fixed_point(matte_pixels: Pixels) -> None:
    """The result solves eq. 11 for the variances that it gives rise to, written out with LAPACK."""
    _, lights, observations = matte_pixels
    rng = np.random.default_rng(2)
    observations = observations[:10] * rng.uniform(0.7, 1.3, (10, 12))
    observations /= observations.max(axis=1, keepdims=True)
    found = solve_iw12(torch.tensor(observations), torch.tensor(lights), iterations=3000).numpy()
    for pixel, b in zip(observations, found, strict=True):
        gamma = np.ones(12)
        for _ in range(3000):
            weighted = lights / gamma[:, None]
            posterior = np.linalg.inv(lights.T @ weighted + RIDGE * np.eye(3))
            solution = posterior @ weighted.T @ pixel
            gamma = (pixel - lights @ solution) ** 2 + np.einsum("fi,ij,fj->f", lights, posterior, lights)
            gamma = gamma.clip(SMALLEST_VARIANCE)
        np.testing.assert_allclose(b, solution, rtol=1e-5)


def test_l1_is_the_linear_programme_s_optimum() -> None:
    rng = np.random.default_rng(0)
    lights = rng.normal(size=(10, 3)) * (0.4, 0.4, 0.1) + (0, 0, 1)
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    observations = rng.uniform(size=(30, 10))
    found = solve_l1(torch.tensor(observations), torch.tensor(lights)).numpy()
    excess = []
    for pixel, b in zip(observations, found, strict=True):
        # min sum(t), -t <= I - L b <= t
        both = np.block([[-lights, -np.eye(10)], [lights, -np.eye(10)]])
        bounds = [(None, None)] * 3 + [(0, None)] * 10
        best = linprog(np.r_[np.zeros(3), np.ones(10)], both, np.r_[-pixel, pixel], bounds=bounds)
        excess.append(np.abs(pixel - lights @ b).sum() / best.fun - 1)
    # Exactly there, or (one in ten of these, which have no model at all) within a few thousandths.
    assert np.quantile(excess, 0.8) < 1e-6
    assert max(excess) < 4e-3


@pytest.mark.parametrize(("count", "dropped"), [(3, 0), (4, 0), (5, 0), (6, 1), (10, 2), (96, 19)])
def test_trimmed_ends(count: int, dropped: int) -> None:
    """Moving a trimmed observation further out changes nothing; moving the next one does."""
    rng = np.random.default_rng(0)
    lights = torch.tensor(rng.normal(size=(count, 3)))
    observations = torch.tensor(rng.permutation(np.linspace(0.1, 1, count))[None])
    order = observations[0].argsort()
    before = solve_trimmed(observations, lights)
    outer = observations.clone()
    outer[0, order[:dropped]] = 0
    outer[0, order[count - dropped :]] = 9
    assert torch.equal(solve_trimmed(outer, lights), before)
    outer[0, order[count - dropped - 1]] = 9
    assert not torch.allclose(solve_trimmed(outer, lights), before)


def test_lights_that_span_a_plane_or_a_line_give_finite_normals() -> None:
    """Three directions, each many times: under IW12's weights one of them may drop out, then another."""
    rng = np.random.default_rng(0)
    for spanned in (1, 2, 3):
        rows = rng.normal(size=(spanned, 3)) * (0.4, 0.4, 0.1) + (0, 0, 1)
        lights = (rows / np.linalg.norm(rows, axis=1, keepdims=True))[np.arange(12) % spanned]
        observations = rng.uniform(size=(2000, 12)).astype(np.float32)
        for name in ROBUST:
            found = estimate(name, observations, lights)
            np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_weighted_step_against_lapack() -> None:
    rng = np.random.default_rng(0)
    lights, observations = rng.normal(size=(7, 3)), rng.uniform(size=(5, 7))
    weight = 10.0 ** rng.uniform(-6, 6, (5, 7))
    solution, variances = weighted_least_squares(*(torch.tensor(a) for a in (observations, lights, weight)))
    for i in range(5):
        root = np.sqrt(weight[i])[:, None]
        expected = np.linalg.lstsq(root * lights, root[:, 0] * observations[i], rcond=None)[0]
        np.testing.assert_allclose(solution[i], expected, rtol=1e-6)
        covariance = np.linalg.inv((root * lights).T @ (root * lights))
        np.testing.assert_allclose(variances[i], np.diag(lights @ covariance @ lights.T), rtol=1e-5)
