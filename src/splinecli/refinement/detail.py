"""Detail that the refinement net smooths away although it is real.

The net judges by the errors that SPLINE-Net expects. Many of these are the same all around, such as those of wrong
light intensities, and say nothing about detail. Real detail agrees between two halves of the lights; noise does not.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import normalize

from splinecli.networks.gaussian import gaussian_sum, reach_of
from splinecli.networks.refine_channels import channels

FINE = 1.5
"""Detail is what a Gaussian filter with this sigma in pixels removes."""

WINDOW = 3.0
"""Detail is compared in a Gaussian window with this sigma in pixels."""

REACH = reach_of(FINE) + reach_of(WINDOW)
"""No pixel further away than this changes a result."""

FEWEST_LIGHTS = 6
"""Fewer have no residuals, or hardly any, and so do not show noise well."""

_LEAST_REAL, _SURELY_REAL = 0.7, 0.9
"""Share of the energy of missing detail that is no noise. Below the first number nothing is restored, above the second
all."""

_TINY = 1e-12


def restore_detail(refined: Tensor, features: Tensor, mask: Tensor) -> Tensor:
    """Add detail to refined normals that the refinement net removed although it is real.

    It is the detail of SPLINE-Net's normals. It counts as real where the detail that least squares has in addition is
    clearly larger than its noise, and as far as both agree. Images that are shifted towards their lights, by half a
    pixel for example, look the same as detail.

    Args:
        refined: (3, H, W), unit.
        features: (CHANNELS, H, W) of at least FEWEST_LIGHTS lights, see refine_features.
        mask: (1, H, W), 1 inside, else 0. The other maps are zero outside.

    Returns:
        Unit normals (3, H, W), zero outside the mask. Black pixels stay as they are.
    """
    normals, least_squares = features[:3], features[:3] + features[channels("plain")]
    mask = mask * least_squares.any(dim=0)  # black pixels show nothing
    removed, missing, noise = (
        _detail(maps, mask) for maps in (normals - refined, least_squares - refined, features[channels("noise")])
    )

    def energy(one: Tensor, other: Tensor) -> Tensor:
        return gaussian_sum((one * other).sum(dim=0), WINDOW).clamp(min=_TINY)

    real = 1 - energy(noise, noise) / energy(missing, missing)
    real = ((real - _LEAST_REAL) / (_SURELY_REAL - _LEAST_REAL)).clamp(0, 1)
    alike = energy(removed, missing) / (energy(removed, removed) * energy(missing, missing)).sqrt()
    return normalize(refined + real * alike * removed, dim=0)


def _detail(maps: Tensor, mask: Tensor) -> Tensor:
    """Return the detail of maps (C, H, W), zero outside the mask, whatever they are there."""
    maps = maps * mask
    return maps - gaussian_sum(maps, FINE) / gaussian_sum(mask, FINE).clamp(min=_TINY) * mask
