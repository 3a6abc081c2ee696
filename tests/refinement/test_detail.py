"""Detail that is restored after the refinement net: only where it is real."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from conftest import directions_at, spiral_lights
from splinecli.fits.least_squares import alternating_signs
from splinecli.networks.refine_net import CHANNELS, channels
from splinecli.refinement.detail import REACH, restore_detail
from splinecli.refinement.features import refine_features

SIDE = 48
LIGHTS = torch.tensor(spiral_lights(10, 55), dtype=torch.float32)
SQUARE = torch.tensor(directions_at(np.radians(90 * np.arange(4)), np.radians(40)), dtype=torch.float32)
FLAT = torch.tensor((0.0, 0.0, 1.0))[:, None, None].repeat(1, SIDE, SIDE)
EVERYWHERE = torch.ones(1, SIDE, SIDE)

SLOPE = 0.2 * (1 - 2.0 * (torch.arange(SIDE) % 2)).expand(SIDE, SIDE)
GROOVES = normalize(torch.stack((-SLOPE, torch.zeros_like(SLOPE), torch.ones_like(SLOPE))), dim=0)
"""True normals of grooves of one pixel."""


def photographed(truth: Tensor, noise: float, lights: Tensor = LIGHTS, *, seen: Tensor | None = None) -> Tensor:
    """Features (CHANNELS, SIDE, SIDE) of a matte surface, where SPLINE-Net has seen the normals `seen` (the truth)."""
    generator = torch.Generator().manual_seed(4)
    errors = noise * torch.randn(SIDE**2, len(lights), generator=generator)
    observations = (truth.flatten(1).T @ lights.T + errors).clamp(min=0)
    normals = (truth if seen is None else seen).flatten(1).T
    signs = alternating_signs(lights)
    features = refine_features(observations, lights, normals, torch.zeros(SIDE**2, 2), 1.0, signs)
    return features.T.reshape(CHANNELS, SIDE, SIDE)


def photographed_with_noise(truth: Tensor, noise: float, lights: Tensor = LIGHTS) -> Tensor:
    """The same features where SPLINE-Net has the noise of least squares."""
    features = photographed(truth, noise, lights)
    features[:3] += features[channels("plain")]
    features[channels("plain")] = 0
    return features


def restored(refined: Tensor, features: Tensor, mask: Tensor) -> Tensor:
    """What restore_detail makes of refined normals and features."""
    normals = features[channels("normal")]
    return restore_detail(refined, normals, normals + features[channels("plain")], features[channels("noise")], mask)


@pytest.mark.parametrize(("noise", "least", "most"), [(0.005, 0.975, 0.985), (0.03, 0.9, 0.985), (0.4, -0.001, 0.01)])
def test_grooves_come_back_where_they_exceed_the_noise(noise: float, least: float, most: float) -> None:
    """All of x comes back. Its share of the unit vector is smaller by the cosine, because z is no detail."""
    found = restored(FLAT, photographed(GROOVES, noise), EVERYWHERE)
    middle = slice(REACH, -REACH)  # near the border, the mean around a pixel has more of one side
    assert least < float((found[0] / GROOVES[0])[:, middle].mean()) < most


def test_nothing_comes_back_that_least_squares_does_not_show() -> None:
    """SPLINE-Net has seen the opposite of the grooves."""
    features = photographed(GROOVES, 0.005, seen=torch.roll(GROOVES, 1, dims=-1))
    torch.testing.assert_close(restored(FLAT, features, EVERYWHERE), FLAT, atol=1e-4, rtol=0)


@pytest.mark.parametrize("creased", [False, True])
@pytest.mark.parametrize("lights", [LIGHTS, LIGHTS[:6], SQUARE])
def test_noise_stays_removed(lights: Tensor, creased: bool) -> None:
    """Also beside a crease, which is detail that is not missing."""
    slope = torch.where(torch.arange(SIDE) < SIDE // 2, 0.4, -0.4).expand(SIDE, SIDE)
    crease = normalize(torch.stack((-slope, torch.zeros_like(slope), torch.ones_like(slope))), dim=0)
    truth = crease if creased else FLAT
    noisy = photographed_with_noise(truth, 0.03, lights)
    found = restored(truth, noisy, EVERYWHERE)
    assert (found - truth).square().mean() < 0.01 * (noisy[:3] - truth).square().mean()


def test_black_pixels_change_nothing_beside_them() -> None:
    """Their zero vectors are no detail."""
    black = torch.arange(SIDE) < SIDE // 2
    truth = torch.where(black, 0.0, FLAT)
    noisy = photographed_with_noise(truth, 0.03)
    noisy[:, :, black] = 0
    found = restored(FLAT, noisy, EVERYWHERE)
    torch.testing.assert_close(found[..., black], FLAT[..., black])
    assert (found - FLAT).square().mean() < 0.01 * (noisy[:3] - truth).square().mean()


def test_outside_of_the_mask_is_outside_of_the_image() -> None:
    wide = (9, 3, 4, 8)
    mask = torch.rand(1, SIDE, SIDE, generator=torch.Generator().manual_seed(6)) < 0.9
    maps = FLAT * mask, photographed(GROOVES, 0.05) * mask, mask.float()
    alone, within = restored(*maps), restored(*(pad(values, wide) for values in maps))
    assert (alone - FLAT * mask).abs().mean() > 0.03
    torch.testing.assert_close(within, pad(alone, wide), atol=1e-5, rtol=0)


def test_nothing_beyond_the_reach_counts() -> None:
    features = photographed(GROOVES, 0.02)
    changed = features.clone()
    changed[:3, :, -1] += 0.5
    before, after = (restored(FLAT, values, EVERYWHERE) for values in (features, changed))
    difference = (before - after).abs().amax(dim=(0, 1))
    assert difference[: SIDE - 1 - REACH].max() == 0
    assert difference[SIDE - 2] > 0
