"""A robust Lambertian fit to each pixel, vectorised in torch: the networks' frame of reference.

Iteratively reweighted least squares of I = l . b with two weights: observations under `SHADOW_SHARE` of the
pixel's largest are taken for shadow and nearly left out, and large residuals count less (an approximate L1
fit).
"""

from __future__ import annotations

import torch
from torch import Tensor

SHADOW_SHARE = 0.05
ITERATIONS = 5


def solve_3x3(matrix: Tensor, vector: Tensor) -> Tensor:
    """Solve matrix (P, 3, 3) x = vector (P, 3) by Cramer's rule: far faster than LAPACK for many systems."""
    first, second, third = matrix.unbind(-1)
    minor = torch.linalg.cross(second, third)
    determinant = (first * minor).sum(-1, keepdim=True)
    solution = torch.stack(
        (
            (vector * minor).sum(-1),
            (first * torch.linalg.cross(vector, third)).sum(-1),
            (first * torch.linalg.cross(second, vector)).sum(-1),
        ),
        dim=-1,
    )
    return solution / torch.where(determinant.abs() < 1e-12, torch.full_like(determinant, 1e-12), determinant)


def fit_lambertian(observations: Tensor, light_directions: Tensor, valid: Tensor | None = None) -> Tensor:
    """Scaled normals b (P, 3) of the robust Lambertian fit; |b| is the albedo, b / |b| the normal.

    Args:
        observations: (P, F), each pixel scaled to a largest value of 1 (zero pixels give b = (0, 0, tiny)).
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
        solution = solve_3x3(matrix, vector)
        residual = (lights @ solution[..., None])[..., 0] - observations
        weight = lit / (residual.abs() + 0.02)
    return solution
