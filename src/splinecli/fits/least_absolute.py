"""L1: minimise the sum of absolute residuals, which shadows and highlights affect less than the sum of squares."""

import torch
from torch import Tensor

from splinecli.fits.weighted_least_squares import weighted_least_squares
from splinecli.maths.observation_map import dot

ITERATIONS = 50
SMALLEST_RESIDUAL = 1e-7  # weights stop growing below this residual, for a largest observation of 1


def solve(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Return scaled normals b (P, 3) that minimise sum_j |I_j - l_j . b|.

    Iteratively reweighted least squares comes close to the minimum. There, three residuals are zero. So the b of the
    three smallest residuals is used where it is better.
    """
    weight = torch.ones_like(observations)
    for step in range(ITERATIONS):
        scaled_normals, residual = _fit(observations, light_directions, weight)
        weight = 1 / residual.clamp(min=max(SMALLEST_RESIDUAL, 0.1 * 0.5**step))
    three = torch.zeros_like(weight).scatter_(1, weight.topk(3, dim=1).indices, 1.0)
    vertex, residual_there = _fit(observations, light_directions, three)
    better = residual_there.sum(dim=1, keepdim=True) < residual.sum(dim=1, keepdim=True)
    return torch.where(better, vertex, scaled_normals)


def _fit(observations: Tensor, light_directions: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    scaled_normals, _ = weighted_least_squares(observations, light_directions, weight)
    return scaled_normals, (observations - dot(scaled_normals, light_directions)).abs()
