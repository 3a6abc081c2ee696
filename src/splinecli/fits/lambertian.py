"""A robust Lambertian fit to each pixel, vectorised in torch: the starting point of the networks.

Iteratively reweighted least squares of I = l . b with two weights. Observations below SHADOW_SHARE of the pixel's
largest are treated as shadows and get a tiny weight. Large residuals get smaller weights, which approximates an L1 fit.
"""

import torch
from torch import Tensor

from splinecli.fits.weighted_least_squares import weighted_sum
from splinecli.maths.observation_map import dot
from splinecli.maths.solve_3x3 import SMALLEST_PIVOT, inverse_3x3, multiply_symmetric

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
    # A row for each light: sums over lights and the steps below then run along the pixels, three times as fast.
    observed = observations.T.contiguous()
    lit = torch.where(observed < SHADOW_SHARE, 1e-3, 1.0).to(observed)
    if valid is not None:
        lit = lit * valid.T
    x, y, z = light_directions.unbind(-1)
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    # A weak prior towards the last solution keeps pixels with fewer than three lit lights solvable.
    prior = observed.new_tensor((_PRIOR,) * 3 + (0.0,) * 3)[:, None]
    solution = observed.new_tensor((0.0, 0.0, 1e-3))[:, None].expand(3, len(observations))
    weight = lit
    for iteration in range(ITERATIONS):
        if iteration:
            weight = lit / ((_dot(light_directions, solution) - observed).abs() + 0.02)
        inverse = inverse_3x3((_sum(products, weight) + prior).unbind(), SMALLEST_PIVOT)
        right_side = _sum(light_directions, weight * observed) + _PRIOR * solution
        solution = torch.stack(multiply_symmetric(inverse, right_side.unbind()))
    return solution.T


def _sum(directions: Tensor, weight: Tensor) -> Tensor:
    """Return the sums (K, P) of directions (F, K) or (P, F, K) with weights (F, P)."""
    return directions.T @ weight if directions.ndim == 2 else weighted_sum(weight.T, directions).T


def _dot(directions: Tensor, vectors: Tensor) -> Tensor:
    """Return the dot products (F, P) of directions (F, K) or (P, F, K) with vectors (K, P)."""
    return directions @ vectors if directions.ndim == 2 else dot(vectors.T, directions).T
