"""A robust Lambertian fit to each pixel, vectorised in torch: the starting point of the networks.

Iteratively reweighted least squares of I = l . b with two weights. Observations below SHADOW_SHARE of the pixel's
largest are treated as shadows and get a tiny weight. Large residuals get smaller weights, which approximates an L1 fit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.fits.weighted_least_squares import weighted_sum
from splinecli.observation_map import dot
from splinecli.solve_3x3 import SMALLEST_PIVOT, inverse_3x3, multiply_symmetric

SHADOW_SHARE = 0.05
ITERATIONS = 5
_PRIOR = 1e-4


def fit_lambertian(observations: Tensor, light_directions: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return scaled normals b (P, 3) of the robust Lambertian fit: |b| is the albedo, b / |b| the normal.

    Args:
        observations: (P, F), each pixel scaled to a largest value of 1. A zero pixel gives b = (0, 0, tiny).
        light_directions: (F, 3) or (P, F, 3), unit.
        valid: (P, F) bool, all by default.
    """
    counts = torch.ones_like(observations) if valid is None else valid.to(observations.dtype)
    x, y, z = light_directions.unbind(-1)
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    # A weak prior towards the last solution keeps pixels with fewer than three lit lights solvable.
    prior = observations.new_tensor((_PRIOR,) * 3 + (0.0,) * 3)
    lit = torch.where(observations < SHADOW_SHARE, 1e-3, 1.0) * counts
    solution = observations.new_tensor((0.0, 0.0, 1e-3)).expand(len(observations), 3)
    weight = lit
    for iteration in range(ITERATIONS):
        if iteration:
            weight = lit / ((dot(solution, light_directions) - observations).abs() + 0.02)
        inverse = inverse_3x3((weighted_sum(weight, products) + prior).unbind(-1), SMALLEST_PIVOT)
        right_side = weighted_sum(weight * observations, light_directions) + _PRIOR * solution
        solution = torch.stack(multiply_symmetric(inverse, right_side.unbind(-1)), dim=-1)
    return solution
