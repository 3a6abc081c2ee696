"""The step that the robust methods share: least squares with a weight for each observation, pixel by pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.observation_map import dot

RIDGE = 1e-12
"""Pull of b to zero: it decides only where the lights that count lie in one plane."""

_TWICE_OFF_DIAGONAL = (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)


def weighted_least_squares(
    observations: Tensor, light_directions: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """b = C L' W I with C = (L' W L + ridge)^-1, and the diagonal of L C L', the variances of L b.

    In float64: weights that differ by many orders of magnitude leave float32 no digits.

    Args:
        observations, weight: (P, F), float64.
        light_directions: (F, 3) or (P, F, 3), float64.

    Returns:
        (P, 3) and (P, F).
    """
    x, y, z = light_directions.unbind(-1)
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    ridge = products.new_tensor((RIDGE,) * 3 + (0.0,) * 3)
    covariance = _inverse(weighted_sum(weight, products) + ridge)
    scaled_normals = _multiply(covariance, weighted_sum(weight * observations, light_directions))
    return scaled_normals, dot(covariance, products * products.new_tensor(_TWICE_OFF_DIAGONAL))


def weighted_sum(weight: Tensor, directions: Tensor) -> Tensor:
    """Sums (P, K) of directions (F, K) or (P, F, K) by weights (P, F)."""
    if directions.ndim == 2:
        return weight @ directions
    return (weight[:, None] @ directions)[:, 0]


def _inverse(matrices: Tensor) -> Tensor:
    """Inverses of symmetric positive matrices (P, 6), their xx, yy, zz, xy, xz, yz.

    By A = L D L' in closed form, far faster than LAPACK. No pivot falls below the ridge or, as rounding leaves no more
    of it, 1e-14 of the trace; so the inverse stays positive where the lights that count span a line or a plane.
    """
    xx, yy, zz, xy, xz, yz = matrices.unbind(-1)
    floor = RIDGE + 1e-14 * (xx + yy + zz)
    first = torch.maximum(xx, floor)
    l21, l31 = xy / first, xz / first
    second = torch.maximum(yy - l21 * xy, floor)
    l32 = (yz - l31 * xy) / second
    third = torch.maximum(zz - l31 * xz - l32 * l32 * second, floor)
    # The inverse of L, whose diagonal is 1, below it.
    m21, m31, m32 = -l21, l21 * l32 - l31, -l32
    return torch.stack(
        (
            1 / first + m21 * m21 / second + m31 * m31 / third,
            1 / second + m32 * m32 / third,
            1 / third,
            m21 / second + m31 * m32 / third,
            m31 / third,
            m32 / third,
        ),
        dim=-1,
    )


def _multiply(matrices: Tensor, vectors: Tensor) -> Tensor:
    xx, yy, zz, xy, xz, yz = matrices.unbind(-1)
    x, y, z = vectors.unbind(-1)
    return torch.stack((xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z), dim=-1)
