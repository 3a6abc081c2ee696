"""Lambertian fits against LAPACK, linear programmes and pixels made by the Lambertian law; two
halves of the lights.
"""

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.optimize import linprog
from torch.nn.functional import normalize, pad
from torch.testing import assert_close

from distributions import seeded
from scenes import (
    assert_unit,
    cap_directions,
    parametrize,
    ring_lights,
    spiral_lights,
)
from splinecli.estimate.fits.least_squares import (
    RIDGE,
    SMALLEST_VARIANCE,
    alternating_signs,
    compare_halves,
    fit_lambertian,
    solve_iw12,
    solve_l1,
    solve_trimmed,
    weighted_least_squares,
)
from splinecli.estimate.methods import MethodOptions, make_estimator
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import inverse_3x3

ROBUST = ("iw12", "l1", "ls-trimmed")


def estimate(name, observations, lights):
    return make_estimator(name, MethodOptions(device="cpu")).estimate(
        np.float32(observations), lights
    )


@parametrize("name", ROBUST)
def test_exact_on_matte_pixels(name, matte_pixels):
    normals, lights, observations = matte_pixels
    # What is left is the rounding of the observations to float32, 6e-8 of each.
    assert angle_between_deg(estimate(name, observations, lights), normals).max() < 1e-3


@parametrize("name", ROBUST)
def test_exact_in_spite_of_a_highlight_and_a_cast_shadow(name, matte_pixels):
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


def test_iw12_fixed_point(matte_pixels):
    """The result solves eq. 11 for the variances that it gives rise to, written out with LAPACK."""
    _, lights, observations = matte_pixels
    observations = observations[:10] * default_rng(2).uniform(0.7, 1.3, (10, 12))
    observations /= observations.max(axis=1, keepdims=True)
    found = solve_iw12(torch.tensor(observations), torch.tensor(lights), iterations=3000).numpy()
    for pixel, b in zip(observations, found, strict=True):
        gamma = np.ones(12)
        for _ in range(3000):
            weighted = lights / gamma[:, None]
            posterior = np.linalg.inv(lights.T @ weighted + RIDGE * np.eye(3))
            solution = posterior @ weighted.T @ pixel
            gamma = (pixel - lights @ solution) ** 2 + np.einsum(
                "fi,ij,fj->f", lights, posterior, lights
            )
            gamma = gamma.clip(SMALLEST_VARIANCE)
        assert_allclose(b, solution, rtol=1e-5)


def test_l1_is_the_linear_programme_s_optimum(rng):
    lights = unit(rng.normal(size=(10, 3)) * (0.4, 0.4, 0.1) + (0, 0, 1))
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


@parametrize("count, dropped", [(3, 0), (4, 0), (5, 0), (6, 1), (10, 2), (96, 19)])
def test_trimmed_ends(count, dropped, rng):
    """Moving a trimmed observation further out changes nothing; moving the next one does."""
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


def test_lights_that_span_a_plane_or_a_line_give_finite_normals(rng):
    """Three directions, each many times: under IW12's weights one of them may drop out, then
    another.
    """
    for spanned in (1, 2, 3):
        rows = rng.normal(size=(spanned, 3)) * (0.4, 0.4, 0.1) + (0, 0, 1)
        lights = unit(rows)[np.arange(12) % spanned]
        observations = np.float32(rng.uniform(size=(2000, 12)))
        for name in ROBUST:
            found = estimate(name, observations, lights)
            assert_unit(found)


def test_weighted_step_against_lapack(rng):
    lights, observations = rng.normal(size=(7, 3)), rng.uniform(size=(5, 7))
    weight = 10.0 ** rng.uniform(-6, 6, (5, 7))
    solution, covariance = weighted_least_squares(
        *(torch.tensor(a) for a in (observations, lights, weight))
    )
    for i in range(5):
        root = np.sqrt(weight[i])[:, None]
        expected = np.linalg.lstsq(root * lights, root[:, 0] * observations[i], rcond=None)[0]
        assert_allclose(solution[i], expected, rtol=1e-6)
        inverse = np.linalg.inv((root * lights).T @ (root * lights))
        entries = inverse[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        assert_allclose(covariance[:, i], entries, rtol=1e-5, atol=1e-9 * np.trace(inverse))


@parametrize("rank", [0, 1, 2])
def test_inverse_of_a_singular_matrix_is_positive(rank, rng):
    factors = rng.normal(size=(3, rank, 100))
    entries = [
        (factors[i] * factors[j]).sum(axis=0)
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ]
    inverted = np.stack(inverse_3x3(entries, 1e-6))
    assert np.isfinite(inverted).all() and (inverted[:3] > 0).all()


def normals_under(limit_deg, count):
    return torch.tensor(cap_directions(count, limit_deg), dtype=torch.float32)


def ring(count, zenith_deg):
    return torch.tensor(ring_lights(count, zenith_deg, 0.1), dtype=torch.float32)


def error_deg(scaled_normals, truth):
    return angle_between_deg(
        torch.nn.functional.normalize(scaled_normals, dim=1).numpy(), truth.numpy()
    )


def to_unit_scale(observations):
    return observations / observations.amax(dim=1, keepdim=True)


def test_shadows_over_a_third_of_the_lights_are_seen_through():
    truth, lights = normals_under(25, 500), ring(12, 40)
    observations = truth @ lights.T
    # Four neighbours of the ring lie in cast shadow, elsewhere for every pixel.
    first = torch.arange(len(truth)) % 12
    shadowed = (torch.arange(12) - first[:, None]) % 12 < 4
    observations = to_unit_scale(observations.masked_fill(shadowed, 0.0))
    plain = observations @ torch.linalg.pinv(lights).T
    assert error_deg(plain, truth).mean() > 5
    assert error_deg(fit_lambertian(observations, lights), truth).max() < 0.5


def test_a_highlight_counts_less_than_in_least_squares():
    truth, lights = normals_under(20, 200), ring(12, 40)
    observations = truth @ lights.T
    observations[:, 3] *= 2
    observations = to_unit_scale(observations)
    plain = error_deg(observations @ torch.linalg.pinv(lights).T, truth)
    assert plain.mean() > 4
    assert error_deg(fit_lambertian(observations, lights), truth).mean() < 0.1 * plain.mean()


LIGHTS = torch.tensor(spiral_lights(10, 55))
SIGNS = alternating_signs(LIGHTS)


def noisy_pixels(lights, noise):
    """Normals (2000, 3) of matte pixels that no light leaves dark, and their observations (2000,
    F).
    """
    generator = seeded(2)
    across = 0.6 * (torch.rand(2000, 2, generator=generator, dtype=torch.float64) - 0.5)
    normals = normalize(pad(across, (0, 1), value=1.0), dim=1)
    errors = torch.randn(2000, len(lights), generator=generator, dtype=torch.float64)
    return normals, 0.4 * normals @ lights.T + 0.4 * noise * errors


def test_the_change_is_half_the_difference_of_two_halves():
    """On a ring, the sums over either half are the same. So least squares with one half is the
    oracle.
    """
    lights = torch.tensor(ring_lights(8, 40, np.radians(30)))
    _, observations = noisy_pixels(lights, 0.001)
    first, second = (
        normalize(observations[:, half::2] @ torch.linalg.pinv(lights[half::2]).T, dim=1)
        for half in (0, 1)
    )
    expected = (first - second) / 2
    found = compare_halves(observations, lights, alternating_signs(lights))
    assert_close(found.normals, normalize(first + second, dim=1), atol=1e-5, rtol=0)
    # Along the normal, it is the albedo's.
    change = found.change - (found.change * found.normals).sum(dim=1, keepdim=True) * found.normals
    differences = ((change - expected).abs().amax(), (change + expected).abs().amax())
    assert min(differences) < 0.02 * expected.abs().max()


@parametrize("square", [False, True])
@parametrize("count", [4, 5, 10, 40])
def test_noise_is_as_large_as_the_random_errors(count, square):
    """Also on a ring of four lights, whose residuals alternate as the signs of the halves do."""
    lights = torch.tensor(ring_lights(count, 35) if square else spiral_lights(count, 55))
    truth, observations = noisy_pixels(lights, 0.01)
    found = compare_halves(observations, lights, alternating_signs(lights))
    noise, error = (
        values.square().sum(dim=1).mean().sqrt() for values in (found.noise, found.normals - truth)
    )
    assert noise == pytest.approx(float(error), rel=0.07)  # means of 2,000 squares


def test_errors_that_all_pixels_share_are_no_noise():
    """Wrong intensities turn all normals alike. What the halves disagree about is as smooth as the
    normals are.
    """
    truth, observations = noisy_pixels(LIGHTS, 0.0)
    noise = compare_halves(observations * torch.linspace(0.8, 1.3, 10), LIGHTS, SIGNS).noise
    assert noise.abs().mean() > 0.01
    fitted = truth @ torch.linalg.lstsq(truth, noise).solution
    assert (noise - fitted).abs().mean() < 0.1 * noise.abs().mean()


def test_the_order_of_the_lights_changes_nothing():
    _, observations = noisy_pixels(LIGHTS, 0.01)
    found = compare_halves(observations, LIGHTS, SIGNS)
    order = torch.randperm(10, generator=seeded(3))
    for other in (
        compare_halves(observations[:, order], LIGHTS[order], alternating_signs(LIGHTS[order])),
        compare_halves(observations, LIGHTS.expand(len(observations), -1, -1), SIGNS),
    ):
        assert_close(tuple(other), tuple(found))


def test_three_lights_and_black_pixels_disagree_about_nothing():
    found = compare_halves(noisy_pixels(LIGHTS[:3], 0.01)[1], LIGHTS[:3], SIGNS[:3])
    assert found.change.abs().max() < 1e-6
    assert found.noise.isfinite().all()
    assert not torch.cat(
        compare_halves(torch.zeros(2, 10, dtype=torch.float64), LIGHTS, SIGNS), dim=1
    ).any()
