"""Detail that the refinement net smooths away although it is real.

The net relies on the errors that SPLINE-Net predicts. Many of these are the same everywhere, for example those from
wrong light intensities, and contain no information about detail. Real detail agrees between two halves of the lights;
noise does not.
"""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from splinecli.networks.refine_net import gaussian_sum, reach_of, unit_maps
from splinecli.refinement.halving import enlarge

FINE = 1.5  # detail is the part that a Gaussian filter with this sigma in pixels removes
WINDOW = 3.0  # detail is compared in a Gaussian window with this sigma in pixels
REACH = reach_of(FINE) + reach_of(WINDOW)  # no pixel further away than this changes a result
FEWEST_LIGHTS = 6  # fewer have no residuals, or hardly any, and so do not show noise well

_LEAST_REAL, _SURELY_REAL = 0.7, 0.9
"""Share of the missing detail's energy that is signal. Below the first number nothing is restored, above the second
all."""

_TINY = 1e-12


def restore_detail(refined: Tensor, estimated: Tensor, least_squares: Tensor, noise: Tensor, mask: Tensor) -> Tensor:
    """Add detail to refined normals that the refinement net removed although it is real.

    The detail comes from SPLINE-Net's normals. It is considered real where the additional detail of least squares is
    clearly larger than its noise, and to the extent that both agree. Images that are shifted towards their lights, by
    half a pixel for example, have the same effect as detail.

    Args:
        refined, estimated, least_squares: (3, H, W), unit normals. At least FEWEST_LIGHTS lights gave the last ones.
        noise: (1, H, W), of least squares; see fits/least_squares.py.
        mask: (1, H, W), 1 inside, else 0. The other maps are zero outside.

    Returns:
        Unit normals (3, H, W), zero outside the mask. Black pixels stay as they are.
    """
    mask = mask * least_squares.any(dim=0)  # black pixels carry no information
    removed, missing, noise = (_detail(maps, mask) for maps in (estimated - refined, least_squares - refined, noise))
    alike = _energy(removed, missing) / (_energy(removed, removed) * _energy(missing, missing)).sqrt()
    return unit_maps(refined + _real_share(missing, noise) * alike * removed)


def restore_octave(
    enlarged: Tensor, estimated: Tensor, least_squares: Tensor, noise: Tensor, largest: Tensor, mask: Tensor
) -> Tensor:
    """Add detail to normals from half the resolution, taken from SPLINE-Net's normals where it is real.

    Detail is the part of the normals that is lost when they are halved, as by HalfCapture, and enlarged again (Burt and
    Adelson, The Laplacian pyramid as a compact image code, 1983). It is considered real where the detail of least
    squares is clearly larger than its noise.

    Args:
        enlarged: (3, H, W), unit, from half the resolution.
        estimated, least_squares, noise, mask: see restore_detail. The maps begin at even rows and columns.
        largest: (1, H, W), the largest observation of each pixel. Bright pixels get more weight than dark ones.

    Returns:
        Unit normals (3, H, W), zero outside the mask.
    """
    mask = mask * least_squares.any(dim=0)
    largest = largest * mask
    detail, missing = ((maps - unit_maps(_without_octave(maps, largest))) * mask for maps in (estimated, least_squares))
    noise = (noise - _without_octave(noise, largest)) * mask
    return unit_maps(enlarged + _real_share(missing * largest, noise * largest) * detail)


def _real_share(missing: Tensor, noise: Tensor) -> Tensor:
    """Return the share (H, W) of missing detail (3, H, W) to restore, given the noise (1, H, W) in it."""
    real = 1 - _energy(noise, noise) / _energy(missing, missing)
    return ((real - _LEAST_REAL) / (_SURELY_REAL - _LEAST_REAL)).clamp(0, 1)


def _energy(one: Tensor, other: Tensor) -> Tensor:
    return gaussian_sum((one * other).sum(dim=0), WINDOW).clamp(min=_TINY)


def _detail(maps: Tensor, mask: Tensor) -> Tensor:
    """Return the detail of maps (C, H, W), zero outside the mask, whatever they are there."""
    maps = maps * mask
    return maps - gaussian_sum(maps, FINE) / gaussian_sum(mask, FINE).clamp(min=_TINY) * mask


def _without_octave(maps: Tensor, weights: Tensor) -> Tensor:
    """Return maps (C, H, W) after weighted means of 2 x 2 pixels, enlarged again."""
    height, width = maps.shape[-2:]
    sums = avg_pool2d(torch.cat((maps * weights, weights))[None], 2, ceil_mode=True)[0]
    return enlarge(sums[:-1] / sums[-1:].clamp(min=_TINY), sums[-1] > 0)[:, :height, :width]
