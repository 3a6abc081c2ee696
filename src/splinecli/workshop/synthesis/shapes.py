"""Random shapes with folds, hollows and occlusions like those found in sculptures, and the relief
on their surface.

Shapes are built from signed distance fields. Unions of round blobs alone would be too convex, with
few cast shadows and interreflections. Relief is a tileable normal map that perturbs the visible
normals, because meshes are smooth from one pixel to the next. Stone, cloth and leather are not, and
networks trained without such detail smooth it away. Relief does not affect the shadows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from splinecli.capture.formats.images import read_image
from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.workshop.synthesis import meshes
from splinecli.workshop.synthesis.meshes import (
    LONGEST_EDGE,
    Floats,
    Mesh,
    fit_to_frame,
    read_mesh,
    split_long_edges,
)

SPACING = 0.0125
"""Distance between the samples of the fields. For comparison, 128 pixels over the frame are 0.0156
apart.
"""

# meshes with fewer faces are drawn again: cuts sometimes leave nothing or only small pieces
FEWEST_FACES = 5_000


def draw_shape(rng: np.random.Generator, place: float | None = None) -> tuple[str, Mesh]:
    """Draw a random shape, fitted into the camera's frame, and return the name of its kind and its
    mesh.

    40 % are carved (warped unions of solids with pieces cut out), 20 % rough (spheres with noise),
    15 % relief (folded slabs that fill the frame), and 25 % vessels (bowls and cups that show their
    inside to the camera). `place`, from 0 to 1, determines the kind, so that evenly spread values
    give a set the right share of each. Raises UsageError if the extra `render` is not installed.
    """
    place = rng.random() if place is None else place
    name = list(KINDS)[int(np.searchsorted(np.cumsum((0.4, 0.2, 0.15)), place, side="right"))]
    return name, draw_shape_of_kind(name, rng)


def draw_shape_of_kind(name: str, rng: np.random.Generator) -> Mesh:
    """Draw a random shape of one kind: `carved`, `rough`, `relief` or `vessel`. Raises like
    draw_shape.
    """
    while True:
        mesh = KINDS[name](rng)
        if mesh is not None and len(mesh.faces) > FEWEST_FACES:
            return mesh


def draw_rotation(rng: np.random.Generator) -> Floats:
    """Draw a rotation matrix (3, 3), uniform over all rotations (Shoemake 1992)."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = rng.normal(size=4)
    return np.asarray(Rotation.from_quat((x, y, z, w)).as_matrix(), dtype=np.float32)


def turn(mesh: Mesh, rotation: Floats) -> Mesh:
    """Return the mesh, rotated about the origin."""
    return Mesh(mesh.vertices @ rotation.T, mesh.faces, mesh.vertex_normals @ rotation.T)


def draw_view(mesh: Mesh, others: Sequence[Path], rng: np.random.Generator) -> Mesh:
    """Draw a random view of a mesh that fits the frame.

    The rotation is uniform. In half of the views another mesh, from one of the files `others` and
    scaled by U(0.4, 1), touches it, because gaps between bodies have long shadows and indirect
    light. Half of the views are magnified by U(1, 2.2) around a point on the surface, so that they
    show only a part.
    """
    mesh = turn(mesh, draw_rotation(rng))
    if others and rng.random() < 0.5:
        mesh = _touching(
            mesh, turn(read_mesh(others[int(rng.integers(len(others)))]), draw_rotation(rng)), rng
        )
    return split_long_edges(magnified(fit_to_frame(mesh), rng), longest=LONGEST_EDGE)


def magnified(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Return the mesh or, in half of the cases, a part of it.

    The part is magnified by U(1, 2.2) around a point on the surface.
    """
    if rng.random() >= 0.5:
        return mesh
    enlarged, middle = rng.uniform(1, 2.2), mesh.vertices[rng.integers(len(mesh.vertices)), :2]
    shift = np.append(middle * (1 - enlarged), 0)
    return Mesh(
        (mesh.vertices * enlarged + shift).astype(np.float32), mesh.faces, mesh.vertex_normals
    )


def _touching(mesh: Mesh, other: Mesh, rng: np.random.Generator) -> Mesh:
    """Return both meshes, the other one scaled down and moved in a random direction.

    They overlap by at most 40 %.
    """
    direction = rng.normal(size=3) * np.array((1, 1, 0.5))
    direction /= np.linalg.norm(direction)
    vertices = other.vertices * rng.uniform(0.4, 1.0)
    depth = np.ptp(vertices @ direction)
    apart = (
        (mesh.vertices @ direction).max()
        - (vertices @ direction).min()
        - rng.uniform(0, 0.4) * depth
    )
    return joined(mesh, other, vertices + apart * direction)


def joined(mesh: Mesh, other: Mesh, vertices: Floats) -> Mesh:
    """Return both meshes as one mesh with separate vertices."""
    return Mesh(
        np.concatenate((mesh.vertices, vertices)).astype(np.float32),
        np.concatenate((mesh.faces, other.faces + len(mesh.vertices))).astype(np.int32),
        np.concatenate((mesh.vertex_normals, other.vertex_normals)),
    )


def draw_solid(rng: np.random.Generator, size: float) -> meshes.Field:
    """Draw an ellipsoid, a rounded box, a torus or a rod around the origin, with a radius of about
    `size`.
    """
    kind = rng.integers(4)
    if kind == 0:
        return meshes.ellipsoid((size * rng.uniform(0.45, 1.3, 3)).astype(np.float32))
    if kind == 1:
        return meshes.box((size * rng.uniform(0.35, 1.0, 3)).astype(np.float32), 0.12 * size)
    if kind == 2:
        return meshes.torus(size * rng.uniform(0.8, 1.2), size * rng.uniform(0.2, 0.4))
    return meshes.capsule(size * rng.uniform(0.6, 1.6), size * rng.uniform(0.25, 0.5))


def place_solid(field: meshes.Field, rng: np.random.Generator, reach: Range) -> meshes.Field:
    """Rotate a solid at random and move it in a random direction, by a distance within `reach`."""
    direction = rng.normal(size=3)
    centre = direction / np.linalg.norm(direction) * rng.uniform(*reach)
    return meshes.moved(field, draw_rotation(rng), centre.astype(np.float32))


Range = tuple[float, float]


def draw_waves(
    rng: np.random.Generator,
    frequencies: Range,
    slopes: Range,
    *,
    outputs: int = 1,
    ridged: bool = False,
) -> meshes.Field:
    """Draw smooth or ridged noise with a frequency in cycles per unit length and a given mean
    slope.
    """
    frequency = rng.uniform(*frequencies)
    height = np.float32(rng.uniform(*slopes) / ((4 if ridged else 2) * np.pi * frequency))
    noise = meshes.ridges(rng, frequency) if ridged else meshes.waves(rng, frequency, outputs)
    return lambda points: height * noise(points)


draw_folds = partial(draw_waves, ridged=True)


def draw_carved(rng: np.random.Generator) -> Mesh | None:
    """Draw a union of three to seven warped solids with three to eight pieces cut out, often with
    folds.
    """
    solids = [
        place_solid(draw_solid(rng, rng.uniform(0.25, 0.5)), rng, (0.0, 0.5))
        for _ in range(rng.integers(3, 8))
    ]
    tools = [
        place_solid(draw_solid(rng, rng.uniform(0.12, 0.35)), rng, (0.15, 0.7))
        for _ in range(rng.integers(3, 9))
    ]
    blend, seam = rng.uniform(0.05, 0.25), rng.uniform(0.02, 0.08)
    bend = draw_waves(rng, (0.4, 0.9), (0.1, 0.5), outputs=3)
    folds = draw_folds(rng, (0.9, 2.2), (0.2, 0.8)) if rng.random() < 0.55 else None

    def distance(points: Floats) -> Floats:
        bent = points + bend(points)
        shape = solids[0](bent)
        for solid in solids[1:]:
            shape = meshes.smooth_union(shape, solid(bent), blend)
        for tool in tools:
            shape = meshes.smooth_cut(shape, tool(bent), seam)
        return shape - folds(bent) if folds else shape

    mesh = meshes.triangulate(distance, (1.25, 1.25, 1.25), SPACING)
    return None if mesh is None else fit_to_frame(turn(mesh, draw_rotation(rng)))


def draw_rough(rng: np.random.Generator) -> Mesh | None:
    """Draw a sphere with smooth or ridged noise, often with craters."""
    swell = draw_waves(rng, (0.5, 1.2), (0.3, 0.9))
    drawn = draw_folds if rng.random() < 0.6 else draw_waves
    detail = drawn(rng, (1.2, 2.4), (0.2, 0.7))
    bend = draw_waves(rng, (0.5, 1.2), (0.0, 0.4), outputs=3)
    craters = [
        place_solid(
            meshes.ellipsoid(
                (rng.uniform(0.12, 0.4) * rng.uniform(0.6, 1.2, 3)).astype(np.float32)
            ),
            rng,
            (0.5, 0.8),
        )
        for _ in range(rng.integers(0, 9))
    ]

    def distance(points: Floats) -> Floats:
        bent = points + bend(points)
        shape = np.linalg.norm(bent, axis=1) - np.float32(0.7) - swell(bent) - detail(bent)
        for crater in craters:
            shape = meshes.smooth_cut(shape, crater(bent), 0.05)
        # Noise makes the field steeper. Scale it to keep it close to a distance.
        return np.asarray(shape * np.float32(0.7))

    mesh = meshes.triangulate(distance, (1.3, 1.3, 1.3), SPACING)
    return None if mesh is None else fit_to_frame(turn(mesh, draw_rotation(rng)))


def draw_relief(rng: np.random.Generator) -> Mesh | None:
    """Draw a slab that fills the frame, folded into ridges, valleys and overhangs."""
    swell, folds = draw_waves(rng, (0.4, 0.9), (0.2, 0.6)), draw_folds(rng, (0.45, 1.2), (0.4, 1.3))
    bend = draw_waves(rng, (0.5, 1.2), (0.0, 0.5), outputs=3)
    pits = [
        place_solid(draw_solid(rng, rng.uniform(0.1, 0.35)), rng, (0.1, 1.0))
        for _ in range(rng.integers(0, 6))
    ]
    slab = meshes.box(np.array((1.06, 1.06, 0.8), dtype=np.float32), 0.01)

    def distance(points: Floats) -> Floats:
        bent = points + bend(points)
        # The noise varies more slowly across the slab, so that overhangs are rare.
        flat = bent * np.array((1, 1, 0.3), dtype=np.float32)
        shape: Floats = (bent[:, 2] - swell(flat) - folds(flat)) * np.float32(0.7)
        for pit in pits:
            shape = meshes.smooth_cut(shape, pit(bent), 0.05)
        return np.maximum(shape, slab(points))

    return meshes.triangulate(distance, (1.09, 1.09, 0.85), SPACING)


def draw_vessel(rng: np.random.Generator, most_tilt_deg: float = 55) -> Mesh | None:
    """Draw a bowl, cup or vase, round or fluted, and tilt it. Up to half get further solids."""
    from scipy.spatial.transform import Rotation

    half_height = rng.uniform(0.3, 0.75)
    wall = np.float32(rng.uniform(0.05, 0.12))
    profile = _draw_profile(rng)
    flutes, twist = int(rng.integers(3, 13)), rng.uniform(-2, 2)
    depth = rng.uniform(0.1, 0.5) / flutes if rng.random() < 0.5 else 0.0
    folds = draw_folds(rng, (0.8, 2.0), (0.1, 0.4)) if rng.random() < 0.5 else None
    extras = [
        place_solid(draw_solid(rng, rng.uniform(0.1, 0.25)), rng, (0.2, 0.6))
        for _ in range(rng.integers(0, 4))
    ]
    if rng.random() < 0.5:
        extras = []
    floor = np.float32(-half_height + 2 * wall)

    def distance(points: Floats) -> Floats:
        height = points[:, 2] / np.float32(half_height)
        azimuth = np.arctan2(points[:, 1], points[:, 0]) + np.float32(twist) * points[:, 2]
        radius = profile(height) * (1 + np.float32(depth) * np.cos(flutes * azimuth))
        side = (np.hypot(points[:, 0], points[:, 1]) - radius) * np.float32(0.75)
        outer = meshes.smooth_cut(side, half_height - np.abs(points[:, 2]), 0.08)
        # The inside is the outside, moved inwards by the wall, and open at the top.
        inner = meshes.smooth_cut(side + wall, points[:, 2] - floor, 0.25)
        shape = meshes.smooth_cut(outer, inner, 0.03)
        for extra in extras:
            shape = meshes.smooth_union(shape, extra(points), 0.04)
        return shape - folds(points) if folds else shape

    mesh = meshes.triangulate(distance, (1.15, 1.15, half_height + 0.2), SPACING)
    if mesh is None:
        return None
    tilt, azimuth = np.radians(most_tilt_deg) * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    towards_azimuth = tilt * np.array((-np.sin(azimuth), np.cos(azimuth), 0))
    return fit_to_frame(
        turn(mesh, Rotation.from_rotvec(towards_azimuth).as_matrix().astype(np.float32))
    )


def _draw_profile(rng: np.random.Generator) -> Callable[[Floats], Floats]:
    """Draw the radius over the height from -1 to 1, a smooth curve through five radii; half widen
    towards the mouth.
    """
    from scipy.interpolate import PchipInterpolator

    radii = rng.uniform(0.35, 0.9, 5)
    if rng.random() < 0.5:
        radii = np.sort(radii)
    table = PchipInterpolator(np.linspace(-1, 1, 5), radii)(np.linspace(-1, 1, 256)).astype(
        np.float32
    )
    return lambda height: np.interp(height, np.linspace(-1, 1, 256), table).astype(np.float32)


KINDS: dict[str, Callable[[np.random.Generator], Mesh | None]] = {
    "carved": draw_carved,
    "rough": draw_rough,
    "relief": draw_relief,
    "vessel": draw_vessel,
}


_LEAST_Z = 0.1  # lowest z to which a relief tilts a normal with a higher z
_STEEPEST = 4.0  # largest slope read from a normal map


def read_relief(path: Path) -> Floats:
    """Return the slopes (h, w, 2) of a relief along its columns and rows, from a tileable normal
    map.

    The map is RGB = (n + 1) / 2. The direction of green, up or down, is inferred from the slopes,
    because the slopes of a surface have no curl. The vectors need not have unit length. Raises
    InputError if the file is not a colour image.
    """
    normals = 2 * read_image(path) - 1
    if normals.shape[2] != 3:
        raise InputError("found a gray image, expected a normal map", path=path)
    slopes = -normals[..., :2] / np.maximum(normals[..., 2:], 1 / _STEEPEST)
    slopes = (slopes - slopes.mean(axis=(0, 1))).clip(-_STEEPEST, _STEEPEST)
    along_rows, along_columns = (
        np.gradient(slopes[..., 0], axis=0),
        np.gradient(slopes[..., 1], axis=1),
    )
    down = np.square(along_rows - along_columns).sum() < np.square(along_rows + along_columns).sum()
    return np.asarray(slopes if down else slopes * np.array((1, -1)), np.float32)


@dataclass(frozen=True)
class Relief:
    """A relief, projected along three axes: each point of a surface uses the axis nearest to its
    normal.
    """

    slopes: Floats  # (h, w, 2), slopes of the height along the columns and the rows
    axes: Floats  # (3, 3), orthonormal rows
    period: float  # width of one tile; the camera's square is 2 wide

    def bend(self, normals: Floats, positions: Floats) -> Floats:
        """Return the normals (N, 3) of points (N, 3) of a surface with this relief.

        The perturbation is reduced for normals that would otherwise face away from the camera.
        """
        local, places = normals @ self.axes.T, positions @ self.axes.T / np.float32(self.period)
        first = (np.abs(local).argmax(axis=1) + 1) % 3
        second, rows = (first + 1) % 3, np.arange(len(normals))
        height, width = self.slopes.shape[:2]
        columns, lines = (places[rows, axis] % 1 for axis in (first, second))
        slopes = self.slopes[
            np.minimum((lines * height).astype(int), height - 1),
            np.minimum((columns * width).astype(int), width - 1),
        ]
        rise = slopes[:, :1] * self.axes[first] + slopes[:, 1:] * self.axes[second]
        rise -= (rise * normals).sum(axis=1, keepdims=True) * normals
        turned = unit(normals - rise)
        lowest = np.minimum(normals[:, 2:], _LEAST_Z)
        fall = np.maximum(normals[:, 2:] - turned[:, 2:], 1e-6)
        return unit(normals + np.minimum(1, (normals[:, 2:] - lowest) / fall) * (turned - normals))


def draw_detail(slopes: Floats, size: int, rng: np.random.Generator) -> Relief:
    """Draw a relief from the slopes of a normal map, for images of `size` pixels a side.

    A tile is 10^U(-0.6, 0.4) wide, in units of half the frame. The root mean square of the slopes,
    at a resolution of a third of a pixel, is U(0.05, 0.6). The axes are uniform over all rotations.
    """
    period = float(10 ** rng.uniform(-0.6, 0.4))
    side = max(8, round(1.5 * size * period))
    if side < min(slopes.shape[:2]):
        slopes = np.asarray(cv2.resize(slopes, (side, side), interpolation=cv2.INTER_AREA))
    steepness = rng.uniform(0.05, 0.6) / max(
        float(np.sqrt(np.square(slopes).sum(axis=2).mean())), 1e-3
    )
    return Relief(slopes * np.float32(steepness), draw_rotation(rng), period)
