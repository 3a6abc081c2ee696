"""Scenes for benchmarks/judgement.py: shapes, materials and arrangements of lights by name.

Shapes and arrangements differ from those that weights are trained on and checks are fitted to. The
renderer is the project's own, with cast shadows and light between surfaces.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from measured_spheres import Materials, read_materials
from point_lights import render_point_lights
from splinecli.capture.record import in_one_plane
from splinecli.maths.normals import unit
from splinecli.workshop.synthesis import meshes, shapes
from splinecli.workshop.synthesis.meshes import Mesh, fit_to_frame, read_mesh, split_long_edges
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import draw_patches, render_direct, render_indirect
from splinecli.workshop.synthesis.shapes import joined, turn

Floats = NDArray[np.floating]
Random = np.random.Generator
COUNT = 160  # rows and columns of a surface
FRAME = 1.06  # half-width of surfaces that fill the image
SAMPLES = 2  # along a side of a pixel
PATHS, BOUNCES = 24, 2  # of light between surfaces
LEAST_SHARE = 0.04  # of the pixels that show the object


# Shapes


def grid_mesh(points: Floats, normals: Floats | None = None) -> Mesh:
    """Return the surface through points (U, V, 3), seen from the side where V x U points."""
    if normals is None:
        normals = unit(np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0)))
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    first = np.stack((corner, corner + 1, corner + columns), axis=1)
    second = np.stack((corner + 1, corner + columns + 1, corner + columns), axis=1)
    flat = [values.reshape(-1, 3).astype(np.float32) for values in (points, normals)]
    return Mesh(flat[0], np.concatenate((first, second)).astype(np.int32), flat[1])


def lathe(radius: Floats, height: Floats) -> Mesh:
    """Rotate a profile (N,) about z; it runs outwards below, up outside, and down inside."""
    angle = np.linspace(0, 2 * np.pi, COUNT)
    around = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    slope = np.stack((np.gradient(height), -np.gradient(radius)), axis=1)
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)

    def place(across: Floats, along: Floats) -> Floats:
        flat = across[:, None, None] * around
        return np.concatenate(
            (flat, np.broadcast_to(along[:, None, None], (*flat.shape[:2], 1))), 2
        )

    return grid_mesh(place(radius, height), place(*slope.T))


def tilted(mesh: Mesh, rng: Random, most_deg: float, least_deg: float = 0) -> Mesh:
    """Tilt a mesh towards a random side."""
    side = rng.uniform(0, 2 * np.pi)
    axis = np.array((np.cos(side), np.sin(side), 0))
    turned = Rotation.from_rotvec(np.radians(rng.uniform(least_deg, most_deg)) * axis)
    return turn(mesh, turned.as_matrix().astype(np.float32))


def draw_ellipsoid(rng: Random) -> Mesh:
    axes = np.full(3, 0.9) if rng.random() < 0.4 else rng.uniform(0.45, 0.95, 3)
    angle = np.linspace(-np.pi / 2, np.pi / 2, COUNT)
    ball = lathe(np.cos(angle), np.sin(angle))
    normals = unit(ball.vertex_normals / axes).astype(np.float32)
    mesh = Mesh((ball.vertices * axes).astype(np.float32), ball.faces, normals)
    return turn(mesh, shapes.draw_rotation(rng))


def draw_torus(rng: Random) -> Mesh:
    angle, tube = np.linspace(0, 2 * np.pi, COUNT), rng.uniform(0.25, 0.45)
    return tilted(lathe(1 + tube * np.cos(angle), tube * np.sin(angle)), rng, 65)


def draw_vase(rng: Random) -> Mesh:
    """Draw a vase or a goblet, seen from the side or a little from above."""
    radii = rng.uniform(0.2, 0.6, 6)
    if rng.random() < 0.4:  # a goblet: foot, stem and cup
        radii[:3] = 0.45, rng.uniform(0.1, 0.15), rng.uniform(0.12, 0.2)
    height = np.linspace(-0.9, 0.9, COUNT)
    outside = PchipInterpolator(np.linspace(-0.9, 0.9, 6), radii)(height)
    inside = np.maximum(outside - 0.05, 0.03)[: COUNT // 2 - 1 : -1]
    mesh = lathe(
        np.concatenate(([0.0], outside, inside, [0.0])),
        np.concatenate(([-0.9], height, height[: COUNT // 2 - 1 : -1], [0.0])),
    )
    upright = Rotation.from_euler("x", -90 + rng.uniform(0, 30), degrees=True)
    lean = Rotation.from_euler("z", rng.uniform(-25, 25), degrees=True)
    return turn(mesh, (lean * upright).as_matrix().astype(np.float32))


def draw_bowl(rng: Random) -> Mesh:
    """Draw a bowl that shows its inside."""
    depth, wall = rng.uniform(0.35, 0.9), rng.uniform(0.04, 0.1)
    angle = np.linspace(0, np.pi / 2, COUNT)
    outside = np.sin(angle), -depth * np.cos(angle)
    inside = [((1 - wall) * values)[::-1] for values in outside]
    return tilted(lathe(*np.concatenate((outside, inside), axis=1)), rng, 25)


def draw_face(rng: Random) -> Mesh:
    """Draw a head with eyes, brows, a nose and a mouth."""

    def part(x: float, y: float, z: float, *axes: float) -> meshes.Field:
        axes_drawn = (np.array(axes) * rng.uniform(0.8, 1.2, 3)).astype(np.float32)
        centre = np.array((x, y, z), np.float32)
        return meshes.moved(meshes.ellipsoid(axes_drawn), np.eye(3, dtype=np.float32), centre)

    head = part(0, 0, 0, 0.65, 0.85, 0.55)
    added = [
        part(0, -0.1, 0.55, 0.1, 0.2, 0.16),
        *(part(side, 0.3, 0.42, 0.22, 0.06, 0.1) for side in (-0.27, 0.27)),
        *(part(side, -0.4, 0.48, 0.18, 0.05, 0.08) for side in (-0.06, 0.06)),
    ]
    cut = [part(side, 0.12, 0.56, 0.16, 0.1, 0.12) for side in (-0.27, 0.27)]
    balls = [part(side, 0.12, 0.43, 0.1, 0.07, 0.08) for side in (-0.27, 0.27)]

    def distance(points: Floats) -> Floats:
        shape = head(points)
        for each in added:
            shape = meshes.smooth_union(shape, each(points), 0.12)
        for each in cut:
            shape = meshes.smooth_cut(shape, each(points), 0.08)
        for each in balls:
            shape = meshes.smooth_union(shape, each(points), 0.03)
        return shape

    return tilted(fit_to_frame(meshes.triangulate(distance, (1.1, 1.1, 1.1), 0.025)), rng, 25)


def draw_cloth(rng: Random) -> Mesh:
    """Draw a relief that fills the image and has no outline."""
    place = np.linspace(-FRAME, FRAME, 2 * COUNT)
    points = np.stack((*np.meshgrid(place, place), np.zeros((2 * COUNT, 2 * COUNT))), axis=-1)
    flat = points.reshape(-1, 3).astype(np.float32)
    heights = shapes.draw_waves(rng, (0.4, 1.2), (0.15, 0.5))(flat)
    if rng.random() < 0.6:
        heights = heights + shapes.draw_folds(rng, (0.6, 1.5), (0.1, 0.4))(flat)
    points[..., 2] = heights.reshape(points.shape[:2])
    return grid_mesh(points)


def draw_coin(rng: Random) -> Mesh:
    """Draw a flat disc with a low relief and a rim."""
    radius, angle = np.meshgrid(
        np.linspace(0.93, 0.002, 2 * COUNT), np.linspace(0, 2 * np.pi, 2 * COUNT), indexing="ij"
    )
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    flat = np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3).astype(np.float32)
    heights = shapes.draw_waves(rng, (1.5, 3), (0.15, 0.5))(flat).reshape(x.shape)
    inside = 1 / (1 + np.exp((radius - 0.78) / 0.02))
    rim = 0.05 * np.exp(-(((radius - 0.87) / 0.04) ** 2))
    return tilted(grid_mesh(np.stack((x, y, heights * inside + rim), axis=-1)), rng, 12)


def draw_gem(rng: Random) -> Mesh:
    """Draw a convex body of flat facets."""
    corners = unit(rng.normal(size=(rng.integers(14, 50), 3))) * rng.uniform(0.6, 1, 3)
    hull = ConvexHull(corners)
    faces = corners[hull.simplices]
    normals = hull.equations[:, :3]
    inward = (np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]) * normals).sum(1) < 0
    faces[inward] = faces[inward, ::-1]
    single = np.arange(3 * len(faces)).reshape(-1, 3).astype(np.int32)
    flat = [values.reshape(-1, 3).astype("f4") for values in (faces, normals[:, None].repeat(3, 1))]
    return split_long_edges(fit_to_frame(Mesh(flat[0], single, flat[1])), longest=0.08)


def draw_bodies(rng: Random) -> Mesh:
    """Draw two to five bodies beside and before each other."""
    kinds = (draw_ellipsoid, draw_torus, draw_gem, draw_vase)
    group = None
    for number in range(rng.integers(2, 6)):
        mesh = fit_to_frame(kinds[rng.integers(len(kinds))](rng))
        angle = 2.4 * number + rng.uniform(0, 0.5)
        centre = (0.7 * np.cos(angle), 0.7 * np.sin(angle), rng.uniform(-0.2, 0.2))
        vertices = mesh.vertices * rng.uniform(0.35, 0.7) + np.array(centre)
        placed = Mesh(vertices.astype(np.float32), mesh.faces, mesh.vertex_normals)
        group = placed if group is None else joined(group, placed, placed.vertices)
    return group


SHAPES: dict[str, Callable[[Random], Mesh]] = {
    "ellipsoid": draw_ellipsoid,
    "torus": draw_torus,
    "vase": draw_vase,
    "bowl": draw_bowl,
    "face": draw_face,
    "cloth": draw_cloth,
    "coin": draw_coin,
    "gem": draw_gem,
    "blobs": lambda rng: shapes.draw_shape(rng, rng.uniform(0, 0.6))[1],  # carved, rough
    "bodies": draw_bodies,
}


def draw_mesh_of_file(files: Sequence[Path], rng: Random) -> Mesh:
    mesh = read_mesh(files[rng.integers(len(files))])
    return fit_to_frame(tilted(turn(mesh, shapes.draw_rotation(rng)), rng, 20))


# Materials

Look = dict[str, float]
MATERIALS: dict[str, Callable[[Random], Look]] = {
    "matte": lambda r: {"base": r.uniform(0.25, 0.9), "minnaert": r.uniform(0.95, 1.15)},
    "varying": lambda r: {"base": -1, "minnaert": r.uniform(0.95, 1.15)},
    "plastic": lambda r: {
        "base": r.uniform(0.2, 0.7),
        "specular": r.uniform(0.4, 1),
        "roughness": r.uniform(0.25, 0.45),
    },
    "sharp gloss": lambda r: {
        "base": r.uniform(0.15, 0.6),
        "specular": 0.5,
        "roughness": r.uniform(0.07, 0.15),
        "clearcoat": r.uniform(0, 3),
        "clearcoat_gloss": r.uniform(0.7, 1),
    },
    "sheen": lambda r: {
        "base": r.uniform(0.1, 0.6),
        "sheen": r.uniform(0.3, 1),
        "retro": r.uniform(0.1, 0.6),
    },
    "rough metal": lambda r: {
        "base": r.uniform(0.4, 0.9),
        "metallic": 1,
        "roughness": r.uniform(0.5, 0.75),
    },
    "shiny metal": lambda r: {
        "base": r.uniform(0.4, 0.9),
        "metallic": 1,
        "roughness": r.uniform(0.22, 0.4),
    },
    "dark": lambda r: {
        "base": r.uniform(0.015, 0.06),
        "specular": r.uniform(0.3, 0.8),
        "roughness": r.uniform(0.3, 0.6),
    },
    "measured": lambda r: {"base": r.uniform(0.2, 0.6)},  # between surfaces; see Measured
    "translucent": lambda r: {"base": r.uniform(0.4, 0.9)},  # see translucent
}
PLAIN: Look = {"specular": 0.1, "roughness": 0.9, "minnaert": 1, "tail_exponent": 2}
PLAIN |= {"second_roughness": 1}


def make_material(name: str, patches: int, rng: Random) -> PrincipledMaterial:
    look = PLAIN | MATERIALS[name](rng)
    values = {
        key: torch.full((patches, 1), float(look.get(key, 0)))
        for key in PrincipledMaterial.__dataclass_fields__
    }
    if look["base"] < 0:
        values["base"] = torch.from_numpy(10 ** rng.uniform(-1, -0.05, (patches, 1))).float()
    return PrincipledMaterial(**values)


@dataclass(frozen=True)
class Measured:
    """One measured material on all patches, for the renderer of direct light."""

    materials: Materials
    number: int
    count: int

    def take(self, patches: Any) -> "Measured":
        return Measured(self.materials, self.number, len(patches))

    def shade(self, n_dot_l: Any, n_dot_v: Any, l_dot_v: Any) -> Any:
        index = torch.full((len(n_dot_l),), self.number)
        return self.materials.shade(index, n_dot_l, n_dot_v, l_dot_v)


def translucent(
    mask: NDArray[np.bool_], matte: Floats, cosines: Floats, falloff: Floats, wrap: float
) -> Floats:
    """Return the radiance (P, F) of matte pixels through which light also scatters.

    Light reaches `wrap` beyond the terminator, and shadows are soft. `cosines` and `falloff`, 1 for
    distant lamps, are (P, F).
    """
    lit = np.where(cosines > 0.05, matte / falloff / np.maximum(cosines, 0.05), np.nan)
    white = np.nanquantile(lit, 0.9)
    shadow = np.zeros((*mask.shape, lit.shape[1]))
    shadow[mask] = np.nan_to_num(lit / white, nan=1).clip(0, 1.3)
    weight = gaussian_filter(mask.astype(float), 1.5)[mask][:, None]
    soft = gaussian_filter(shadow, (1.5, 1.5, 0))[mask] / weight
    return white * soft * falloff * ((cosines + wrap) / (1 + wrap)).clip(0)


# Lights

ARRANGEMENTS = ("dome", "ring", "two rings", "hand-held", "line")


def draw_lights(name: str, count: int, widest_deg: float, rng: Random) -> Floats:
    """Draw light directions (F, 3), not in one plane, up to an angle from the view."""
    while True:
        azimuth = 2 * np.pi * (np.arange(count) + rng.random()) / count
        if name == "dome":
            least = np.cos(np.radians(widest_deg))
            polar = np.degrees(np.arccos(np.linspace(0.98, least, count)))
            azimuth = 2.39996 * np.arange(count) + rng.uniform(0, 6.3) + rng.normal(0, 0.1, count)
        elif name == "ring":
            polar = np.full(count, rng.uniform(30, min(60, widest_deg))) + rng.normal(0, 1, count)
        elif name == "two rings":
            inner = rng.uniform(15, 30)
            polar = np.where(np.arange(count) % 2, inner, rng.uniform(inner + 15, widest_deg))
        elif name == "hand-held":
            polar = rng.uniform(12, widest_deg, count)
            azimuth = np.sort(azimuth[0] + rng.uniform(0, rng.uniform(4.2, 6.3), count))
        elif rng.random() < 0.5:  # an arc from one side over the top to the other
            arc = np.radians(rng.uniform(150, 230))
            azimuth = azimuth[0] + np.linspace(0, arc, count) + rng.normal(0, 0.05, count)
            polar = np.full(count, rng.uniform(35, min(60, widest_deg))) + rng.normal(0, 3, count)
        else:  # a line beside the view, placed by hand: a straight rail would be in one plane
            along = np.linspace(-1, 1, count) * 0.95 * np.sin(np.radians(widest_deg))
            beside = rng.uniform(0.25, 0.45) + rng.normal(0, 0.12, count)
            polar = np.degrees(np.arcsin(np.hypot(along, beside).clip(max=0.999)))
            azimuth = np.arctan2(beside, along) + azimuth[0]
        polar = np.radians(np.clip(polar, 3, widest_deg))
        across = np.sin(polar)
        lights = np.stack((across * np.cos(azimuth), across * np.sin(azimuth), np.cos(polar)), 1)
        if not in_one_plane(lights):
            return lights


# Rendering


class Scene(NamedTuple):
    """What is seen of one scene: radiance (P, F) under lights (F, 3) from afar, or from near."""

    radiance: Floats
    mask: NDArray[np.bool_]  # (H, W)
    normals: Floats  # (P, 3)


def render(
    shape: str,
    material: str,
    size: int,
    lights: Floats,
    widths: float | None,
    rng: Random,
    files: tuple[Sequence[Path], Path | None] = ((), None),
) -> Scene:
    """Render a drawn shape in a drawn material. `widths` is the distance of the lamps, or None.

    `files` are the meshes of the shape `mesh`, and the networks of measured materials.
    """
    draw = SHAPES.get(shape, partial(draw_mesh_of_file, files[0]))
    while True:
        mesh = draw(rng) if shape == "cloth" else fit_to_frame(draw(rng))
        visible = find_visible_surface(tracer := Tracer(mesh), size, SAMPLES)
        if len(visible.normals) > LEAST_SHARE * size**2:  # not a thin body from its edge
            break
    patches = int(rng.integers(8, 200)) if material == "varying" else 1
    patch_of_face = draw_patches(mesh, patches, rng)
    look = make_material(material, patches, rng)
    direct: Any = {"one": look}
    if material == "measured":
        measured = read_materials(files[1])
        direct = {"one": Measured(measured, int(rng.integers(len(measured.names))), patches)}
    wrap, single = rng.uniform(0.3, 0.8), lights.astype(np.float32)
    generator = torch.Generator().manual_seed(int(rng.integers(2**40)))
    cosines, falloff = visible.normals @ lights.T, np.ones((1, len(lights)))
    with torch.inference_mode():
        if widths is None:
            radiance = render_direct(tracer, visible, single, direct, patch_of_face)["one"].numpy()
        else:
            places = visible.samples.position.reshape(len(cosines), -1, 3).mean(axis=1)
            middle = np.array((0, 0, places[:, 2].mean(dtype=np.float64)))
            width = np.ptp(np.flatnonzero(visible.mask.any(axis=0))) * 2 / size
            positions = lights * widths * width
            near = render_point_lights(tracer, visible, positions + middle, direct, patch_of_face)
            squared = np.sum(positions**2, axis=1)
            radiance = near["one"].numpy() / np.sum((positions + middle) ** 2, axis=1) * squared
            towards = positions + middle - places[:, None]  # equally strong lamps
            falloff = squared / np.sum(towards**2, axis=2)
            cosines = np.einsum("pfc,pc->pf", unit(towards), visible.normals)
        if material == "translucent":
            radiance = translucent(visible.mask, radiance, cosines, falloff, wrap)
        else:
            traced = {"directions": PATHS, "bounces": BOUNCES, "generator": generator}
            parts = {"one": look}, patch_of_face
            indirect = render_indirect(tracer, visible, single, *parts, **traced)["one"].numpy()
            typical = 1.0
            if material == "measured":  # scaled to the albedo of the material
                typical = float(np.median(radiance[radiance > 0]) / math.pi)
            radiance = radiance + indirect * typical
    return Scene(np.asarray(radiance, np.float64), visible.mask, visible.normals)
