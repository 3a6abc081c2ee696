"""Observation maps: what one pixel shows under each light, laid out by light direction.

A map is a square of `size` x `size` cells over the plane (x, y) of the light directions' orthographic
projection, [-1, 1] x [-1, 1]. Column 0 is x = -1; row 0 is y = +1, so that a map shown as a picture is the
sky as the object sees it, y up. All cells are equally wide (2 / size) and the view axis runs through the
corner shared by the four middle cells: rotations by 90 degrees and mirror images are exact permutations of
cells. CNN-PS (Ikehata, ECCV 2018) and SPLINE-Net (Zheng et al., ICCV 2019) use floor((size - 1)(x + 1) / 2),
whose last cell is a single point. On average that is half a cell, nearly two degrees, off ours, so networks
trained on such maps need them: the "cnn-ps" grid.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor

MAP_SIZE = 32

Grid = Literal["even", "cnn-ps"]
"""How lights fall on cells: ours, or as the authors of CNN-PS and SPLINE-Net have it. Row 0 is y = +1 in both."""


class SparseMap(NamedTuple):
    """values (P, C, size, size), zero where no light fell; holds (P, 1, size, size), one where one did."""

    values: Tensor
    holds: Tensor


def light_cells(light_directions: Tensor, size: int = MAP_SIZE, grid: Grid = "even") -> Tensor:
    """Flat cell index row * size + column (...) of unit light directions (..., 3), int64."""
    if grid == "cnn-ps":
        column, rising = (
            ((light_directions[..., axis] + 1) * ((size - 1) / 2)).long().clamp(0, size - 1)
            for axis in (0, 1)
        )
        return (size - 1 - rising) * size + column
    column = ((light_directions[..., 0] + 1) * (size / 2)).long().clamp(0, size - 1)
    row = ((1 - light_directions[..., 1]) * (size / 2)).long().clamp(0, size - 1)
    return row * size + column


@lru_cache(maxsize=8)
def cell_directions(size: int = MAP_SIZE) -> tuple[Tensor, Tensor]:
    """Light directions at the cells' centres (size, size, 3), and which are in the unit disc (size, size).

    Cells outside the disc hold no possible light; their direction is a zero vector.
    """
    centre = (torch.arange(size, dtype=torch.float64) + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(-centre, centre, indexing="ij")
    z_squared = 1 - x**2 - y**2
    inside = z_squared > 0
    directions = torch.stack((x, y, z_squared.clamp(min=0).sqrt()), dim=-1) * inside[..., None]
    return directions.float(), inside


def unit_disc(size: int = MAP_SIZE, grid: Grid = "even") -> Tensor:
    """Which cells (size, size) belong to the unit disc, bool: those whose centres do.

    The authors' networks count a cell where its index, scaled to [-1, 1], lies in the disc: a slightly smaller
    one, made of 740 cells in place of 812 at size 32.
    """
    if grid == "even":
        return cell_directions(size)[1]
    doubled = 2 * torch.arange(size) - (size - 1)
    return doubled[:, None] ** 2 + doubled**2 < (size - 1) ** 2


def sparse_map(
    values: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    size: int = MAP_SIZE,
    grid: Grid = "even",
) -> SparseMap:
    """Scatter values (P, F) or (P, F, C) onto their lights' cells; lights that share a cell are averaged.

    Args:
        light_directions: (F, 3), or (P, F, 3) where each pixel has lights of its own.
        valid: (P, F) bool; observations that are false are left out. All count by default.
    """
    if values.ndim == 2:
        values = values[..., None]
    pixels, lights, channels = values.shape
    cells = light_cells(light_directions, size, grid).expand(pixels, lights)
    weight = torch.ones_like(values[..., 0]) if valid is None else valid.to(values.dtype)
    stacked = torch.cat((values * weight[..., None], weight[..., None]), dim=-1).transpose(1, 2)
    sums = values.new_zeros(pixels, channels + 1, size * size)
    sums.scatter_add_(2, cells[:, None].expand_as(stacked), stacked)
    count = sums[:, -1:]
    maps = sums[:, :-1] / count.clamp(min=1)
    holds = (count > 0).to(values.dtype)
    return SparseMap(maps.view(pixels, channels, size, size), holds.view(pixels, 1, size, size))


def map_scale(observations: Tensor, valid: Tensor | None = None) -> Tensor:
    """The largest valid observation of each pixel (P, 1), which divides its maps; 1 for an all-zero pixel."""
    if valid is not None:
        observations = observations * valid
    largest = observations.amax(dim=1, keepdim=True)
    return torch.where(largest > 0, largest, torch.ones_like(largest))


def rotate_about_view_axis(vectors: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Turn vectors (..., 3) counterclockwise about +z; cosine and sine of the angle broadcast over (...)."""
    x, y, z = vectors.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y, z), dim=-1)


def dot(vectors: Tensor, directions: Tensor) -> Tensor:
    """Products (P, D) of a vector for each pixel (P, K) with directions (D, K) or (P, D, K)."""
    if directions.ndim == 2:
        return vectors @ directions.T
    return (directions @ vectors[..., None])[..., 0]
