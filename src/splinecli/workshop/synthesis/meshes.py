"""Triangle meshes in the camera frame: x right, y up, z to the camera, whose view is the square
[-1, 1]^2.

They are read from files, or extracted from approximate signed distance fields. A field is a
function of points (N, 3), negative inside the shape, that grows at about unit rate across the
surface. Smooth union: Quilez, "Smooth minimum" (https://iquilezles.org/articles/smin). Surface:
marching cubes (Lewiner et al. 2003); the vertices are then moved onto the zero level set, and the
gradient of the field gives their normals.
"""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.system.files import check_file
from splinecli.system.machine import import_extra, is_out_of_memory

Floats = NDArray[np.floating]
REACH = 0.94  # half-width of the object in the camera's square
LEAST_EXTENT = 1e-3  # smallest extent of a mesh in x and y, relative to its largest side
LONGEST_EDGE = 0.03  # longest edge of a face; faces with longer edges are split
MOST_FACES = 2_000_000
_LONGEST = {"ply": 32_000_000, "obj": 32_000_000, "off": 32_000_000, "stl": 84 + 50 * MOST_FACES}
"""Largest file size by format, in bytes. In the first three, one byte may give a triangle of 110
bytes in memory.
"""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Floats  # (V, 3) float32
    # (T, 3) int32, indices of vertices, anticlockwise as seen from outside
    faces: NDArray[np.int32]
    vertex_normals: Floats  # (V, 3) float32, unit, outward; shading interpolates them


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh file (PLY, OBJ, STL or OFF) and fit it into the frame.

    The +z axis of the file points to the camera. The normal of a vertex is the mean of the faces
    around it, weighted by angle. Long edges are split, so that every part of the surface has
    vertices and can have its own material. Raises InputError if the file is missing, too large, not
    a mesh, or has no faces.
    """
    import trimesh

    check_file(path := Path(path), "a mesh")
    try:
        kind, content = _read_known(path)
        # Parse the content only, so that files it refers to are not read.
        with np.errstate(all="ignore"):  # it checks the normals of an STL file
            loaded = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
        if (count := len(loaded.faces)) > MOST_FACES:
            raise InputError(f"found {count} triangles, expected at most {MOST_FACES}", path=path)
        corners = np.asarray(loaded.vertices, np.float64)[loaded.faces]
        if count:
            with np.errstate(all="ignore"):
                size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
            if (
                not 0 < size < np.inf
            ):  # also catches NaN; process() would remove triangles with such corners
                raise InputError(
                    "the corners are not finite numbers, or all in one place", path=path
                )
            loaded.vertices = loaded.vertices / size  # trimesh merges corners closer than 1e-8
        loaded.process()
        # Texture coordinates split vertices, and would split the smooth normals too.
        loaded.merge_vertices(merge_tex=True, merge_norm=True)
        if len(loaded.faces) and loaded.is_watertight and loaded.volume < 0:
            loaded.invert()  # the mesh is inside out, so nothing would face the camera
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
        normals = np.asarray(loaded.vertex_normals) if len(faces) else np.zeros((0, 3))
    except InputError:
        raise
    except Exception as error:  # the readers raise many types
        if is_out_of_memory(error):
            raise
        raise InputError(
            f"not a mesh that can be read ({type(error).__name__}:"
            f" {str(error).strip() or 'no reason given'})",
            path=path,
            hint="Give a triangle mesh as PLY, OBJ, STL or OFF",
        ) from error
    if not len(faces):
        raise InputError("the mesh has no faces", path=path, hint="Point clouds cannot be rendered")
    if not np.isfinite(vertices).all() or np.ptp(vertices[:, :2], axis=0).max() < LEAST_EXTENT:
        raise InputError("the mesh has no extent that a camera along -z could see", path=path)
    vertices = vertices - vertices[:1]  # in float32, places far from the origin are coarse
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))
    return split_long_edges(fit_to_frame(mesh), longest=LONGEST_EDGE)


def _read_known(path: Path) -> tuple[str, bytes]:
    """Return the format of a mesh file, detected from its content, and that content."""
    with path.open("rb") as file:
        content = file.read(max(_LONGEST.values()) + 1)
    triangles = int.from_bytes(content[80:84], "little")
    if content.startswith((b"ply", b"OFF")):
        kind = content[:3].decode().lower()
    elif content.startswith(b"solid") or len(content) == 84 + 50 * triangles:
        kind = "stl"
    elif b"\0" not in content and re.search(rb"^[ \t]*v\s", content, re.MULTILINE):
        kind = "obj"
    else:
        raise ValueError("it is in none of these formats")
    if len(content) > (most := _LONGEST[kind]):
        raise InputError(
            f"found a longer file than {most / 1e6:.0f} MB", path=path, hint="Decimate the mesh"
        )
    return kind, content


def fit_to_frame(mesh: Mesh) -> Mesh:
    """Return a mesh that is scaled and centred at the origin.

    Its larger extent in x and y is 2 * REACH.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scale = 2 * REACH / float((high - low)[:2].max())
    vertices = (mesh.vertices - (low + high) / 2) * np.float32(scale)
    return Mesh(vertices.astype(np.float32), mesh.faces, mesh.vertex_normals)


def split_long_edges(mesh: Mesh, *, longest: float, most_faces: int = MOST_FACES) -> Mesh:
    """Return a mesh whose faces are divided into four until no edge is longer than `longest`.

    Division ends earlier if there would be more than `most_faces` faces.
    """
    # Interpolate positions and normals together, so that the shading stays the same.
    corners = np.concatenate((mesh.vertices, mesh.vertex_normals), axis=1).astype(np.float64)
    faces = mesh.faces.astype(np.int64)
    while True:
        ends = corners[faces, :3]
        length = np.linalg.norm(ends - np.roll(ends, -1, axis=1), axis=2).max(axis=1)
        long = length > longest
        if not long.any() or len(faces) + 3 * long.sum() > most_faces:
            break
        split = faces[long]
        edges = np.stack((split, np.roll(split, -1, axis=1)), axis=2).reshape(-1, 2)
        unique, middle = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        a, b, c = split.T
        ab, bc, ca = (middle.reshape(-1, 3) + len(corners)).T
        corners = np.concatenate((corners, corners[unique].mean(axis=1)))
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.concatenate((faces[~long], *(np.stack(quarter, axis=1) for quarter in quarters)))
    normals = unit(corners[:, 3:]).astype(np.float32)
    return Mesh(corners[:, :3].astype(np.float32), faces.astype(np.int32), normals)


Field = Callable[[Floats], Floats]


def ellipsoid(half_axes: Floats) -> Field:
    """Return an ellipsoid around the origin. The distance is exact on the surface, and everywhere
    for a sphere.
    """

    def distance(points: Floats) -> Floats:
        scaled = np.linalg.norm(points / half_axes, axis=1)
        slope = np.linalg.norm(points / half_axes**2, axis=1)
        return np.asarray(scaled * (scaled - 1) / np.maximum(slope, 1e-6))

    return distance


def box(half_widths: Floats, rounding: float) -> Field:
    """Return a box around the origin with rounded edges."""

    def distance(points: Floats) -> Floats:
        beyond = np.abs(points) - (half_widths - np.float32(rounding))
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0) - np.float32(rounding))

    return distance


def torus(radius: float, tube: float) -> Field:
    """Return a ring around the z axis."""

    def distance(points: Floats) -> Floats:
        ring = np.hypot(points[:, 0], points[:, 1]) - np.float32(radius)
        return np.hypot(ring, points[:, 2]) - np.float32(tube)

    return distance


def capsule(half_length: float, radius: float) -> Field:
    """Return a rod along z with round ends."""

    def distance(points: Floats) -> Floats:
        along = points[:, 2] - np.clip(
            points[:, 2], -np.float32(half_length), np.float32(half_length)
        )
        return np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2 + along**2) - np.float32(radius)

    return distance


def polyhedron(normals: Floats, distances: Floats) -> Field:
    """Return the convex body below planes with unit normals (N, 3), at distances (N,) from the
    origin.
    """
    return lambda points: np.asarray((points @ normals.T - distances).max(axis=1))


def moved(field: Field, rotation: Floats, centre: Floats) -> Field:
    """Return the shape, rotated by a matrix and then moved to a centre."""
    return lambda points: field((points - centre) @ rotation)


def smooth_union(first: Floats, second: Floats, blend: float) -> Floats:
    """Return the distance to the union of two shapes, with a fillet of width `blend` along the
    seam.
    """
    overlap = np.maximum(blend - np.abs(first - second), 0) / blend
    return np.minimum(first, second) - overlap * overlap * np.float32(blend / 4)


def smooth_cut(shape: Floats, tool: Floats, blend: float) -> Floats:
    """Return the distance to a shape after another shape was subtracted."""
    return -smooth_union(-shape, tool, blend)


def waves(rng: np.random.Generator, frequency: float, outputs: int = 1) -> Field:
    """Draw a smooth random function (N, outputs) of about unit variance: plane waves of random
    directions.

    The wave numbers are U(0.6, 1.4) * frequency, in cycles per unit length. A single output has
    shape (N,).
    """
    count = 10
    directions = rng.normal(size=(3, count))
    directions *= (
        2 * np.pi * frequency * rng.uniform(0.6, 1.4, count) / np.linalg.norm(directions, axis=0)
    )
    phases = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    mixing = rng.normal(size=(count, outputs)) * np.sqrt(2 / count)
    matrix, mixing = directions.astype(np.float32), mixing.astype(np.float32)

    def value(points: Floats) -> Floats:
        mixed = np.sin(points @ matrix + phases) @ mixing
        return np.asarray(mixed[:, 0] if outputs == 1 else mixed)

    return value


def ridges(rng: np.random.Generator, frequency: float) -> Field:
    """Draw sharp crests between round valleys (N,), about -1 to 1: 1 - 2 |waves| in two octaves,
    one half as high.
    """
    low, high = waves(rng, frequency), waves(rng, 2 * frequency)

    def value(points: Floats) -> Floats:
        total = (1 - 2 * np.abs(low(points))) + 0.5 * (1 - 2 * np.abs(high(points)))
        return np.asarray(total / 1.5, dtype=np.float32)

    return value


def gradient(field: Field, points: Floats, step: float = 1e-3) -> Floats:
    """Return the gradient (N, 3) by central differences."""
    axes = np.eye(3, dtype=np.float32) * np.float32(step)
    return np.stack(
        [(field(points + a) - field(points - a)) / np.float32(2 * step) for a in axes], axis=1
    )


def triangulate(
    field: Field, half_widths: tuple[float, float, float], spacing: float
) -> Mesh | None:
    """Return the surface of a field in a box around the origin, sampled at intervals of `spacing`.

    Only the largest connected part is kept. None if the surface is empty.
    """
    from trimesh.graph import connected_component_labels

    counts = [int(np.ceil(2 * half / spacing / COARSE)) * COARSE + 1 for half in half_widths]
    axes = [((np.arange(count) - (count - 1) / 2) * spacing).astype(np.float32) for count in counts]
    values = _sample(field, axes, spacing)
    if not values.min() < 0 < values.max():
        return None
    measure = import_extra("skimage.measure", "render")
    # The corners of a face run anticlockwise as seen from the side with values above 0, which is
    # outside.
    found, faces, _, _ = measure.marching_cubes(values, 0.0, spacing=(spacing,) * 3)
    vertices = (found + [axis[0] for axis in axes]).astype(np.float32)
    part = connected_component_labels(
        faces[:, [0, 1, 1, 2]].reshape(-1, 2), node_count=len(vertices)
    )
    kept = part == np.bincount(part).argmax()
    vertices, faces = (
        vertices[kept],
        (np.cumsum(kept) - 1)[faces[kept[faces[:, 0]]]].astype(np.int32),
    )
    # Take one Newton step, because linear interpolation between samples leaves terraces.
    slope = gradient(field, vertices)
    squared = np.maximum((slope * slope).sum(axis=1), 1e-2)
    move = np.clip(field(vertices) / squared, -0.4 * spacing, 0.4 * spacing)
    vertices = vertices - move[:, None] * slope
    normals = unit(gradient(field, vertices))
    return Mesh(vertices, np.ascontiguousarray(faces, dtype=np.int32), normals)


# Samples along the edge of a coarse cell. Cells far from the surface are not sampled at full
# resolution.
COARSE = 4


def _sample(field: Field, axes: list[Floats], spacing: float) -> Floats:
    """Return samples of the field on the grid of three axes.

    They are exact near the surface of the field, and have the correct sign elsewhere.
    """
    coarse = _evaluate(field, *np.meshgrid(*(axis[::COARSE] for axis in axes), indexing="ij"))
    # Fields grow at rates up to about 2. The centre of a cell is half its diagonal away from its
    # corners.
    reach = 2 * COARSE * spacing * np.sqrt(3) / 2
    near = np.abs(coarse) < reach
    close = np.zeros([size - 1 for size in coarse.shape], dtype=bool)
    for x, y, z in np.ndindex(2, 2, 2):
        close |= near[x : x + close.shape[0], y : y + close.shape[1], z : z + close.shape[2]]
    far = coarse
    for axis in range(3):
        close, far = np.repeat(close, COARSE, axis), np.repeat(far, COARSE, axis)
    shape = tuple(len(axis) for axis in axes)
    values = np.ascontiguousarray(far[: shape[0], : shape[1], : shape[2]])
    exact = np.zeros(shape, dtype=bool)
    # The upper faces are part of the cell, too.
    for x, y, z in np.ndindex(2, 2, 2):
        exact[x : x + close.shape[0], y : y + close.shape[1], z : z + close.shape[2]] |= close
    at = exact.nonzero()
    values[at] = _evaluate(field, *(axis[index] for axis, index in zip(axes, at, strict=True)))
    return values


def _evaluate(field: Field, x: Floats, y: Floats, z: Floats) -> Floats:
    points = np.stack((x.ravel(), y.ravel(), z.ravel()), axis=1)
    # Evaluate in pieces that fit into the processor's cache.
    pieces = [
        field(points[start : start + 32_768]) for start in range(0, max(len(points), 1), 32_768)
    ]
    return np.concatenate(pieces).reshape(x.shape).astype(np.float32)
