"""Least squares with a weight for each observation, pixel by pixel: one step of every robust method."""

import torch
from torch import Tensor

from splinecli.maths.observation_map import dot
from splinecli.maths.solve_3x3 import inverse_3x3, multiply_symmetric

RIDGE = 1e-12  # Weight of |b|^2. It matters only where the lights of positive weight lie in one plane.

_TWICE_OFF_DIAGONAL = (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)


def weighted_least_squares(observations: Tensor, light_directions: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return b = C L' W I with C = (L' W L + ridge)^-1, and the diagonal of L C L', which are the variances of L b.

    All arguments are float64, because weights may differ by many orders of magnitude.

    Args:
        observations, weight: (P, F).
        light_directions: (F, 3) or (P, F, 3).

    Returns:
        b (P, 3) and variances (P, F).
    """
    x, y, z = light_directions.unbind(-1)
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    ridge = products.new_tensor((RIDGE,) * 3 + (0.0,) * 3)
    covariance = inverse_3x3((weighted_sum(weight, products) + ridge).unbind(-1), RIDGE)
    right_side = weighted_sum(weight * observations, light_directions)
    scaled_normals = torch.stack(multiply_symmetric(covariance, right_side.unbind(-1)), dim=-1)
    variances = dot(torch.stack(covariance, dim=-1), products * products.new_tensor(_TWICE_OFF_DIAGONAL))
    return scaled_normals, variances


def weighted_sum(weight: Tensor, directions: Tensor) -> Tensor:
    """Return weighted sums (P, K) of directions (F, K) or (P, F, K) with weights (P, F)."""
    if directions.ndim == 2:
        return weight @ directions
    return (weight[:, None] @ directions)[:, 0]
