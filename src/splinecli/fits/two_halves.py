"""Least squares with all lights, and how much two halves of the lights disagree about it.

Random errors differ from light to light, so the halves disagree about them. What all lights show alike is either right,
or wrong in the same way for all pixels of a neighbourhood.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from splinecli.fits.weighted_least_squares import RIDGE, weighted_sum
from splinecli.maths.observation_map import dot

_TINY = 1e-9


class TwoHalves(NamedTuple):
    """The normals that all lights give, and what two halves of the lights disagree about. The signs mean nothing."""

    normals: Tensor  # (P, 3), unit, of least squares with all lights
    # (P, 3), what least squares makes of the residuals where those of one half have the opposite sign, as a share of
    # the albedo. On a ring of lights, it is half the difference between the normals of the halves
    change: Tensor
    # (P, 1), in radians. Its mean square is that of the normals' random errors, if all observations have equal noise.
    # Three lights have no residuals, so they do not show it
    noise: Tensor


def compare_halves(observations: Tensor, light_directions: Tensor, signs: Tensor) -> TwoHalves:
    """Fit all lights, and compare two halves of them.

    Args:
        observations: (P, F) float64, each pixel scaled to a largest value of 1.
        light_directions: (F, 3) or (P, F, 3) float64, unit.
        signs: (F,), 1 and -1 for the two halves, the same for all pixels of a capture; see alternating_signs.
    """
    gram = light_directions.mT @ light_directions
    covariance = torch.linalg.inv(gram + RIDGE * torch.eye(3, dtype=gram.dtype, device=gram.device))

    def solve(values: Tensor) -> Tensor:
        solved: Tensor = weighted_sum(values, light_directions)[:, None] @ covariance
        return solved[:, 0]

    scaled = solve(observations)
    albedo = scaled.norm(dim=-1, keepdim=True).clamp(min=_TINY)
    normals = scaled / albedo
    signed = (observations - dot(scaled, light_directions)) * signs
    # The signs have a part that some normal explains, to which residuals are perpendicular. Only the rest sees noise.
    signs = signs.to(scaled).expand(1 if light_directions.ndim == 2 else len(scaled), -1)
    seeing = (signs - dot(solve(signs), light_directions)).norm(dim=-1, keepdim=True)
    along = ((normals[:, None] @ covariance)[:, 0] * normals).sum(dim=-1, keepdim=True)
    across = covariance.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[..., None] - along
    noise = signed.sum(dim=-1, keepdim=True) / seeing.clamp(min=_TINY) * across.clamp(min=0).sqrt()
    return TwoHalves(normals, solve(signed) / albedo, noise / albedo)


def alternating_signs(light_directions: Tensor) -> Tensor:
    """Return 1 and -1 in turn (F,) for lights (F, 3) in the order of their azimuths about the middle one.

    The light furthest from the middle has 1. So neither the order of the lights nor a turn of the image changes the
    halves, unless two lights have the same direction or distance.
    """
    across = light_directions[:, :2] - light_directions[:, :2].mean(dim=0)
    azimuth = torch.atan2(across[:, 1], across[:, 0])
    turned = (azimuth - azimuth[across.square().sum(dim=1).argmax()]).remainder(2 * math.pi)
    place = turned.argsort().argsort()
    return 1 - 2 * (place % 2).to(light_directions)
