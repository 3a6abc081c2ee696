"""The losses of SPLINE-Net (Zheng et al., ICCV 2019, section 3).

Every loss is the mean of one number for each pixel. The loss of a batch is therefore the mean of the losses of equal
parts of it. The paper does not say whether |.| sums or averages the cells of a map; here the argument `norm` does.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

Norm = Literal["mean", "sum"]
"""Whether the values of a map's cells are averaged or summed."""

AXIS_LENGTH = 0.01
"""Projected length of a normal (sine of its zenith angle) below which `mirror` reduces the effect of its azimuth."""


def angular_loss(normals: Tensor, truth: Tensor) -> Tensor:
    """Return the mean of arccos(n . n_gt) in radians; normals and truth are (P, 3), unit."""
    return angles(normals, truth).mean()


def angles(normals: Tensor, truth: Tensor) -> Tensor:
    """Return arccos(n . n_gt) in radians, (P,); normals and truth are (P, 3), unit.

    Computed as atan2(|n x n_gt|, n . n_gt), because the gradient of arccos is infinite at an angle of 0.
    """
    sine = torch.linalg.cross(normals, truth).square().sum(-1).add(1e-12).sqrt()
    return torch.atan2(sine, (normals * truth).sum(-1))


def map_loss(dense: Tensor, truth: Tensor, cells: Tensor, norm: Norm = "mean") -> Tensor:
    """Return |D - D_gt| over some cells, or |M_s o (D - D_gt)| over those of the sparse map.

    Args:
        dense: LI-Net's maps D, (P, 1, w, w).
        truth: the true maps D_gt, of the same shape.
        cells: 1 in the cells that count, whose true value is known, else 0, of the same shape.
        norm: average or sum over the cells.
    """
    total = ((dense - truth).abs() * cells).sum((1, 2, 3))
    return (total if norm == "sum" else total / cells.sum((1, 2, 3)).clamp(min=1)).mean()


def mirror(maps: Tensor, normals: Tensor) -> Tensor:
    """Return r(D, n): the maps mirrored about the axis through the centre and the projected normal.

    The map of an isotropic pixel without cast shadows is its own mirror image. Values between cells are interpolated,
    so that the result has a gradient with respect to the normal as well as the map. A normal towards the camera has
    no azimuth. Its map is rotated by 180 degrees, which is a symmetry of it as well.

    Args:
        maps: (P, C, w, w).
        normals: (P, 3), unit.
    """
    size = maps.shape[-1]
    centre = (torch.arange(size, device=maps.device, dtype=maps.dtype) + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(-centre, centre, indexing="ij")
    axis = normals[:, :2].to(maps.dtype)
    axis = axis / axis.square().sum(1, keepdim=True).clamp(min=AXIS_LENGTH**2).sqrt()
    axis_x, axis_y = axis[:, 0, None, None], axis[:, 1, None, None]
    along = x * axis_x + y * axis_y
    # grid_sample expects rows to count downwards, so y changes its sign.
    grid = torch.stack((2 * along * axis_x - x, -(2 * along * axis_y - y)), dim=-1)
    return grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def asymmetries(dense: Tensor, normals: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
    """Return |D - r(D, n)| and |p(D) - p(r(D, n))|, each summed over the cells of a pixel: (P,) and (P,).

    The mean of the first is Ls, the loss for isotropic reflectance. p is average pooling with stride 2. Only filled
    cells with a filled mirror image are compared. Near the rim and beside gaps, a mirrored value would be mixed with
    empty cells.

    Args:
        dense: maps D, (P, 1, w, w).
        normals: (P, 3), unit.
        filled: 1 in cells with a value, else 0, (P, 1, w, w).
    """
    image, image_filled = torch.chunk(mirror(torch.cat((dense, filled), dim=1), normals), 2, dim=1)
    both = filled * (image_filled > 0.999)
    difference = (dense - image) * both
    fine = difference.abs().sum((1, 2, 3))
    coarse = avg_pool2d(difference, 2).abs().sum((1, 2, 3))
    return fine, coarse


def asymmetric_loss(fine: Tensor, coarse: Tensor, *, eta: float, lambda_c: float) -> Tensor:
    """Return La = ||D - r(D, n)| - eta| + lambda_c ||p(D) - p(r(D, n))| - eta|.

    Shadows and interreflections make a map slightly asymmetric, in connected regions. eta is the expected asymmetry,
    summed over cells. `fine` and `coarse` are the results of `asymmetries`.
    """
    return ((fine - eta).abs() + lambda_c * (coarse - eta).abs()).mean()
