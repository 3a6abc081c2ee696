"""Triangle meshes of height and depth maps.

Frame: x right, y up, z to the camera (docs/files-and-frames.md). For an orthographic camera, coordinates are in
pixels and the origin is the centre of the image. For a pinhole camera, they are in the unit of the depth and the
origin is the camera.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths.arrays import Bools, Doubles, Floats, Integers, Singles
from splinecli.maths.normals import unit
from splinecli.surface.camera import focal_length, image_points, pixel_rays


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh with the textures of its image."""

    vertices: Singles  # (V, 3) float32
    # (T, 3) int32, the numbers of three vertices each, counter-clockwise as the camera sees them
    triangles: NDArray[np.int32]
    normals: Singles  # (V, 3) float32, unit
    # (V, 2) float32, the places of the vertices in the textures: u from 0 at the left to 1 at the right, v from 0 at
    # the top to 1 at the bottom, as in glTF
    uvs: Singles
    texture: NDArray[np.uint8] | None = None  # (H, W, 3) uint8, sRGB colours, or None
    # (H, W, 3) uint8, normals in the frame of tangent, bitangent and normal, green up; or None where `normals` are
    # exact. See decimation.py.
    normal_texture: NDArray[np.uint8] | None = None
    tangents: Singles | None = None  # (V, 3) float32, unit, where there is a normal texture

    @property
    def colours(self) -> NDArray[np.uint8] | None:
        """The colours of the vertices in the texture, (V, 3) uint8."""
        if self.texture is None:
            return None
        height, width = self.texture.shape[:2]
        columns, rows = np.floor(self.uvs * (width, height)).astype(np.intp).T
        return np.asarray(self.texture[rows.clip(0, height - 1), columns.clip(0, width - 1)])


def surface_mesh(
    depth: Floats,
    mask: Bools,
    camera_matrix: Floats | None = None,
    colours: NDArray[np.uint8] | None = None,
    *,
    normal_map: Floats | None = None,
    largest_step: float | None = None,
) -> SurfaceMesh:
    """Return the mesh of a height or depth map, with a vertex for each pixel of the mask, row by row.

    Four pixels of the mask in a square make two triangles, split along the diagonal whose ends differ less in height.
    Three make one triangle. Raises UsageError if the largest step is negative.

    Args:
        depth: (H, W), finite in the mask (H, W): heights, or positive depths with a camera matrix, as
            integrate_normals returns them.
        mask: (H, W), True on the object.
        camera_matrix: (3, 3), the one that integrate_normals had, or None.
        colours: (H, W, 3) uint8 sRGB, or None.
        normal_map: (H, W, 3), unit in the mask: the normals of the vertices. None for those of the triangles.
        largest_step: leaves out triangles whose corners differ by more than this in height, in pixels (for a pinhole
            camera, in pixels at the depth of the triangle). They are the walls where the surface is torn. None keeps
            all triangles.
    """
    if largest_step is not None and not largest_step >= 0:
        raise UsageError(f"the largest step is {largest_step:g}, expected a number of at least 0")
    values = depth[mask].astype(np.float64)
    if camera_matrix is None:
        rows, columns = np.nonzero(mask)
        heights = values
        last_row, last_column = mask.shape[0] - 1, mask.shape[1] - 1
        vertices = np.stack((columns - last_column / 2, last_row / 2 - rows, values), axis=1)
    else:
        vertices = values[:, None] * pixel_rays(mask, camera_matrix)
        heights = -focal_length(camera_matrix) * np.log(values)
    triangles = _triangles(heights, mask)
    if largest_step is not None:
        triangles = triangles[np.ptp(heights[triangles], axis=1) <= largest_step]
    normals = vertex_normals(vertices, triangles) if normal_map is None else normal_map[mask]
    return SurfaceMesh(
        vertices.astype(np.float32),
        triangles,
        normals.astype(np.float32),
        texture_coordinates(image_points(vertices, mask.shape, camera_matrix), mask.shape),
        None if colours is None else fill_outside(colours, mask),
    )


def check_triangles(mask: Bools, path: Path) -> None:
    """Raise InputError about `path` if the mesh of a mask (H, W) has no triangle.

    No square of four pixels then has three of the mask.
    """
    count = mask.astype(np.uint8)
    squares = count[:-1, :-1] + count[1:, :-1] + count[:-1, 1:] + count[1:, 1:]
    if not (squares >= 3).any():
        raise no_triangles(path, instead="leave --surface out")


def no_triangles(path: Path | None = None, *, instead: str = "leave glb out of the formats") -> InputError:
    """Return the error of a mesh that has none."""
    return InputError(
        "the mesh has no triangles: nowhere do three pixels of the object form a corner",
        path=path,
        hint=f"Enlarge the mask, or {instead}",
    )


def vertex_normals(vertices: Floats, triangles: Integers) -> Doubles:
    """Return the unit normals (V, 3) of vertices: means over their triangles, weighted by area.

    A vertex without triangles has the normal (0, 0, 1).
    """
    first, second, third = np.moveaxis(vertices[triangles].astype(np.float64), 1, 0)
    faces = np.cross(second - first, third - first).repeat(3, axis=0)
    sums = [np.bincount(triangles.ravel(), faces[:, axis], len(vertices)) for axis in range(3)]
    normals: Doubles = unit(np.stack(sums, axis=1).astype(np.float64))
    normals[~normals.any(axis=1)] = (0, 0, 1)
    return normals


def texture_coordinates(points: Floats, shape: tuple[int, ...]) -> Singles:
    """Return the texture coordinates (V, 2) of image points (V, 2), column and row; see SurfaceMesh.uvs."""
    return ((points + 0.5) / (shape[1], shape[0])).astype(np.float32)


def fill_outside(texture: NDArray[np.uint8], known: Bools) -> NDArray[np.uint8]:
    """Return a texture (H, W, 3) in which every pixel that is not known (H, W) has the value of the nearest known one.

    Viewers interpolate between pixels and reduce textures, which would bring in the background at the border.
    """
    from scipy.ndimage import distance_transform_edt

    if known.all() or not known.any():
        return texture
    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(texture[rows, columns])


def _triangles(heights: Doubles, mask: Bools) -> NDArray[np.int32]:
    number = np.full(mask.shape, -1, np.int32)
    number[mask] = np.arange(len(heights))
    # The corners of each square, counter-clockwise from the top left (y is up).
    squares = np.stack((number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]), axis=-1).reshape(-1, 4)
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
