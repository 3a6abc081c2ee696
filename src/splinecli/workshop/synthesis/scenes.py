"""Scenes for training, after CyclesPS (Ikehata, "CNN-PS", ECCV 2018), and their light transport.

A scene has one shape, three sets of materials in each of three classes, and directional lights over
the whole upper hemisphere. Additional materials take little time, because the light paths are the
same. A scene depends only on (seed, index), so an interrupted set can be continued.

The camera is orthographic, or at a finite distance. A matte white surface facing the light has
radiance 1. Each sample of a pixel is shaded with its own interpolated normal. Indirect light is
gathered along random paths that start at the samples (Kajiya, "The rendering equation", 1986). All
lights illuminate each vertex of a path at once. Visibility does not depend on the material, so
paths and shadows are traced once for all materials.

Two approximations reduce noise, because caustics would otherwise appear as single bright pixels.
First, surfaces that emit or receive indirect light have at least roughness 0.3 (path space
regularization, Kaplanyan & Dachsbacher 2013). In scenes with sharp interreflection, the lowest
roughness is 0.1 instead, except where so few paths would meet the lobe that it is noise. Second,
surface points beyond the first use the shadows of the nearest vertex.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.maths.normals import unit
from splinecli.workshop.synthesis.draw_materials import CLASSES, draw_material, with_one_gloss
from splinecli.workshop.synthesis.meshes import Floats, Mesh
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.ray_tracing import (
    TRACED_ROWS,
    Hits,
    ShadowCache,
    Tracer,
    VisibleSurface,
    find_visible_surface,
)
from splinecli.workshop.synthesis.shapes import Relief, draw_detail, draw_shape, read_relief

SOFT = 0.3  # lowest roughness of surfaces that emit or receive indirect light
# points shaded together: a tensor then takes about a megabyte and stays in the cache
SHADED_ROWS = 512

Materials = Mapping[str, PrincipledMaterial]
Progress = Callable[[float], None]


def render_direct(
    tracer: Tracer,
    visible: VisibleSurface,
    lights: Floats,
    materials: Materials,
    patch_of_face: NDArray[np.int64],
    progress: Progress = lambda _: None,
) -> dict[str, Tensor]:
    """Return radiances (P, F) of each material under lights (F, 3), with direct light and cast
    shadows only.
    """
    pixels, directions = len(visible.normals), torch.from_numpy(lights)
    radiance = {name: torch.empty(pixels, len(lights)) for name in materials}
    block = max(1, SHADED_ROWS // visible.samples_per_pixel)
    for start in range(0, pixels, large := block * (TRACED_ROWS // SHADED_ROWS)):
        rows = np.arange(start, min(start + large, pixels))
        hits = visible.samples_of(rows)
        normals = torch.from_numpy(hits.normal)
        cosines = normals @ directions.T
        n_dot_v, l_dot_v = _view_cosines(visible, rows, normals, directions)
        lit = tracer.lit(hits.lifted(), (cosines > 0).numpy(), lights)
        cosines *= torch.from_numpy(lit)
        patches = torch.from_numpy(patch_of_face[hits.triangle])
        for first in range(0, len(rows), block):
            some = slice(
                first * visible.samples_per_pixel, (first + block) * visible.samples_per_pixel
            )
            target = slice(start + first, min(start + first + block, pixels))
            for name, material in materials.items():
                along = l_dot_v if l_dot_v.ndim == 1 else l_dot_v[some]
                shaded = material.take(patches[some]).shade(cosines[some], n_dot_v[some], along)
                shape = (-1, visible.samples_per_pixel, len(lights))
                torch.mean(shaded.view(shape), dim=1, out=radiance[name][target])
        progress((rows[-1] + 1) / pixels)
    return before_black(radiance, visible)


def _view_cosines(
    visible: VisibleSurface, pixels: NDArray[np.int64], normals: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return n.v (N, 1) and l.v, (F) or (N, F), for samples of pixels with unit normals (N, 3)."""
    if visible.back is None:
        return normals[:, 2:], directions[:, 2]
    count = visible.samples_per_pixel
    back = torch.from_numpy(visible.back[(pixels[:, None] * count + np.arange(count)).ravel()])
    return (normals * back).sum(-1, keepdim=True).clamp(min=0.01), back @ directions.T


def before_black(radiance: dict[str, Tensor], visible: VisibleSurface) -> dict[str, Tensor]:
    """Return the radiance in front of a black background, weighted by the coverage of each
    pixel.
    """
    coverage = torch.from_numpy(visible.coverage)[:, None]
    return {name: values.mul_(coverage) for name, values in radiance.items()}


@dataclass(frozen=True)
class _Vertices:
    hits: Hits  # the surface points of N vertices of paths
    back: Tensor  # (N, 3), unit directions to the previous vertex
    pixel: Tensor  # (N,), the pixel of the path
    patches: Tensor  # (N,), the patch of the surface
    # (N, 1), the density per steradian with which the direction to the vertex was drawn
    density: Tensor

    def take(self, rows: Tensor) -> _Vertices:
        kept = rows.numpy()
        others = (self.back, self.pixel, self.patches, self.density)
        return _Vertices(self.hits.take(kept), *(values[rows] for values in others))


@dataclass(frozen=True)
class _Sharpness:
    """The sharpness of the lobes of surfaces that emit or receive indirect light."""

    lowest: float  # lowest roughness
    paths: int  # number of paths per pixel
    lobes: tuple[float, ...]  # lobes of the drawn directions

    def soften(
        self, material: PrincipledMaterial, vertices: _Vertices, rows: slice | Tensor
    ) -> PrincipledMaterial:
        """Return the softened materials of these vertices.

        A lobe of roughness r reflects a light into about 4 pi r^4 steradians. If fewer than one
        path is expected in it, the lobe is blunter.
        """
        if self.lowest >= SOFT:
            floor: float | Tensor = SOFT
        else:
            lone = (1 / (4 * math.pi * self.paths * vertices.density[rows])) ** 0.25
            floor = lone.clamp(min=self.lowest, max=SOFT)
        return soften(material.take(vertices.patches[rows]), floor)

    def most(self, vertices: _Vertices, rows: slice) -> float | Tensor:
        """Return the largest contribution of one path, relative to its expected share. Larger
        values are noise.
        """
        return (
            8.0 if self.lowest >= SOFT else 64 * (2 * math.pi * vertices.density[rows]).clamp(min=1)
        )


def render_indirect(  # noqa: PLR0913 - the parts of a scene, and how it is traced
    tracer: Tracer,
    visible: VisibleSurface,
    lights: Floats,
    materials: Materials,
    patch_of_face: NDArray[np.int64],
    *,
    directions: int,
    bounces: int,
    generator: torch.Generator,
    lowest_roughness: float = SOFT,
    progress: Progress = lambda _: None,
) -> dict[str, Tensor]:
    """Return radiances (P, F) of each material from light that was reflected 1 to `bounces` times
    before.

    `patch_of_face` (T,) contains the row of each face in the materials, and `directions` is the
    number of paths per pixel.
    """
    pixels = len(visible.normals)
    sharpness = _Sharpness(
        lowest_roughness, directions, LOBES if lowest_roughness >= SOFT else SHARP_LOBES
    )
    radiance = {name: torch.zeros(pixels, len(lights)) for name in materials}
    shadows = ShadowCache(tracer, lights)
    at_once = max(1, 8 * TRACED_ROWS // directions)
    for start in range(0, pixels, at_once):
        rows = torch.arange(start, min(start + at_once, pixels))
        ordinal = torch.arange(directions).repeat(len(rows))
        pixel = rows.repeat_interleave(directions)
        # Each sample gets directions from all lobes.
        turn = torch.div(ordinal, len(sharpness.lobes), rounding_mode="floor")
        sample = pixel * visible.samples_per_pixel + turn % visible.samples_per_pixel
        hits = visible.samples.take(sample.numpy())
        back = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(pixel), 3)
        if visible.back is not None:
            back = torch.from_numpy(visible.back[sample.numpy()])
        patches = torch.from_numpy(patch_of_face[hits.triangle])
        vertices = _Vertices(hits, back, pixel, patches, torch.full((len(pixel), 1), torch.inf))
        shift = torch.rand(len(rows), 2, generator=generator).repeat_interleave(directions, dim=0)
        weights = {name: torch.full((len(pixel), 1), 1 / directions) for name in materials}
        for bounce in range(bounces):
            if bounce:
                ordinal = torch.randint(0, 1 << 16, (len(vertices.pixel),), generator=generator)
                shift = torch.rand(len(vertices.pixel), 2, generator=generator)
            parts = weights, materials, sharpness
            vertices, weights = _extend(tracer, vertices, *parts, patch_of_face, ordinal, shift)
            _gather(
                vertices, weights, materials, sharpness, torch.from_numpy(lights), shadows, radiance
            )
            # Russian roulette: a path survives with its remaining weight in the brightest material
            # as probability.
            chance = (
                torch.stack(list(weights.values())).amax(dim=0)[:, 0] / (1 / directions)
            ).clamp(0.0, 1.0)
            alive = (torch.rand(len(chance), generator=generator) < chance).nonzero()[:, 0]
            vertices = vertices.take(alive)
            weights = {
                name: weight[alive] / chance[alive, None] for name, weight in weights.items()
            }
            if not len(alive):
                break
        progress((int(rows[-1]) + 1) / pixels)
    return before_black(radiance, visible)


def soften(material: PrincipledMaterial, lowest: float | Tensor) -> PrincipledMaterial:
    """Return the reflectance without lobes below a roughness, a number or (P, 1)."""
    return replace(
        material,
        roughness=material.roughness.clamp(min=lowest),
        second_roughness=material.second_roughness.clamp(min=lowest),
        clearcoat_gloss=torch.zeros_like(material.clearcoat_gloss),
    )


def _extend(  # noqa: PLR0913 - the parts of a scene
    tracer: Tracer,
    vertices: _Vertices,
    weights: dict[str, Tensor],
    materials: Materials,
    sharpness: _Sharpness,
    patch_of_face: NDArray[np.int64],
    ordinal: Tensor,
    shift: Tensor,
) -> tuple[_Vertices, dict[str, Tensor]]:
    """Return the next vertices of the paths that hit the surface again, and the weights (N, 1) of
    those paths.
    """
    normals = torch.from_numpy(vertices.hits.normal)
    direction, density = draw_directions(normals, vertices.back, ordinal, shift, sharpness.lobes)
    n_dot_w = (normals * direction).sum(-1, keepdim=True)
    above = (n_dot_w[:, 0] > 0).nonzero()[:, 0]
    rays, hits = tracer.first_hits(vertices.hits.lifted()[above.numpy()], direction[above].numpy())
    arriving = -direction[above[torch.from_numpy(rays)]].numpy()
    # The inside of the surface is black, and so are points whose interpolated normal faces away.
    outside = (hits.facet_normal * arriving).sum(axis=1) > 0
    outside &= (hits.normal * arriving).sum(axis=1) > 0
    rows = above[torch.from_numpy(rays[outside])]
    met, hits = vertices.take(rows), hits.take(outside)
    cosines = n_dot_w[rows], (normals[rows] * met.back).sum(-1, keepdim=True)
    w_dot_v = (direction[rows] * met.back).sum(-1, keepdim=True)
    onward = {}
    for name, material in materials.items():
        reflected = sharpness.soften(material, met, slice(None)).shade(
            cosines[0], cosines[1], w_dot_v
        )
        share = reflected / (np.pi * density[rows].clamp(min=1e-6))
        onward[name] = weights[name][rows] * share.clamp(max=8.0)
    patches = torch.from_numpy(patch_of_face[hits.triangle])
    return _Vertices(
        hits, -direction[rows], met.pixel, patches, density[rows].clamp(min=1e-6)
    ), onward


def _gather(
    vertices: _Vertices,
    weights: dict[str, Tensor],
    materials: Materials,
    sharpness: _Sharpness,
    lights: Tensor,
    shadows: ShadowCache,
    radiance: dict[str, Tensor],
) -> None:
    """Add the light that the vertices reflect to the radiance of their pixels."""
    lit = torch.from_numpy(shadows.lit(vertices.hits))
    for start in range(0, len(vertices.pixel), SHADED_ROWS):
        some = slice(start, start + SHADED_ROWS)
        normals, back = torch.from_numpy(vertices.hits.normal[some]), vertices.back[some]
        cosines = (normals @ lights.T).clamp(min=0) * lit[some]
        n_dot_v = (normals * back).sum(-1, keepdim=True)
        # Opposite directions have no bisector.
        l_dot_v = (back @ lights.T).clamp(min=-0.9999)
        # Vertices are grouped by pixel, so a product with few rows sums them.
        pixels, place = torch.unique_consecutive(vertices.pixel[some], return_inverse=True)
        for name, material in materials.items():
            shaded = sharpness.soften(material, vertices, some).shade(cosines, n_dot_v, l_dot_v)
            spread = torch.zeros(len(pixels), len(place))
            spread[place, torch.arange(len(place))] = weights[name][some, 0]
            radiance[name][pixels] += spread @ shaded.clamp(max=sharpness.most(vertices, some))


LOBES = (0.0, 0.1, 0.0, 0.35)
"""Widths (roughness squared) of the lobes of four successive directions; 0 is the cosine lobe."""


SHARP_LOBES = (0.0, 0.1, 0.015, 0.35)
"""The same for sharp interreflection."""


def draw_directions(
    normals: Tensor, back: Tensor, first: Tensor, shift: Tensor, lobes: Sequence[float] = LOBES
) -> tuple[Tensor, Tensor]:
    """Draw directions (N, 3), and return them with their densities (N, 1). Some may be below the
    horizon.

    The surface normals and the directions `back` to the previous vertices of the paths are (N, 3),
    unit. `first` (N,) int64 is the index of the direction within its pixel. It selects the lobe and
    the point of the R2 sequence (Roberts 2018), which covers the lobe evenly. `shift` (N, 2) is the
    offset of the pixel in the sequence.
    """
    ordinal = torch.div(first, len(lobes), rounding_mode="floor")
    u = (shift[:, 0] + ordinal * 0.7548776662466927) % 1.0
    v = (shift[:, 1] + ordinal * 0.5698402909980532) % 1.0
    tangent, bitangent = basis(normals)
    local_view = torch.stack(
        [(back * axis).sum(-1) for axis in (tangent, bitangent, normals)], dim=1
    )
    lobe = first % len(lobes)
    # Lobes of the same kind use different parts of the sequence.
    u = (u + lobe * 0.25) % 1.0
    alpha = torch.tensor(lobes)[lobe][:, None]
    radius, angle = u.sqrt(), 2 * math.pi * v
    matte = torch.stack((radius * angle.cos(), radius * angle.sin(), (1 - u).sqrt()), dim=1)
    half = _visible_normal(local_view, alpha.clamp(min=0.01), u, v)
    mirrored = 2 * (local_view * half).sum(-1, keepdim=True) * half - local_view
    local = torch.where(alpha == 0, matte, mirrored)
    world = local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normals
    return world, density(
        local[:, 2:], local_view[:, 2:], (local * local_view).sum(-1, keepdim=True), lobes
    )


def density(
    n_dot_w: Tensor, n_dot_v: Tensor, w_dot_v: Tensor, lobes: Sequence[float] = LOBES
) -> Tensor:
    """Return the density of the mixture per steradian, from cosines of the same shape."""
    half_length = (2 * (1 + w_dot_v)).clamp(min=1e-6).sqrt()
    n_dot_h = ((n_dot_w + n_dot_v) / half_length).clamp(0, 1)
    total = lobes.count(0.0) * n_dot_w.clamp(min=0) / math.pi
    for alpha in lobes:
        if alpha:
            squared = alpha * alpha
            spread = n_dot_h * n_dot_h * (squared - 1) + 1
            visible = 2 / (n_dot_v + (squared + (1 - squared) * n_dot_v * n_dot_v).sqrt())
            total = total + squared / (math.pi * spread * spread) * visible / 4
    return total / len(lobes)


def basis(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors (N, 3) that form a right-handed frame with each unit normal (Duff et
    al. 2017).
    """
    x, y, z = normals.unbind(dim=1)
    sign = torch.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), dim=1)
    return tangent, torch.stack((b, sign + y * y * a, -y), dim=1)


def _visible_normal(view: Tensor, alpha: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return visible normals (N, 3) in the frame of the surface normal, by Heitz's method."""
    stretched = torch.nn.functional.normalize(
        torch.cat((alpha * view[:, :2], view[:, 2:].clamp(min=1e-4)), dim=1), dim=1
    )
    first, second = basis(stretched)
    radius, angle = u.sqrt(), 2 * math.pi * v
    across, along = radius * angle.cos(), radius * angle.sin()
    # `second` must be the axis along which the horizon cuts the disc, the axis closer to the
    # normal.
    upward = torch.stack((first[:, 2], second[:, 2]), dim=1)
    length = upward.norm(dim=1, keepdim=True).clamp(min=1e-6)
    cosine, sine = (upward / length).unbind(dim=1)
    level = sine[:, None] * first - cosine[:, None] * second
    steep = cosine[:, None] * first + sine[:, None] * second
    share = 0.5 * (1 + stretched[:, 2])
    along = (1 - share) * (1 - across * across).clamp(min=0).sqrt() + share * along
    depth = (1 - across * across - along * along).clamp(min=0).sqrt()
    normal = across[:, None] * level + along[:, None] * steep + depth[:, None] * stretched
    return torch.nn.functional.normalize(
        torch.cat((alpha * normal[:, :2], normal[:, 2:].clamp(min=1e-6)), dim=1), dim=1
    )


MATERIALS = {
    f"{name}{suffix}": kinds for suffix in ("", "-2", "-3") for name, kinds in CLASSES.items()
}
"""The material sets of a scene, each with the range of the number that selects the kind; see
draw_material.
"""

MIN_LIGHT_Z = 0.03  # lowest z of a light, the cosine of its angle to the viewing direction


@dataclass(frozen=True)
class SceneConfig:
    """Settings for drawing and rendering scenes."""

    size: int = 128  # width and height in pixels
    lights: int = 100  # F, the number of lights
    samples: int = 3  # k of the k x k samples per pixel
    directions: int = 96  # number of paths per pixel for indirect light
    # largest number of reflections before the visible surface; 0 for direct light only
    bounces: int = 4
    # sharp_share, perspective_share: shares of the scenes with sharp interreflection, along twice
    # as many paths, and of those with a camera at a finite distance; see draw_scene
    sharp_share: float = 0.0
    perspective_share: float = 0.0


@dataclass(frozen=True)
class Scene:
    """A scene before rendering."""

    shape: str  # kind of the shape
    mesh: Mesh  # the shape
    lights: Floats  # (F, 3), unit directions towards the lights
    # by the names in MATERIALS, with one row per patch of the surface
    materials: dict[str, PrincipledMaterial]
    patch_of_face: NDArray[np.int64]  # (T,), the patch of each face
    seed: int  # seed of the paths of indirect light
    relief: Relief | None = None  # on the surface
    sharp: bool = False  # whether interreflection is sharp
    # of the camera, in halves of the frame's width; infinite for an orthographic one
    distance: float = math.inf


@dataclass(frozen=True)
class RenderedScene:
    """The images of a scene."""

    mask: NDArray[np.bool_]  # (H, W)
    normals: Floats  # (P, 3), unit; pixels row-major
    # by the names in MATERIALS, (P, F) float32; 1 is a matte white surface that faces the light and
    # fills the pixel
    observations: dict[str, Floats]


def draw_scene(
    seed: int,
    index: int,
    config: SceneConfig,
    mesh: Mesh | None = None,
    reliefs: Sequence[Path] = (),
) -> Scene:
    """Draw scene number `index` of the set with this seed, with the given mesh or a random shape
    for None.

    Half of the scenes get a relief from one of the normal maps, if any are given; see draw_detail.
    The surface has one patch in 60 % of the scenes, because real objects have one or few materials,
    2 to 12 in 25 %, and 20 to 3,000 in 15 %. In half of the scenes, the patches differ only in
    their base colour, as on a painted or printed object of uniform gloss. A camera at a finite
    distance is 1 / U(0.02, 0.25) halves of the frame's width away, and at least a frame's width
    from the shape: at 0.25, the frame is 28 degrees wide. Raises UsageError if the extra `render`
    is not installed.
    """
    rng = np.random.default_rng([seed, index])
    lights = draw_lights(config.lights, rng)
    kind = rng.random()
    patches = (
        1 if kind < 0.6 else int(rng.integers(2, 13) if kind < 0.85 else rng.integers(20, 3001))
    )
    one_gloss = rng.random() < 0.5
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    render_seed = int(rng.integers(2**62))
    materials: dict[str, PrincipledMaterial] = {}
    for name, kinds in MATERIALS.items():
        material = draw_material(patches, generator, kinds)
        materials[name] = with_one_gloss(material) if one_gloss else material
    # Draw the shape last, because it needs a varying number of random values.
    # With multiples of the golden ratio, even a small set has several kinds of shapes.
    place = (np.random.default_rng(seed).random() + index * (np.sqrt(5) - 1) / 2) % 1
    shape, mesh = ("given", mesh) if mesh is not None else draw_shape(rng, place)
    patch_of_face = draw_patches(mesh, patches, rng)
    own = np.random.default_rng([seed, index, 1])
    relief = None
    if reliefs and own.random() < 0.5:
        relief = draw_detail(
            read_relief(reliefs[int(own.integers(len(reliefs)))]), config.size, own
        )
    optional = np.random.default_rng([seed, index, 3])
    sharp = optional.random() < config.sharp_share
    distance = math.inf
    if optional.random() < config.perspective_share:
        distance = max(1 / optional.uniform(0.02, 0.25), float(mesh.vertices[:, 2].max()) + 2)
    return Scene(
        shape, mesh, lights, materials, patch_of_face, render_seed, relief, sharp, distance
    )


def render_scene(
    scene: Scene, config: SceneConfig, progress: Callable[[float], None] | None = None
) -> RenderedScene:
    """Render the scene in all its materials. `progress` is called with the finished share, from 0
    to 1.

    Raises UsageError if the extra `render` is not installed.
    """
    report = progress or (lambda _: None)
    tracer = Tracer(scene.mesh)
    bend = None if scene.relief is None else scene.relief.bend
    visible = find_visible_surface(
        tracer, config.size, config.samples, bend, distance=scene.distance
    )
    parts = tracer, visible, scene.lights, scene.materials, scene.patch_of_face
    with torch.inference_mode():
        radiance = render_direct(*parts, progress=lambda share: report(0.4 * share))
        if config.bounces and len(visible.normals):
            indirect = render_indirect(
                *parts,
                directions=config.directions * (2 if scene.sharp else 1),
                lowest_roughness=0.1 if scene.sharp else SOFT,
                bounces=config.bounces,
                generator=torch.Generator().manual_seed(scene.seed),
                progress=lambda share: report(0.4 + 0.6 * share),
            )
            for name, received in indirect.items():
                radiance[name] += received
    return RenderedScene(
        visible.mask, visible.normals, {name: values.numpy() for name, values in radiance.items()}
    )


def draw_lights(count: int, rng: np.random.Generator) -> Floats:
    """Draw light directions (count, 3), about uniform over the upper hemisphere.

    They are a Fibonacci spiral (Gonzalez 2010), rotated by a random angle. Each light is then moved
    by a third of the mean distance.
    """
    order = np.arange(count)
    z = 1 - (1 - MIN_LIGHT_Z) * (order + 0.5) / count
    azimuth = order * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    radius = np.sqrt(1 - z * z)
    directions = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1)
    directions += rng.normal(size=(count, 3)) * np.sqrt(2 * np.pi / count) / 3
    directions[:, 2] = np.maximum(directions[:, 2], MIN_LIGHT_Z * 1.5)
    return unit(directions).astype(np.float32)


def draw_patches(mesh: Mesh, patches: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw the patch of each face (T,), 0 to patches - 1: Voronoi cells around random faces."""
    from scipy.spatial import cKDTree

    centres = mesh.vertices[mesh.faces].mean(axis=1)
    seeds = centres[rng.integers(len(centres), size=patches)]
    return np.asarray(cKDTree(seeds).query(centres)[1], dtype=np.int64)
