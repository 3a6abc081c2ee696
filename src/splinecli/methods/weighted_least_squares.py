"""The step that the robust methods share: least squares with a weight for each observation, pixel by pixel."""

from __future__ import annotations

import torch
from torch import Tensor

RIDGE = 1e-12
"""Pull of b to zero, against weights of about 1: it decides only where the lights that count lie in one plane."""

_TWICE_OFF_DIAGONAL = (1.0, 1.0, 1.0, 2.0, 2.0, 2.0)


def weighted_least_squares(
    observations: Tensor, light_directions: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """b = C L' W I with C = (L' W L + ridge)^-1, and the diagonal of L C L', the variances of L b.

    In float64: weights that differ by many orders of magnitude leave float32 no digits.

    Args:
        observations, weight: (P, F), float64.
        light_directions: (F, 3), float64.

    Returns:
        (P, 3) and (P, F).
    """
    x, y, z = light_directions.unbind(-1)
    products = torch.stack((x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)
    ridge = products.new_tensor((RIDGE,) * 3 + (0.0,) * 3)
    covariance = _inverse(weight @ products + ridge)
    scaled_normals = _multiply(covariance, (weight * observations) @ light_directions)
    return scaled_normals, covariance @ (products * products.new_tensor(_TWICE_OFF_DIAGONAL)).T


def _inverse(matrices: Tensor) -> Tensor:
    """Inverses of symmetric positive definite matrices (P, 6), their xx, yy, zz, xy, xz, yz: closed form."""
    xx, yy, zz, xy, xz, yz = matrices.unbind(-1)
    cofactors = torch.stack(
        (
            yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy,
            xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz,
        ),
        dim=-1,
    )  # fmt: skip
    determinant = xx * cofactors[:, 0] + xy * cofactors[:, 3] + xz * cofactors[:, 4]
    return cofactors / determinant[:, None].clamp(min=RIDGE**3)


def _multiply(matrices: Tensor, vectors: Tensor) -> Tensor:
    xx, yy, zz, xy, xz, yz = matrices.unbind(-1)
    x, y, z = vectors.unbind(-1)
    return torch.stack((xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z), dim=-1)
