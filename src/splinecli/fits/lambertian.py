"""A robust Lambertian fit to each pixel, vectorised in torch: the starting point of the networks.

Iteratively reweighted least squares of I = l . b with two weights. Observations below SHADOW_SHARE of the pixel's
largest are treated as shadows and get a tiny weight. Large residuals get smaller weights, which approximates an L1 fit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.solve_3x3 import solve_by_cramer

SHADOW_SHARE = 0.05
ITERATIONS = 5


def fit_lambertian(observations: Tensor, light_directions: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return scaled normals b (P, 3) of the robust Lambertian fit: |b| is the albedo, b / |b| the normal.

    Args:
        observations: (P, F), each pixel scaled to a largest value of 1. A zero pixel gives b = (0, 0, tiny).
        light_directions: (F, 3) or (P, F, 3), unit.
        valid: (P, F) bool, all by default.
    """
    counts = torch.ones_like(observations) if valid is None else valid.to(observations.dtype)
    lights = light_directions.expand(*observations.shape, 3)
    lit = torch.where(observations < SHADOW_SHARE, 1e-3, 1.0) * counts
    # A weak prior towards the last solution keeps pixels with fewer than three lit lights solvable.
    prior = 1e-4 * torch.eye(3, dtype=observations.dtype, device=observations.device)
    solution = observations.new_tensor((0.0, 0.0, 1e-3)).expand(len(observations), 3)
    weight = lit
    for _ in range(ITERATIONS):
        weighted = lights * weight[..., None]
        matrix = weighted.transpose(1, 2) @ lights + prior
        vector = (weighted.transpose(1, 2) @ observations[..., None])[..., 0] + solution @ prior
        solution = solve_by_cramer(matrix, vector)
        residual = (lights @ solution[..., None])[..., 0] - observations
        weight = lit / (residual.abs() + 0.02)
    return solution
