"""Flat pieces with detail of a few pixels, such as engraved, woven or faceted surfaces, that fill the frame.

Rendered scenes have few bends of a pixel's size. These pieces have, but no cast shadows or interreflection.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from splinecli.synthesis.scenes import CLASSES, draw_class


def draw_engraved(size: int, lights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw a piece of size x size pixels; return its unit normals (P, 3) and its radiance (P, F), pixels row-major.

    The slopes of the surface are the sum of three waves of U(0.3, 2) frames with slopes of up to 0.3, and of one kind
    of detail: V-shaped grooves U(1, 6) pixels wide to either side, facets of 3 to 20 pixels, or a random texture with a
    grain of U(0.4, 1.5) pixels. The slopes of the detail are about U(0.05, 0.6), a third of it for the texture. The
    material is that of draw_class, with 1 to 300 patches.

    Args:
        lights: (F, 3), unit.
    """

    def uniform(low: float = 0.0, high: float = 1.0) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    places = torch.stack((columns, -rows), dim=-1).view(-1, 2)  # y up

    def along() -> tuple[Tensor, Tensor]:
        """Return a random direction (2,) and the places along it (P,)."""
        angle = uniform(0, 2 * math.pi)
        direction = torch.tensor((math.cos(angle), math.sin(angle)))
        return direction, places @ direction

    slopes = torch.zeros(size * size, 2)
    for _ in range(3):
        direction, place = along()
        wave = (2 * math.pi * (place / (uniform(0.3, 2) * size) + uniform())).sin()
        slopes += uniform(0, 0.3) * wave[:, None] * direction
    steepness = uniform(0.05, 0.6)
    kind = int(3 * uniform())
    if kind == 0:
        direction, place = along()
        side = (place / uniform(1, 6) + uniform(0, 2)).floor() % 2
        slopes += steepness * (2 * side[:, None] - 1) * direction
    elif kind == 1:
        count = int((size / uniform(3, 20)) ** 2) + 1
        slopes += (steepness * torch.randn(count, 2, generator=generator))[_cells(count, size, generator)]
    else:
        noise = torch.randn(2, size, size, generator=generator)
        grain = _blurred(noise, uniform(0.4, 1.5))
        slopes += steepness / 3 * (grain / grain.std()).view(2, -1).T
    normals = torch.cat((-slopes, torch.ones(size * size, 1)), dim=1)
    normals = torch.nn.functional.normalize(normals, dim=1)
    patches = int(300 ** uniform())
    material = draw_class(
        CLASSES[int(len(CLASSES) * uniform())], patches, generator, one_gloss=uniform() < 0.5
    ).take(_cells(patches, size, generator))
    cosines = (normals @ lights.T).clamp(min=0)
    return normals, material.shade(cosines, normals[:, 2:], lights[:, 2])


def _cells(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Return the Voronoi cell (P,) of each pixel, 0 to count - 1, around random points."""
    from scipy.spatial import cKDTree

    points = size * torch.rand(count, 2, generator=generator).numpy()
    places = np.indices((size, size)).reshape(2, -1).T
    return torch.from_numpy(cKDTree(points).query(places)[1])


def _blurred(maps: Tensor, sigma: float) -> Tensor:
    from scipy.ndimage import gaussian_filter

    return torch.from_numpy(gaussian_filter(maps.numpy(), (0, sigma, sigma), mode="wrap"))
