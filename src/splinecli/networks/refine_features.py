"""What the refinement net reads of each pixel: its estimated normal and error, and how its observations fit them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from splinecli.fits.lambertian import SHADOW_SHARE, fit_lambertian
from splinecli.fits.two_halves import compare_halves
from splinecli.fits.weighted_least_squares import weighted_sum
from splinecli.observation_map import dot, map_scale

VECTORS = ((0, 1), (3, 4), (6, 7), (9, 10), (11, 12), (24, 25))
"""Channels that hold the x and y of vectors, and turn with the image."""

TENSOR = (13, 14, 15)
"""Channels that hold the xx, yy and xy of the lights' second moments."""

PLAIN = slice(6, 9)
"""Channels that hold the normal of least squares, minus the estimated one."""

HALVES = slice(24, 27)
"""Channels in which two halves of the lights are compared. Their sign means nothing."""

NOISE = slice(27, 28)
"""The channel that the net does not read. It serves restore_detail of networks/detail.py."""

READ = 27
CHANNELS = 28
MEDIAN, SHAPE = 16, 17
"""Channels that hold the two numbers of the error's distribution; see networks/error_head.py."""

_MEDIAN_OFFSET = 3.0  # brings the logarithm of usual errors in radians near zero
_LARGEST_LOG = 4.0
_HALVES_SCALE = 3.0  # brings these small numbers near the others


@torch.no_grad()
def refine_features(
    observations: Tensor,
    light_directions: Tensor,
    normals: Tensor,
    error: Tensor,
    reference: float,
    signs: Tensor,
) -> Tensor:
    """Return the features (P, CHANNELS) of pixels, each about -1 to 1.

    0 to 2: the estimated normal. 3 to 8: the normals of the robust Lambertian fit and of least squares, minus it.
    9, 10: x and y of the mean light direction, weighted by what a matte surface with this normal does not explain.
    11 to 15: mean and second moments of the lights' x and y. 16, 17: the error's distribution. 18: logarithm of the
    largest observation, relative to the capture. 19, 20: mean and standard deviation over the largest. 21: root mean
    square of what is not explained. 22: share of dark observations. 23: logarithm of the number of lights. 24 to 26:
    how two halves of the lights differ, and 27: the noise of least squares that follows; see fits/two_halves.py.

    Args:
        observations: (P, F), linear, divided by the light intensities.
        light_directions: (F, 3) or (P, F, 3), unit.
        normals: (P, 3), unit.
        error: (P, 2), see networks/error_head.py.
        reference: the brightness of the capture, see `brightness`.
        signs: (F,), the halves of the capture's lights, see alternating_signs of fits/two_halves.py.
    """
    scale = map_scale(observations)
    observed = observations / scale
    count = observed.shape[1]
    robust = torch.nn.functional.normalize(fit_lambertian(observed, light_directions), dim=-1)
    halves = compare_halves(observed.double(), light_directions.double(), signs)
    plain, change, noise = (found.to(observed) for found in halves)
    cosine = dot(normals, light_directions).clamp_(min=0)
    # Products with ones are faster than sums over so few columns.
    mean = observed.new_full((count, 1), 1 / count)
    albedo = (observed * cosine) @ mean / (cosine.square() @ mean).clamp(min=1e-4 / count)
    unexplained = observed - albedo.clamp(0, 4) * cosine
    across = light_directions[..., :2]
    x, y = across.unbind(-1)
    moments = torch.stack((x, y, x * x, y * y, x * y), dim=-1).mean(dim=-2)
    level = observed @ mean
    return torch.cat(
        (
            normals,
            robust - normals,
            plain - normals,
            4 / count * weighted_sum(unexplained, across),
            moments.expand(len(observed), -1),
            error[:, :1] + _MEDIAN_OFFSET,
            error[:, 1:] - 1,
            (scale / reference).log().clamp(-_LARGEST_LOG, _LARGEST_LOG) / 2,
            level,
            ((observed - level).square() @ mean * (count / (count - 1))).sqrt(),
            3 * (unexplained.square() @ mean).sqrt(),
            (observed < SHADOW_SHARE).to(observed.dtype) @ mean,
            torch.full_like(scale, math.log(count / 10)),
            (_HALVES_SCALE * change).clamp(-1, 1),
            noise.clamp(-1, 1),
        ),
        dim=1,
    )


def brightness(observations: Tensor) -> float:
    """Return the brightness of a capture: the median over its pixels (P, F) of the largest observation."""
    return max(float(observations.amax(dim=1).median()), 1e-12)


def split_features(features: Tensor) -> tuple[Tensor, Tensor]:
    """Return normals (B, 3, H, W) and error (B, 2, H, W) from maps of features (B, CHANNELS, H, W)."""
    offset = features.new_tensor((-_MEDIAN_OFFSET, 1.0))[:, None, None]
    return features[:, :3], features[:, MEDIAN : SHAPE + 1] + offset


class Turn(NamedTuple):
    """A mirror image (x is flipped) if `mirror`, then a turn counterclockwise by `quarters` of 360 degrees."""

    quarters: int
    mirror: bool = False

    @property
    def back(self) -> Turn:
        """The turn that undoes this one. A turned mirror image undoes itself."""
        return self if self.mirror else Turn(-self.quarters % 4)


def turn_features(features: Tensor, turn: Turn) -> Tensor:
    """Turn maps of features (..., CHANNELS, H, W)."""
    return turn_maps(features, turn, VECTORS, (TENSOR,))


def turn_maps(
    maps: Tensor,
    turn: Turn,
    vectors: Sequence[tuple[int, int]] = (),
    tensors: Sequence[tuple[int, int, int]] = (),
) -> Tensor:
    """Turn maps (..., C, H, W), of which some channels are x and y of vectors, or xx, yy and xy of tensors."""
    if turn.mirror:
        maps = maps.flip(-1)
        for odd in (*(x for x, _ in vectors), *(xy for _, _, xy in tensors)):
            maps[..., odd, :, :].neg_()
    for _ in range(turn.quarters % 4):
        old = maps.rot90(1, (-2, -1))
        maps = old.clone()
        for x, y in vectors:
            maps[..., x, :, :], maps[..., y, :, :] = -old[..., y, :, :], old[..., x, :, :]
        for xx, yy, xy in tensors:
            maps[..., xx, :, :], maps[..., yy, :, :] = old[..., yy, :, :], old[..., xx, :, :]
            maps[..., xy, :, :] = -old[..., xy, :, :]
    return maps
