"""L1: the normal that minimises the sum of absolute residuals, less misled by shadows and highlights than LS."""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.fits.weighted_least_squares import weighted_least_squares

ITERATIONS = 50
SMALLEST_RESIDUAL = 1e-7
"""Where the largest intensity is 1: from there on weights stop growing."""


def solve(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Scaled normals b (P, 3) that minimise sum_j |I_j - l_j . b|.

    By iteratively reweighted least squares, which comes near; an optimum leaves three residuals zero, so the b
    that the three smallest ones give is taken where it is better.

    Args:
        observations: (P, F) float64, the largest of each pixel 1.
        light_directions: (F, 3) float64, unit.
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
    return scaled_normals, (observations - scaled_normals @ light_directions.T).abs()
