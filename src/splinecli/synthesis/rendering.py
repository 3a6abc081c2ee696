"""Light transport: what an orthographic camera along -z sees of a mesh under single directional lights.

Radiance is in the unit "matte white facing the light = 1". A pixel is the mean of k x k samples on a regular
grid, each shaded with its own interpolated normal: one sample at the centre misjudges glossy metal by a tenth.

Light that comes by way of other surfaces is gathered along random paths (Kajiya, "The rendering equation", 1986)
that start from the samples. A path's vertices are lit by all lights at once, with the full reflectance at each,
and visibility does not depend on the material: paths and shadows are traced once for all materials.

Two departures hold the noise down, as caustics would otherwise come as single bright pixels: at the ends of
indirect light reflectances are no sharper than roughness SOFTEST (path space regularization, Kaplanyan &
Dachsbacher 2013), and shadows beyond the first surface are those of the nearest vertex.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.synthesis.material import Material
from splinecli.synthesis.meshes import Floats
from splinecli.synthesis.mixed_material import MixedMaterial
from splinecli.synthesis.principled import PrincipledMaterial
from splinecli.synthesis.ray_tracing import TRACED_ROWS, Hits, ShadowCache, Tracer
from splinecli.synthesis.sampling import LOBES, draw_directions

SOFTEST = 0.3
# Grazing samples are left out: a hair's width of silhouette says nothing of a pixel.
MIN_NORMAL_Z = 0.05
# Limits on what one path may carry, over its expected share; beyond lies noise alone.
MOST_WEIGHT = 8.0
MOST_RADIANCE = 8.0
# Rows of (points, lights) shaded together: about a megabyte a tensor, which stays in the cache.
SHADED_ROWS = 512

Materials = Mapping[str, Material]
Progress = Callable[[float], None]


@dataclass(frozen=True)
class View:
    """What the camera sees in P pixels with S samples each.

    mask (H, W); normals (P, 3): unit mean of the samples' normals, pixels row-major; samples: P * S surface
    points, those of a pixel together.
    """

    mask: NDArray[np.bool_]
    normals: Floats
    samples: Hits
    samples_per_pixel: int


def look(tracer: Tracer, size: int, samples: int) -> View:
    """The surface in size x size pixels of samples x samples samples each.

    Pixels whose samples do not all meet the surface, or that are seen at a grazing angle, are left out.
    """
    steps = (np.arange(size * samples, dtype=np.float32) + 0.5) * np.float32(2 / (size * samples)) - 1
    row, column = np.meshgrid(np.arange(size * samples), np.arange(size * samples), indexing="ij")

    def by_pixel(grid: NDArray[np.int64]) -> NDArray[np.int64]:
        return grid.reshape(size, samples, size, samples).transpose(0, 2, 1, 3).ravel()

    x, y = steps[by_pixel(column)], -steps[by_pixel(row)]
    top = np.full_like(x, tracer.mesh.vertices[:, 2].max() + 1)
    rays, hits = tracer.first_hits(np.stack((x, y, top), axis=1), np.array([[0, 0, -1]], dtype=np.float32))
    front = hits.normal[:, 2] > 0
    rays, hits = rays[front], hits.take(front)
    per_pixel = samples * samples
    pixel = rays // per_pixel
    whole = np.bincount(pixel, minlength=size * size) == per_pixel
    hits = hits.take(whole[pixel])
    normals = hits.normal.reshape(-1, per_pixel, 3).mean(axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kept = normals[:, 2] > MIN_NORMAL_Z
    whole[whole] = kept
    return View(whole.reshape(size, size), normals[kept], hits.take(np.repeat(kept, per_pixel)), per_pixel)


def render_direct(
    tracer: Tracer,
    view: View,
    lights: Floats,
    materials: Materials,
    patch_of_face: NDArray[np.int64],
    progress: Progress = lambda _: None,
) -> dict[str, Tensor]:
    """Radiance (P, F) of each material under lights (F, 3) that reach the surface straight; cast shadows."""
    pixels, directions = len(view.normals), torch.from_numpy(lights)
    radiance = {name: torch.empty(pixels, len(lights)) for name in materials}
    block = max(1, SHADED_ROWS // view.samples_per_pixel)
    for start in range(0, pixels, large := block * (TRACED_ROWS // SHADED_ROWS)):
        rows = np.arange(start, min(start + large, pixels))
        hits = view.samples.take(slice_of(rows, view.samples_per_pixel))
        normals = torch.from_numpy(hits.normal)
        cosines = normals @ directions.T
        lit = tracer.lit(hits.lifted(), (cosines > 0).numpy(), lights)
        cosines *= torch.from_numpy(lit)
        patches = torch.from_numpy(patch_of_face[hits.triangle])
        for first in range(0, len(rows), block):
            some = slice(first * view.samples_per_pixel, (first + block) * view.samples_per_pixel)
            target = slice(start + first, min(start + first + block, pixels))
            for name, material in materials.items():
                shaded = material.take(patches[some]).shade(
                    cosines[some], normals[some, 2:], directions[:, 2]
                )
                shape = (-1, view.samples_per_pixel, len(lights))
                torch.mean(shaded.view(shape), dim=1, out=radiance[name][target])
        progress((rows[-1] + 1) / pixels)
    return radiance


def slice_of(pixels: NDArray[np.int64], samples: int) -> NDArray[np.int64]:
    """Rows (len(pixels) * samples,) of the samples of some pixels."""
    return (pixels[:, None] * samples + np.arange(samples)).ravel()


@dataclass(frozen=True)
class _Vertices:
    """N points on paths: surface points, unit directions (N, 3) to where the path came from, and its pixel."""

    hits: Hits
    views: Tensor
    pixel: Tensor
    patches: Tensor

    def take(self, rows: Tensor) -> _Vertices:
        kept = rows.numpy()
        return _Vertices(self.hits.take(kept), self.views[rows], self.pixel[rows], self.patches[rows])


def render_indirect(
    tracer: Tracer,
    view: View,
    lights: Floats,
    materials: Materials,
    patch_of_face: NDArray[np.int64],
    *,
    directions: int,
    bounces: int,
    generator: torch.Generator,
    progress: Progress = lambda _: None,
) -> dict[str, Tensor]:
    """Radiance (P, F) of each material from light that has met 1 to `bounces` other surfaces before.

    directions: paths a pixel.
    """
    pixels = len(view.normals)
    soft = {name: soften(material) for name, material in materials.items()}
    radiance = {name: torch.zeros(pixels, len(lights)) for name in materials}
    shadows = ShadowCache(tracer, lights)
    at_once = max(1, 8 * TRACED_ROWS // directions)
    for start in range(0, pixels, at_once):
        rows = torch.arange(start, min(start + at_once, pixels))
        ordinal = torch.arange(directions).repeat(len(rows))
        pixel = rows.repeat_interleave(directions)
        # Every sample gets directions of all lobes.
        turn = torch.div(ordinal, len(LOBES), rounding_mode="floor")
        sample = pixel * view.samples_per_pixel + turn % view.samples_per_pixel
        hits = view.samples.take(sample.numpy())
        towards_camera = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(pixel), 3)
        patches = torch.from_numpy(patch_of_face[hits.triangle])
        vertices = _Vertices(hits, towards_camera, pixel, patches)
        shift = torch.rand(len(rows), 2, generator=generator).repeat_interleave(directions, dim=0)
        weights = {name: torch.full((len(pixel), 1), 1 / directions) for name in materials}
        for bounce in range(bounces):
            if bounce:
                ordinal = torch.randint(0, 1 << 16, (len(vertices.pixel),), generator=generator)
                shift = torch.rand(len(vertices.pixel), 2, generator=generator)
            vertices, weights = _extend(tracer, vertices, weights, soft, patch_of_face, ordinal, shift)
            _gather(vertices, weights, soft, torch.from_numpy(lights), shadows, radiance)
            vertices, weights = _thin_out(vertices, weights, 1 / directions, generator)
            if not len(vertices.pixel):
                break
        progress((int(rows[-1]) + 1) / pixels)
    return radiance


def soften(material: Material) -> Material:
    """A reflectance without the sharpest lobes, for surfaces that light others."""
    if isinstance(material, PrincipledMaterial):
        return replace(
            material,
            roughness=material.roughness.clamp(min=SOFTEST),
            clearcoat_gloss=torch.zeros_like(material.clearcoat_gloss),
        )
    if isinstance(material, MixedMaterial):
        return replace(material, parts=tuple(soften(part) for part in material.parts))
    return material


def _extend(
    tracer: Tracer,
    vertices: _Vertices,
    weights: dict[str, Tensor],
    materials: Materials,
    patch_of_face: NDArray[np.int64],
    ordinal: Tensor,
    shift: Tensor,
) -> tuple[_Vertices, dict[str, Tensor]]:
    """The next vertices of those paths that meet the surface again, and the paths' weights (N, 1) there."""
    normals = torch.from_numpy(vertices.hits.normal)
    direction, density = draw_directions(normals, vertices.views, ordinal, shift)
    n_dot_w = (normals * direction).sum(-1, keepdim=True)
    above = (n_dot_w[:, 0] > 0).nonzero()[:, 0]
    rays, hits = tracer.first_hits(vertices.hits.lifted()[above.numpy()], direction[above].numpy())
    back = -direction[above[torch.from_numpy(rays)]]
    # The inside of the surface is black, and so is what its smooth normal turns away.
    outside = (hits.facet_normal * back.numpy()).sum(axis=1) > 0
    outside &= (hits.normal * back.numpy()).sum(axis=1) > 0
    rows = above[torch.from_numpy(rays[outside])]
    met, hits = vertices.take(rows), hits.take(outside)
    cosines = n_dot_w[rows], (normals[rows] * met.views).sum(-1, keepdim=True)
    w_dot_v = (direction[rows] * met.views).sum(-1, keepdim=True)
    onward = {}
    for name, material in materials.items():
        reflected = material.take(met.patches).shade(cosines[0], cosines[1], w_dot_v)
        share = reflected / (np.pi * density[rows].clamp(min=1e-6))
        onward[name] = weights[name][rows] * share.clamp(max=MOST_WEIGHT)
    patches = torch.from_numpy(patch_of_face[hits.triangle])
    return _Vertices(hits, -direction[rows], met.pixel, patches), onward


def _gather(
    vertices: _Vertices,
    weights: dict[str, Tensor],
    materials: Materials,
    lights: Tensor,
    shadows: ShadowCache,
    radiance: dict[str, Tensor],
) -> None:
    """Add to their pixels what all lights make of the vertices."""
    shadows.expect(vertices.hits)
    for start in range(0, len(vertices.pixel), SHADED_ROWS):
        some = slice(start, start + SHADED_ROWS)
        hits = vertices.hits.take(np.arange(start, min(start + SHADED_ROWS, len(vertices.pixel))))
        normals, views = torch.from_numpy(hits.normal), vertices.views[some]
        cosines = (normals @ lights.T).clamp(min=0) * torch.from_numpy(shadows.lit(hits))
        n_dot_v = (normals * views).sum(-1, keepdim=True)
        # Half way between opposite directions there is none.
        l_dot_v = (views @ lights.T).clamp(min=-0.9999)
        # Vertices of a pixel follow each other, so they are summed by a product with few rows.
        pixels, place = torch.unique_consecutive(vertices.pixel[some], return_inverse=True)
        for name, material in materials.items():
            shaded = material.take(vertices.patches[some]).shade(cosines, n_dot_v, l_dot_v)
            spread = torch.zeros(len(pixels), len(place))
            spread[place, torch.arange(len(place))] = weights[name][some, 0]
            radiance[name][pixels] += spread @ shaded.clamp(max=MOST_RADIANCE)


def _thin_out(
    vertices: _Vertices, weights: dict[str, Tensor], full: float, generator: torch.Generator
) -> tuple[_Vertices, dict[str, Tensor]]:
    """Russian roulette: paths go on with the probability that is left of their weight, in the best material."""
    left = torch.stack(list(weights.values())).amax(dim=0)[:, 0] / full
    chance = left.clamp(0.0, 1.0)
    rows = (torch.rand(len(chance), generator=generator) < chance).nonzero()[:, 0]
    survived = {name: weight[rows] / chance[rows, None] for name, weight in weights.items()}
    return vertices.take(rows), survived
