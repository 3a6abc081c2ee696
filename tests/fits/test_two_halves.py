"""What two halves of the lights disagree about: random errors, and nothing else."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from scenes import directions_at, spiral_lights
from splinecli.fits.least_squares import alternating_signs, compare_halves

LIGHTS = torch.tensor(spiral_lights(10, 55))
SIGNS = alternating_signs(LIGHTS)


def noisy_pixels(lights: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Normals (2000, 3) of matte pixels that no light leaves dark, and their observations (2000, F)."""
    generator = torch.Generator().manual_seed(2)
    across = 0.6 * (torch.rand(2000, 2, generator=generator, dtype=torch.float64) - 0.5)
    normals = normalize(pad(across, (0, 1), value=1.0), dim=1)
    errors = torch.randn(2000, len(lights), generator=generator, dtype=torch.float64)
    return normals, 0.4 * normals @ lights.T + 0.4 * noise * errors


def test_the_change_is_half_the_difference_of_two_halves() -> None:
    """On a ring, the sums over either half are the same. So least squares with one half is the oracle."""
    lights = torch.tensor(directions_at(np.radians(30 + 45 * np.arange(8)), np.radians(40)))
    _, observations = noisy_pixels(lights, 0.001)
    first, second = (
        normalize(observations[:, half::2] @ torch.linalg.pinv(lights[half::2]).T, dim=1) for half in (0, 1)
    )
    expected = (first - second) / 2
    found = compare_halves(observations, lights, alternating_signs(lights))
    torch.testing.assert_close(found.normals, normalize(first + second, dim=1), atol=1e-5, rtol=0)
    # Along the normal, it is the albedo's.
    change = found.change - (found.change * found.normals).sum(dim=1, keepdim=True) * found.normals
    differences = ((change - expected).abs().amax(), (change + expected).abs().amax())
    assert min(differences) < 0.02 * expected.abs().max()


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("count", [4, 5, 10, 40])
def test_noise_is_as_large_as_the_random_errors(count: int, square: bool) -> None:
    """Also on a ring of four lights, whose residuals alternate as the signs of the halves do."""
    ring = directions_at(2 * np.pi * np.arange(count) / count, np.radians(35))
    lights = torch.tensor(ring if square else spiral_lights(count, 55))
    truth, observations = noisy_pixels(lights, 0.01)
    found = compare_halves(observations, lights, alternating_signs(lights))
    noise, error = (values.square().sum(dim=1).mean().sqrt() for values in (found.noise, found.normals - truth))
    assert noise == pytest.approx(float(error), rel=0.07)  # means of 2,000 squares


def test_errors_that_all_pixels_share_are_no_noise() -> None:
    """Wrong intensities turn all normals alike. What the halves disagree about is as smooth as the normals are."""
    truth, observations = noisy_pixels(LIGHTS, 0.0)
    noise = compare_halves(observations * torch.linspace(0.8, 1.3, 10), LIGHTS, SIGNS).noise
    assert noise.abs().mean() > 0.01
    fitted = truth @ torch.linalg.lstsq(truth, noise).solution
    assert (noise - fitted).abs().mean() < 0.1 * noise.abs().mean()


def test_the_order_of_the_lights_changes_nothing() -> None:
    _, observations = noisy_pixels(LIGHTS, 0.01)
    found = compare_halves(observations, LIGHTS, SIGNS)
    order = torch.randperm(10, generator=torch.Generator().manual_seed(3))
    for other in (
        compare_halves(observations[:, order], LIGHTS[order], alternating_signs(LIGHTS[order])),
        compare_halves(observations, LIGHTS.expand(len(observations), -1, -1), SIGNS),
    ):
        torch.testing.assert_close(tuple(other), tuple(found))


def test_three_lights_and_black_pixels_disagree_about_nothing() -> None:
    found = compare_halves(noisy_pixels(LIGHTS[:3], 0.01)[1], LIGHTS[:3], SIGNS[:3])
    assert found.change.abs().max() < 1e-6
    assert found.noise.isfinite().all()
    assert not torch.cat(compare_halves(torch.zeros(2, 10, dtype=torch.float64), LIGHTS, SIGNS), dim=1).any()
