"""Plates and half ellipsoids, smooth or with detail of a few pixels, such as engraved, woven or faceted surfaces.

Rendered scenes have little pixel-scale curvature. These pieces do, but without cast shadows or interreflection.
"""

import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from splinecli.synthesis import draw_number
from splinecli.synthesis.principled import draw_material, with_one_gloss


def draw_engraved(
    size: int, lights: Tensor, generator: torch.Generator, *, round_share: float = 1 / 3
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a piece; return its unit normals (P, 3), its radiance (P, F), and its mask (size, size) with P true pixels.

    `round_share` of the pieces are half ellipsoids, whose mask ends at their rim. The others are plates that fill the
    frame: tilted by a slope of up to 0.7, with three waves of U(0.3, 2) frames and slopes of up to 0.3. Each piece has
    one kind of detail: grooves U(1, 6) pixels wide to either side, regular or not, straight or curved; facets of 3 to
    20 pixels; or a random texture with a grain of U(0.4, 1.5) pixels. The slopes of the detail are about U(0.05, 0.6),
    a third as large for the texture. A third of the pieces are smooth. The material comes from draw_material, with 1 to
    300 patches; in half of the pieces, the patches differ only in their base colour. The lights (F, 3) are unit.
    """
    uniform = partial(draw_number, generator)
    normals, mask = _draw_base(size, round_share, generator)
    # A third of the pieces have no detail, because smooth surfaces must stay smooth whatever their material.
    if uniform() >= 1 / 3:
        detail = _draw_detail(size, generator)
        normals = normals - normals[:, 2:] * torch.nn.functional.pad(detail, (0, 1))
        normals = torch.nn.functional.normalize(normals, dim=1)
    patches = int(300 ** uniform())
    material = draw_material(patches, generator)
    if uniform() < 0.5:
        material = with_one_gloss(material)
    material = material.take(_cells(patches, size, generator)[mask])
    normals = normals[mask]
    cosines = (normals @ lights.T).clamp(min=0)
    return normals, material.shade(cosines, normals[:, 2:], lights[:, 2]), mask.view(size, size)


def _draw_base(size: int, round_share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw a half ellipsoid or a plate; return its unit normals (size^2, 3) and its mask (size^2,)."""
    uniform = partial(draw_number, generator)
    places = _places(size)
    if uniform() < round_share:
        direction = _draw_direction(generator)
        across = torch.stack((direction, torch.tensor((-direction[1], direction[0]))))
        middle = places - places.mean(dim=0)
        axes = torch.tensor((uniform(0.3, 0.49), uniform(0.3, 0.49))) * size
        at = middle @ across.T / axes
        radius = at.square().sum(1)
        height = (1 - radius).clamp(min=0).sqrt()[:, None]
        base = torch.cat((uniform(0.3, 1.5) * (at / axes * axes.mean()) @ across, height), dim=1)
        return torch.nn.functional.normalize(base, dim=1), radius < 1
    slopes = uniform(0, 0.7) * _draw_direction(generator).expand(size * size, 2)
    for _ in range(3):
        direction = _draw_direction(generator)
        wave = (2 * math.pi * (places @ direction / (uniform(0.3, 2) * size) + uniform())).sin()
        slopes = slopes + uniform(0, 0.3) * wave[:, None] * direction
    base = torch.cat((-slopes, torch.ones(size * size, 1)), dim=1)
    return torch.nn.functional.normalize(base, dim=1), torch.ones(size * size, dtype=torch.bool)


def _draw_detail(size: int, generator: torch.Generator) -> Tensor:
    """Draw the slopes (size^2, 2) of grooves, facets or a texture."""
    uniform = partial(draw_number, generator)
    steepness = uniform(0.05, 0.6)
    kind = int(3 * uniform())
    if kind == 0:
        direction = _draw_direction(generator)
        bend = _blurred(torch.randn(1, size, size, generator=generator), 12).view(-1)
        place = _places(size) @ direction + (uniform() < 0.5) * uniform(0, 12) * bend / bend.std()
        number = (place / uniform(1, 6) + uniform(0, 2)).floor().long()
        number = number - number.min()
        side = 2.0 * (number % 2) - 1
        if uniform() < 0.5:
            side = torch.randn(int(number.max()) + 1, generator=generator)[number]
        return steepness * side[:, None] * direction
    if kind == 1:
        count = int((size / uniform(3, 20)) ** 2) + 1
        return (steepness * torch.randn(count, 2, generator=generator))[_cells(count, size, generator)]
    grain = _blurred(torch.randn(2, size, size, generator=generator), uniform(0.4, 1.5))
    return steepness / 3 * (grain / grain.std()).view(2, -1).T


def _places(size: int) -> Tensor:
    """Return the positions (size^2, 2) of the pixels, y up."""
    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    return torch.stack((columns, -rows), dim=-1).view(-1, 2)


def _draw_direction(generator: torch.Generator) -> Tensor:
    """Draw a unit vector (2,)."""
    angle = draw_number(generator, 0, 2 * math.pi)
    return torch.tensor((math.cos(angle), math.sin(angle)))


def _cells(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Return the Voronoi cell (P,) of each pixel, 0 to count - 1, around random points."""
    from scipy.spatial import cKDTree

    points = size * torch.rand(count, 2, generator=generator).numpy()
    places = np.indices((size, size)).reshape(2, -1).T
    return torch.from_numpy(cKDTree(points).query(places)[1])


def _blurred(maps: Tensor, sigma: float) -> Tensor:
    from scipy.ndimage import gaussian_filter

    return torch.from_numpy(gaussian_filter(maps.numpy(), (0, sigma, sigma), mode="wrap"))
