"""The losses of SPLINE-Net (Zheng et al., ICCV 2019, section 3).

Every loss is first a number for each pixel and then the mean over the pixels, so that a batch cut in equal
parts has the mean of the parts' losses. The paper writes |.| of a map without saying whether its cells are
summed or averaged: here a `norm` says it.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

Norm = Literal["mean", "sum"]
"""How the cells of a map are put together."""

AXIS_LENGTH = 0.01
"""Length of a normal's projection (sine of its zenith angle) under which its azimuth fades out of a mirror."""


def angular_loss(normals: Tensor, truth: Tensor) -> Tensor:
    """arccos(n . n_gt) in radians, mean over pixels; normals, truth (P, 3) unit."""
    return angles(normals, truth).mean()


def angles(normals: Tensor, truth: Tensor) -> Tensor:
    """arccos(n . n_gt) in radians, (P,).

    As atan2(|n x n_gt|, n . n_gt): the same angle with a bounded gradient, where that of arccos is infinite
    at 0.
    """
    sine = torch.linalg.cross(normals, truth).square().sum(-1).add(1e-12).sqrt()
    return torch.atan2(sine, (normals * truth).sum(-1))


def map_loss(dense: Tensor, truth: Tensor, known: Tensor, norm: Norm = "mean") -> Tensor:
    """|D - D_gt| over a pixel's cells with a known truth, known (P, 1, w, w), as the maps."""
    return _over(known, (dense - truth).abs(), norm)


def masked_map_loss(
    dense: Tensor, truth: Tensor, known: Tensor, holds: Tensor, norm: Norm = "mean"
) -> Tensor:
    """|M_s o (D - D_gt)| over a pixel's cells that hold an observation, holds (P, 1, w, w)."""
    return _over(known * holds, (dense - truth).abs(), norm)


def _over(cells: Tensor, values: Tensor, norm: Norm) -> Tensor:
    total = (values * cells).sum((1, 2, 3))
    return (total if norm == "sum" else total / cells.sum((1, 2, 3)).clamp(min=1)).mean()


def mirror(maps: Tensor, normals: Tensor) -> Tensor:
    """r(D, n): maps (P, C, w, w) mirrored about the axis through the centre and the projected normal (P, 3).

    The map of an isotropic pixel without cast shadows is its own mirror image. Values between cells are
    interpolated, so that the image has a gradient in the normal as well as in the map. A normal that looks at
    the camera has no azimuth; its image is the map turned by 180 degrees, equally a symmetry of its.
    """
    size = maps.shape[-1]
    centre = (torch.arange(size, device=maps.device, dtype=maps.dtype) + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(-centre, centre, indexing="ij")
    axis = normals[:, :2].to(maps.dtype)
    axis = axis / axis.square().sum(1, keepdim=True).clamp(min=AXIS_LENGTH**2).sqrt()
    axis_x, axis_y = axis[:, 0, None, None], axis[:, 1, None, None]
    along = x * axis_x + y * axis_y
    # grid_sample counts rows downwards: -y.
    grid = torch.stack((2 * along * axis_x - x, -(2 * along * axis_y - y)), dim=-1)
    return grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def asymmetries(dense: Tensor, normals: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
    """|D - r(D, n)| and |p(D) - p(r(D, n))|, each summed over the cells of a pixel: (P,) and (P,).

    p is average pooling of stride 2. Compared are the cells that are filled, (P, 1, w, w), as are their mirror
    images: near the rim and beside gaps a mirror image would mix values with nothing.
    """
    image, image_filled = torch.chunk(mirror(torch.cat((dense, filled), dim=1), normals), 2, dim=1)
    both = filled * (image_filled > 0.999)
    difference = (dense - image) * both
    fine = difference.abs().sum((1, 2, 3))
    coarse = avg_pool2d(difference, 2).abs().sum((1, 2, 3))
    return fine, coarse


def symmetric_loss(fine: Tensor) -> Tensor:
    """Ls = |D - r(D, n)|, from what `asymmetries` gives: isotropic reflectance."""
    return fine.mean()


def asymmetric_loss(fine: Tensor, coarse: Tensor, *, eta: float, lambda_c: float) -> Tensor:
    """La = ||D - r(D, n)| - eta| + lambda_c ||p(D) - p(r(D, n))| - eta|: shadows and interreflections.

    They leave a map a little asymmetric, in connected regions: eta is the amount, in summed cells.
    """
    return ((fine - eta).abs() + lambda_c * (coarse - eta).abs()).mean()
