"""The faults of a capture, each against the distribution that it states."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from distributions import SHARE, N, assert_uniform, generator
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.transfer import decode_transfer
from splinecli.synthesis.batches import (
    BITS,
    add_sensor_noise,
    disturb_light_directions,
    disturb_light_intensities,
    draw_exposure,
    draw_light_intensities,
    quantise,
    restore,
)


def tilted_lights(pixels: int, lights: int) -> Tensor:
    directions = torch.randn(pixels, lights, 3, generator=generator(3))
    directions[..., 2] = directions[..., 2].abs() + 0.5
    return torch.nn.functional.normalize(directions, dim=-1)


def test_errors_of_light_directions() -> None:
    directions = tilted_lights(4000, 40)
    moved = disturb_light_directions(directions, 0.6, generator())
    torch.testing.assert_close(moved.norm(dim=-1), torch.ones(4000, 40))
    assert (moved[..., 2] > 0).all()
    error = angle_between_deg(moved.numpy(), directions.numpy())
    # A pixel's angles have two components of its sigma each: sigma^2 is half of their mean square.
    sigma = np.sqrt((error**2).mean(axis=1) / 2)
    disturbed = sigma > 1e-6
    assert disturbed.mean() == pytest.approx(0.6, abs=0.03)
    # Sigma itself is estimated from 80 numbers, to 8 per cent.
    assert stats.kstest(sigma[disturbed], lambda x: (x / 8).clip(0, 1) ** (1 / 3)).statistic < 0.04
    assert 6 < sigma.max() < 10
    np.testing.assert_allclose(disturb_light_directions(directions, 0.0, generator()), directions, atol=1e-6)


def test_errors_of_light_intensities() -> None:
    observations = torch.rand(4000, 100, generator=generator(3)) + 0.5
    factor = (disturb_light_intensities(observations, 0.6, generator()) / observations).numpy()
    sigma = np.sqrt(((factor - 1) ** 2).mean(axis=1))
    disturbed = sigma > 1e-5
    assert disturbed.mean() == pytest.approx(0.6, abs=0.03)
    assert stats.kstest(sigma[disturbed], stats.uniform(0, 0.05).cdf).statistic < 0.04
    assert factor[disturbed].mean() == pytest.approx(1, abs=1e-3)
    assert torch.equal(disturb_light_intensities(observations, 0.0, generator()), observations)


def test_exposure() -> None:
    radiance = torch.rand(N, 5, generator=generator(3)) * 30
    brightest = (radiance * draw_exposure(radiance, 0.25, generator())).amax(dim=1)
    over = brightest > 1
    assert over.float().mean().item() == pytest.approx(0.25, abs=SHARE)
    assert_uniform(brightest[over], 1, 3)
    dark = brightest < 10**-1.3
    # U(-2.7, -0.7) for 40 %: seven tenths of it lie below -1.3.
    assert dark[~over].float().mean().item() == pytest.approx(0.4 * 0.7, abs=SHARE)
    assert_uniform(brightest[dark].log10(), -2.7, -1.3)
    assert brightest.min() >= 10**-2.7 * 0.999
    unclipped = (radiance * draw_exposure(radiance, 0.0, generator())).amax(dim=1)
    assert unclipped.max() <= 1 + 1e-6
    assert torch.isfinite(draw_exposure(torch.zeros(3, 5), 0.5, generator())).all()


def mean_square_of_power(low: float, high: float) -> float:
    """E[(10^U(low, high))^2]."""
    return (10 ** (2 * high) - 10 ** (2 * low)) / (2 * math.log(10) * (high - low))


@pytest.mark.parametrize("level", [0.5, 0.1])
def test_sensor_noise(level: float) -> None:
    noisy = add_sensor_noise(torch.full((N, 20), level), generator())
    expected = mean_square_of_power(-4, -2.5) + level * mean_square_of_power(-3.5, -2)
    variance = (noisy.double() - level).square().mean().item()
    assert variance == pytest.approx(expected, rel=0.05)
    assert noisy.double().mean().item() == pytest.approx(level, abs=1e-4)


def is_multiple(values: Tensor, steps: float) -> Tensor:
    """Whether all values (P, F) of a pixel are multiples of 1 / steps."""
    return ((values * steps - (values * steps).round()).abs() < 1e-6).all(dim=1)


def test_quantisation() -> None:
    exposed = torch.rand(N, 8, generator=generator(3), dtype=torch.float64)
    quantised = quantise(exposed, 0.3, generator())
    decoded = torch.from_numpy(decode_transfer(np.arange(256, dtype=np.float32) / 255, None)).double()
    of_srgb = (quantised[..., None] - decoded).abs().amin(dim=2).amax(dim=1) < 1e-6
    eight = is_multiple(quantised, 255)
    assert of_srgb.double().mean().item() == pytest.approx(0.15, abs=SHARE)
    assert eight.double().mean().item() == pytest.approx(0.15, abs=SHARE)
    error = quantised - exposed
    # The high byte of 16 is up to a step of 255 too dark or, as 256 steps become 255, a little too bright.
    cut = eight & (error.abs().amax(dim=1) > 0.5001 / 255)
    assert 0.06 < cut.double().mean().item() <= 0.075 + SHARE
    assert (error[cut].mean() * 255).item() == pytest.approx(0, abs=0.02)
    assert error[eight & ~cut].abs().max().item() <= 0.5001 / 255
    for bits in BITS:
        other = is_multiple(quantised, 2**bits - 1) & ~eight & ~of_srgb
        assert other.double().mean().item() == pytest.approx(0.7 / 4, abs=SHARE)
        assert error[other].abs().max().item() == pytest.approx(0.5 / (2**bits - 1), rel=0.01)
    assert (quantise(exposed, 0.0, generator()) - exposed).abs().max() <= 0.5 / 1023 + 1e-9


def test_light_intensities() -> None:
    intensities = draw_light_intensities(N, 10, 0.4, generator())
    assert intensities.amax(dim=1).sub(1).abs().max() == 0
    unequal = intensities.amin(dim=1) < 1
    assert unequal.float().mean().item() == pytest.approx(0.4, abs=SHARE)
    # The largest of ten of 2^U(-2, 0) is 2^-0.18 on average, so all others are below the range's upper end by that.
    assert intensities.min() >= 0.25
    assert not (draw_light_intensities(N, 10, 0.0, generator()) != 1).any()


def test_restoring_half_of_the_clipped_pixels() -> None:
    lights = tilted_lights(400, 12)
    normals = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator(5)) * 0.3 + torch.tensor((0, 0, 1)))
    truth = (lights * normals[:, None]).sum(dim=2).clamp(min=0)
    truth = 1.4 * truth / truth.amax(dim=1, keepdim=True)
    valid = torch.arange(12).expand(400, 12) < 10
    clipped = (truth > 1) & valid
    stored = truth.clamp(max=1) * valid
    restored = restore(stored, clipped, lights, valid, generator())
    changed = (restored != stored).any(dim=1)
    assert changed.float().mean().item() == pytest.approx(0.5, abs=0.08)
    assert not (restored != stored)[~clipped].any()
    # Seven matte observations determine the others.
    known = changed & ((valid & ~clipped).sum(dim=1) >= 7)
    assert known.sum() > 20
    assert (restored - truth)[known][clipped[known]].abs().max() < 0.02
