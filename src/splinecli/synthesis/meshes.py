"""Triangle meshes in the frame of the camera: x right, y up, z to the camera. It sees the square [-1, 1]^2."""

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.system.files import check_file
from splinecli.system.machine import is_out_of_memory

Floats = NDArray[np.floating]
REACH = 0.94  # half-width of the object in the camera's square
LONGEST_EDGE = 0.03  # of a face; longer ones are split
MOST_FACES = 2_000_000
_LONGEST = {"ply": 32_000_000, "obj": 32_000_000, "off": 32_000_000, "stl": 84 + 50 * MOST_FACES}
"""Bytes of a file of each format. A byte of the first three may give a triangle, of 110 bytes in memory."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Floats  # (V, 3) float32
    faces: NDArray[np.int32]  # (T, 3) int32, rows of vertices, anticlockwise as seen from outside
    vertex_normals: Floats  # (V, 3) float32, unit, outward; shading interpolates them


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh file (PLY, OBJ, STL or OFF) and fit it into the frame.

    The +z axis of the file points to the camera. The normal of a vertex is the mean of the faces around it, weighted by
    angle. Long edges are split, so that every part of the surface has vertices and can have its own material. Raises
    InputError if the file is missing, too long, not a mesh, or has no faces.
    """
    import trimesh

    check_file(path := Path(path), "a mesh")
    try:
        kind, content = _read_known(path)
        # From its content, so that no file that it names is read.
        with np.errstate(all="ignore"):  # it checks the normals of an STL file
            loaded = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
        if (count := len(loaded.faces)) > MOST_FACES:
            raise InputError(f"found {count} triangles, expected at most {MOST_FACES}", path=path)
        corners = np.asarray(loaded.vertices, np.float64)[loaded.faces]
        if count:
            with np.errstate(all="ignore"):
                size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
            if not 0 < size < np.inf:  # NaN, too. process() would remove triangles with such corners
                raise InputError("the corners are not finite numbers, or all in one place", path=path)
            loaded.vertices = loaded.vertices / size  # trimesh merges corners that are nearer than 1e-8
        loaded.process()
        # Texture coordinates split vertices, and would split the smooth normals too.
        loaded.merge_vertices(merge_tex=True, merge_norm=True)
        if len(loaded.faces) and loaded.is_watertight and loaded.volume < 0:
            loaded.invert()  # the mesh is inside out, so the camera would see nothing
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
        normals = np.asarray(loaded.vertex_normals) if len(faces) else np.zeros((0, 3))
    except InputError:
        raise
    except Exception as error:  # the readers raise many kinds
        if is_out_of_memory(error):
            raise
        raise InputError(
            f"not a mesh that can be read ({type(error).__name__}: {str(error).strip() or 'no reason given'})",
            path=path,
            hint="Give a triangle mesh as PLY, OBJ, STL or OFF",
        ) from error
    if not len(faces):
        raise InputError("the mesh has no faces", path=path, hint="Point clouds cannot be rendered")
    if not np.isfinite(vertices).all() or np.ptp(vertices[:, :2], axis=0).max() == 0:
        raise InputError("the mesh has no extent that a camera along -z could see", path=path)
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32))
    return split_long_edges(fit_to_frame(mesh), longest=LONGEST_EDGE)


def _read_known(path: Path) -> tuple[str, bytes]:
    """Return the format of a mesh file, by its content, and its content.

    Raises InputError if it is of another format or too long, or OSError if it cannot be read.
    """
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
        raise ValueError("it has none of these formats")
    if len(content) > (most := _LONGEST[kind]):
        raise InputError(f"found a longer file than {most / 1e6:.0f} MB", path=path, hint="Decimate the mesh")
    return kind, content


def fit_to_frame(mesh: Mesh) -> Mesh:
    """Scale and centre a mesh: its larger extent in x and y becomes 2 * REACH, and its centre the origin."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scale = 2 * REACH / float((high - low)[:2].max())
    vertices = (mesh.vertices - (low + high) / 2) * np.float32(scale)
    return Mesh(vertices.astype(np.float32), mesh.faces, mesh.vertex_normals)


def split_long_edges(mesh: Mesh, *, longest: float, most_faces: int = MOST_FACES) -> Mesh:
    """Divide faces into four until no edge is longer than `longest` or there would be more than `most_faces` faces."""
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
