"""The losses of SPLINE-Net (Zheng et al., ICCV 2019, section 3), each averaged over the batch."""

from __future__ import annotations

import torch
from torch import Tensor


def angular_loss(normals: Tensor, truth: Tensor) -> Tensor:
    """arccos(n . n_gt) in radians, mean over pixels; normals, truth (P, 3) unit.

    As atan2(|n x n_gt|, n . n_gt): the same angle with a bounded gradient, where that of arccos is infinite
    at 0.
    """
    sine = torch.linalg.cross(normals, truth).square().sum(-1).add(1e-12).sqrt()
    return torch.atan2(sine, (normals * truth).sum(-1)).mean()


def map_loss(dense: Tensor, truth: Tensor, inside: Tensor) -> Tensor:
    """|D - D_gt|, mean over the cells in the unit disc; dense, truth (P, 1, w, w), inside (1, 1, w, w)."""
    return ((dense - truth).abs() * inside).sum() / (inside.sum() * len(dense))


def masked_map_loss(dense: Tensor, truth: Tensor, holds: Tensor) -> Tensor:
    """|M_s o (D - D_gt)|, mean over the cells that hold an observation, holds (P, 1, w, w)."""
    return ((dense - truth).abs() * holds).sum() / holds.sum().clamp(min=1)
