"""Inputs of the refinement net for each pixel: its estimated normal and error, and how its
observations fit them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.estimate.fits import least_squares
from splinecli.estimate.fits.least_squares import TwoHalves, weighted_sum
from splinecli.estimate.networks.refine_net import FEATURE_WIDTHS, MEDIAN_OFFSET, TENSOR, VECTORS
from splinecli.maths.observation_map import dot, map_scale
from splinecli.maths.robust import SHADOW_SHARE


@torch.no_grad()
def refine_features(
    observations: Tensor,
    light_directions: Tensor,
    normals: Tensor,
    error: Tensor,
    reference: float,
    signs: Tensor,
) -> Tensor:
    """Return the features (P, FEATURE_CHANNELS) of pixels in the order of FEATURE_WIDTHS, each
    about -1 to 1.

    The observations (P, F) are linear, divided by the light intensities. The light directions (F,
    3) or (P, F, 3) and the normals (P, 3) are unit. See networks/li_ne_net.py for the error (P, 2),
    `brightness` for the reference, and alternating_signs of fits/least_squares.py for the signs
    (F,), the halves of the capture's lights.
    """
    scale = map_scale(observations)
    observed = observations / scale
    count = observed.shape[1]
    robust = normalize(least_squares.fit_lambertian(observed, light_directions), dim=-1)
    plain, change, noise = two_halves(observed, light_directions, signs)
    cosine = dot(normals, light_directions).clamp_(min=0)
    # Products with ones are faster than sums over so few columns.
    mean = observed.new_full((count, 1), 1 / count)
    albedo = (observed * cosine) @ mean / (cosine.square() @ mean).clamp(min=1e-4 / count)
    unexplained = observed - albedo.clamp(0, 4) * cosine
    across = light_directions[..., :2]
    x, y = across.unbind(-1)
    moments = torch.stack((x, y, x * x, y * y, x * y), dim=-1).mean(dim=-2)
    level = observed @ mean
    features = {
        "normal": normals,
        "robust": robust - normals,
        "plain": plain - normals,
        "unexplained_light": 4 / count * weighted_sum(unexplained, across),
        "mean_light": moments[..., :2].expand(len(observed), -1),
        "light_moments": moments[..., 2:].expand(len(observed), -1),
        "error_median": error[:, :1] + MEDIAN_OFFSET,
        "error_shape": error[:, 1:] - 1,
        "largest": (scale / reference).log().clamp(-4.0, 4.0) / 2,
        "mean": level,
        "deviation": ((observed - level).square() @ mean * (count / (count - 1))).sqrt(),
        "residual": 3 * (unexplained.square() @ mean).sqrt(),
        "dark_share": (observed < SHADOW_SHARE).to(observed.dtype) @ mean,
        "n_lights": torch.full_like(scale, math.log(count / 10)),
        "halves": (3.0 * change).clamp(-1, 1),
        "noise": noise.clamp(-1, 1),
    }
    return torch.cat([features[name] for name in FEATURE_WIDTHS], dim=1)


def two_halves(observed: Tensor, light_directions: Tensor, signs: Tensor) -> TwoHalves:
    """Return compare_halves in the precision of the observations (P, F), whose largest value is 1.
    Each pixel's own lights are solved for in double precision.
    """
    values = observed if light_directions.ndim == 2 else observed.double()
    found = least_squares.compare_halves(values, light_directions.double(), signs)
    return TwoHalves(*(values.to(observed) for values in found))


def brightness(observations: Tensor) -> float:
    """Return the brightness of a capture: the median over its pixels (P, F) of the largest
    observation.
    """
    return max(float(observations.amax(dim=1).median()), 1e-12)


class MapTurn(NamedTuple):
    """A mirror image (x is flipped) if `mirror`, then `quarters` counterclockwise rotations by 90
    degrees.
    """

    quarters: int
    mirror: bool = False

    @property
    def back(self) -> MapTurn:
        """The rotation that undoes this one. A rotated mirror image undoes itself."""
        return self if self.mirror else MapTurn(-self.quarters % 4)


def turn_features(features: Tensor, turn: MapTurn) -> Tensor:
    """Rotate maps of features (..., FEATURE_CHANNELS, H, W)."""
    return turn_maps(features, turn, VECTORS, (TENSOR,))


def turn_maps(
    maps: Tensor,
    turn: MapTurn,
    vectors: Sequence[tuple[int, int]] = (),
    tensors: Sequence[tuple[int, int, int]] = (),
) -> Tensor:
    """Rotate maps (..., C, H, W), of which some channels are x and y of vectors, or xx, yy and xy
    of tensors.
    """
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
