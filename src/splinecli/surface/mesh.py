"""Triangle meshes of height and depth maps, and their files.

Frame: x right, y up, z to the camera (docs/files-and-frames.md). For an orthographic camera, coordinates are in
pixels and the origin is the centre of the image. For a pinhole camera, they are in the unit of the depth and the
origin is the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.files import write_bytes
from splinecli.surface.camera import focal_length, pixel_rays


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh.

    Args:
        vertices: (V, 3) float32.
        triangles: (T, 3) int32, the numbers of three vertices each, counter-clockwise as the camera sees them.
        colours: (V, 3) uint8, RGB of the vertices, or None.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colours: NDArray[np.uint8] | None = None


def surface_mesh(
    depth: NDArray[np.floating],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None = None,
    colours: NDArray[np.uint8] | None = None,
    *,
    largest_step: float | None = None,
) -> SurfaceMesh:
    """Return the mesh of a height or depth map, with a vertex for each pixel of the mask, row by row.

    Four pixels of the mask in a square make two triangles, split along the diagonal whose ends differ less in height.
    Three make one triangle.

    Args:
        depth: (H, W), finite in the mask (H, W): heights, or positive depths with a camera matrix, as
            integrate_normals returns them.
        mask: (H, W), True on the object.
        camera_matrix: (3, 3), the one that integrate_normals had, or None.
        colours: (H, W, 3) uint8 RGB, or None.
        largest_step: leaves out triangles whose corners differ by more than this in height, in pixels (for a pinhole
            camera, in pixels at the depth of the triangle). They are the walls where the surface is torn. None keeps
            all triangles.

    Raises:
        UsageError: the shapes or types of the arrays do not fit, or an option is out of range.
        InputError: a depth in the mask is not finite or not positive, or the camera matrix is not valid.
    """
    _check(depth, mask, colours, largest_step)
    values = depth[mask].astype(np.float64)
    if camera_matrix is None:
        rows, columns = np.nonzero(mask)
        heights = values
        last_row, last_column = mask.shape[0] - 1, mask.shape[1] - 1
        vertices = np.stack((columns - last_column / 2, last_row / 2 - rows, values), axis=1)
    else:
        vertices = values[:, None] * pixel_rays(mask, camera_matrix)
        if not (values > 0).all():
            raise InputError(
                "a depth in the mask is not positive",
                hint="With a camera matrix, give depths along the viewing axis instead of heights",
            )
        heights = -focal_length(camera_matrix) * np.log(values)
    triangles = _triangles(heights, mask)
    if largest_step is not None:
        triangles = triangles[np.ptp(heights[triangles], axis=1) <= largest_step]
    return SurfaceMesh(
        vertices.astype(np.float32),
        triangles,
        None if colours is None else np.ascontiguousarray(colours[mask]),
    )


def write_mesh(mesh: SurfaceMesh, path: str | Path) -> None:
    """Write a mesh as binary .ply, or as .obj with the colours (0 to 1) after the coordinates of each vertex.

    Raises:
        UsageError: the name ends in neither .ply nor .obj.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    encoders = {".ply": _ply, ".obj": _obj}
    if path.suffix.lower() not in encoders:
        raise UsageError(f"{path}: unknown mesh format", hint="Give it a name that ends in .ply or .obj")
    write_bytes(path, encoders[path.suffix.lower()](mesh))


def _triangles(heights: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    number = np.full(mask.shape, -1, np.int32)
    number[mask] = np.arange(len(heights))
    # The corners of each square, counter-clockwise from the top left (y is up).
    squares = np.stack((number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]), axis=-1).reshape(
        -1, 4
    )
    inside = squares >= 0
    whole = squares[inside.all(axis=1)]
    step = np.abs(heights[whole[:, :2]] - heights[whole[:, 2:]])
    across = step[:, 0] <= step[:, 1]
    parts = [
        whole[across][:, [0, 1, 2]],
        whole[across][:, [0, 2, 3]],
        whole[~across][:, [0, 1, 3]],
        whole[~across][:, [1, 2, 3]],
    ]
    three = inside.sum(axis=1) == 3
    parts.append(squares[three][inside[three]].reshape(-1, 3))
    return np.concatenate(parts)


def _ply(mesh: SurfaceMesh) -> bytes:
    fields: list[tuple[str, str, tuple[int, ...]]] = [("position", "<f4", (3,))]
    properties = [f"property float {axis}" for axis in "xyz"]
    if mesh.colours is not None:
        fields.append(("colour", "u1", (3,)))
        properties += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    vertices = np.empty(len(mesh.vertices), fields)
    vertices["position"] = mesh.vertices
    if mesh.colours is not None:
        vertices["colour"] = mesh.colours
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("vertices", "<i4", (3,))])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def _obj(mesh: SurfaceMesh) -> bytes:
    vertices, line = mesh.vertices.astype(np.float64), "v %.7g %.7g %.7g"
    if mesh.colours is not None:
        vertices, line = np.concatenate((vertices, mesh.colours / 255), axis=1), line + " %.4g %.4g %.4g"
    return (_lines(line, vertices) + _lines("f %d %d %d", mesh.triangles + 1)).encode()


def _lines(line: str, rows: NDArray[np.generic]) -> str:
    # A single format operation is several times as fast as one for each line.
    return f"{line}\n" * len(rows) % tuple(rows.ravel().tolist())


def _check(
    depth: NDArray[np.floating],
    mask: NDArray[np.bool_],
    colours: NDArray[np.uint8] | None,
    largest_step: float | None,
) -> None:
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(f"the mask is {mask.dtype} {mask.shape}, expected bool (H, W)")
    if depth.shape != mask.shape:
        raise UsageError(f"the depth has shape {depth.shape}, expected {mask.shape} for this mask")
    if colours is not None and (colours.shape != (*mask.shape, 3) or colours.dtype != np.uint8):
        raise UsageError(
            f"the colours are {colours.dtype} {colours.shape}, expected uint8 {(*mask.shape, 3)}"
        )
    if largest_step is not None and not largest_step >= 0:
        raise UsageError(f"the largest step is {largest_step:g}, expected a number of at least 0")
    if not mask.any():
        raise InputError("the mask is empty", hint="Mark the pixels of the object in it")
    if not np.isfinite(depth[mask]).all():
        raise InputError("a depth in the mask is not finite", hint="Give the mask that integrate_normals had")
