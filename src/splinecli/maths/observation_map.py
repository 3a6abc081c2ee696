"""Observation maps: the observations of one pixel as an image, placed according to the light
directions.

A map is a square of `size` x `size` cells over the plane (x, y), the orthographic projection of
light directions, from -1 to 1 in both axes. Column 0 is x = -1 and row 0 is y = +1, so y points up
in a picture of the map. All cells have the same width, 2 / size, and the view axis passes through
the common corner of the four middle cells. Therefore, rotations by 90 degrees and mirror images are
exact permutations of cells.

CNN-PS (Ikehata, ECCV 2018) and SPLINE-Net (Zheng et al., ICCV 2019) use floor((size - 1)(x + 1) /
2), so their last cell is a single point. On average, this differs from our grid by half a cell, or
nearly two degrees. Networks that were trained on such maps need the same grid, "cnn-ps".
"""

from functools import lru_cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor

MAP_SIZE = 32

Grid = Literal["even", "cnn-ps"]
"""The rule that assigns lights to cells: our rule, or the rule of CNN-PS and SPLINE-Net. Row 0 is y
= +1 in both.
"""


class SparseMap(NamedTuple):
    """Values (P, C, size, size), zero in empty cells, and occupied (P, 1, size, size), one in all
    other cells.
    """

    values: Tensor
    occupied: Tensor


def light_cells(light_directions: Tensor, size: int = MAP_SIZE, grid: Grid = "even") -> Tensor:
    """Return flat cell indices row * size + column (...), int64, of unit light directions (...,
    3).
    """
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
    """Return the light directions (size, size, 3) at the centres of the cells, and the mask
    (size, size) of the disc.

    Cells outside the disc cannot contain a light. Their directions are zero vectors.
    """
    # The result is cached, so it must not depend on the default device.
    centre = (torch.arange(size, dtype=torch.float64, device="cpu") + 0.5) * (2 / size) - 1
    y, x = torch.meshgrid(-centre, centre, indexing="ij")
    z_squared = 1 - x**2 - y**2
    inside = z_squared > 0
    directions = torch.stack((x, y, z_squared.clamp(min=0).sqrt()), dim=-1) * inside[..., None]
    return directions.float(), inside


def unit_disc(size: int = MAP_SIZE, grid: Grid = "even") -> Tensor:
    """Return the mask (size, size) of the cells whose centres are in the unit disc.

    For the "cnn-ps" grid, these are the cells whose index, scaled to [-1, 1], is in the disc. They
    are slightly fewer: 740 instead of 812 for size 32.
    """
    if grid == "even":
        return cell_directions(size)[1]
    doubled = 2 * torch.arange(size, device="cpu") - (size - 1)
    return doubled[:, None] ** 2 + doubled**2 < (size - 1) ** 2


def sparse_map(
    values: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    size: int = MAP_SIZE,
    grid: Grid = "even",
) -> SparseMap:
    """Return the sparse maps of values (P, F) or (P, F, C), averaged over lights in the same cell.

    The directions are (F, 3), or (P, F, 3) if each pixel has its own lights. Values that are not
    valid (P, F) are left out.
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
    occupied = (count > 0).to(values.dtype)
    return SparseMap(maps.view(pixels, channels, size, size), occupied.view(pixels, 1, size, size))


def map_scale(observations: Tensor, valid: Tensor | None = None) -> Tensor:
    """Return the largest valid observation (P, 1) of each pixel, by which its maps are scaled, or 1
    for a black pixel.
    """
    if valid is not None:
        observations = observations * valid
    largest = observations.amax(dim=1, keepdim=True)
    return torch.where(largest > 0, largest, torch.ones_like(largest))


def rotate_about_view_axis(vectors: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate vectors (..., 3) counterclockwise about +z. Cosine and sine of the angle broadcast
    over (...).
    """
    x, y, z = vectors.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y, z), dim=-1)


def dot(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return the dot products (P, D) of vectors (P, K) with directions (D, K) or (P, D, K)."""
    if directions.ndim == 2:
        return vectors @ directions.T
    return (directions @ vectors[..., None])[..., 0]
