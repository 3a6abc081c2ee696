"""Triangle meshes of height and depth maps, optionally decimated with a texture of the normals.

Frame: x right, y up, z to the camera (docs/files-and-frames.md). For an orthographic camera,
coordinates are in pixels and the origin is the centre of the image. For a pinhole camera, they are
in the unit of the depth and the origin is the camera.

The texture of a decimated mesh contains the measured normals in the tangent frame of the coarser
mesh. A viewer interpolates the unit normal N and the tangent T of the vertices over a triangle and
scales both to unit length. The bitangent is B = N x T, which points up in the image. A texel (x, y,
z) represents the normal x T + y B + z N, and its colour is (x + 1) / 2 and so on (glTF 2.0, section
3.9.3).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths import Bools, Float32Array, Float64Array, Floats, Indices, Integers, Picture
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import (
    Blocks,
    focal_length,
    image_points,
    on_map,
    pixel_rays,
    ray_basis,
)
from splinecli.system.machine import import_extra


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh with textures."""

    vertices: Float32Array  # (V, 3) float32
    # (T, 3) int32, indices of three vertices each, counter-clockwise in the camera's view
    triangles: NDArray[np.int32]
    normals: Float32Array  # (V, 3) float32, unit
    # (V, 2) float32, texture coordinates of the vertices: u from 0 at the left to 1 at the right, v
    # from 0 at the top to 1 at the bottom, as in glTF
    uvs: Float32Array
    texture: Picture | None = None  # (H, W, 3) uint8, sRGB colours, or None
    # (H, W, 3) uint8, normals in the frame of tangent, bitangent and normal, green up; None if
    # `normals` are exact
    normal_texture: Picture | None = None
    # (H, W, 3) uint8, linear, roughness in green and metalness in blue, as in glTF; None for a
    # matte surface
    gloss: Picture | None = None
    # (H, W) float32, 0.5 for a reflectance of 4 % at normal incidence; None for 0.5 everywhere
    specular: Float32Array | None = None
    tangents: Float32Array | None = None  # (V, 3) float32, unit; only with a normal texture

    @property
    def colours(self) -> Picture | None:
        """The colours of the vertices from the texture, (V, 3) uint8."""
        if self.texture is None:
            return None
        height, width = self.texture.shape[:2]
        columns, rows = np.floor(self.uvs * (width, height)).astype(np.intp).T
        return np.asarray(self.texture[rows.clip(0, height - 1), columns.clip(0, width - 1)])


@dataclass(frozen=True)
class Textures:
    """Pictures for a mesh, each (H, W) or (H, W, 3); see the fields of SurfaceMesh."""

    texture: Picture | None = None
    gloss: Picture | None = None
    specular: Float32Array | None = None

    def put_on(self, mesh: SurfaceMesh, mask: Bools) -> SurfaceMesh:
        """Return a mesh with these textures, which are known inside the mask (H, W)."""
        given = {name: picture for name, picture in vars(self).items() if picture is not None}
        return replace(mesh, **{name: fill_outside(given[name], mask) for name in given})


def surface_mesh(
    depth: Floats,
    mask: Bools,
    camera_matrix: Floats | None = None,
    *,
    normal_map: Floats | None = None,
    largest_step: float | None = None,
) -> SurfaceMesh:
    """Return the mesh of a height or depth map, with a vertex for each pixel of the mask.

    Vertices are in the order of the pixels, row by row. Four pixels of the mask in a square form
    two triangles, split along the diagonal with the smaller difference in height. Three pixels form
    one triangle. Raises UsageError if the largest step is negative.

    Args:
        depth: (H, W), finite in the mask (H, W): heights, or positive depths with a camera matrix,
            as returned by integrate_normals.
        mask: (H, W), True on the object.
        camera_matrix: (3, 3), the same as for integrate_normals, or None.
        normal_map: (H, W, 3), unit in the mask: the normals of the vertices. None computes them
            from the triangles.
        largest_step: triangles whose corners differ in height by more than this are left out,
            because they are the walls where the surface is torn. In pixels; for a pinhole camera,
            in pixels at the depth of the triangle. None keeps all triangles.
    """
    if largest_step is not None and not largest_step >= 0:
        raise UsageError(f"the largest step is {largest_step:g}, expected a number of at least 0")
    heights = values = depth[mask].astype(np.float64)
    if camera_matrix is None:
        rows, columns = np.nonzero(mask)
        last_row, last_column = np.array(mask.shape) - 1
        vertices = np.stack((columns - last_column / 2, last_row / 2 - rows, values), axis=1)
    else:
        vertices = values[:, None] * pixel_rays(mask, camera_matrix)
        heights = -focal_length(camera_matrix) * np.log(values)
    triangles = _triangles(heights, mask)
    if largest_step is not None:
        triangles = triangles[np.ptp(heights[triangles], axis=1) <= largest_step]
    normals = vertex_normals(vertices, triangles) if normal_map is None else normal_map[mask]
    uvs = texture_coordinates(image_points(vertices, mask.shape, camera_matrix), mask.shape)
    return SurfaceMesh(vertices.astype(np.float32), triangles, normals.astype(np.float32), uvs)


def check_triangles(mask: Bools, path: Path) -> None:
    """Raise InputError for `path` if the mesh of a mask (H, W) has no triangles.

    A triangle needs three pixels of the mask in a square of four.
    """
    count = mask.astype(np.uint8)
    squares = count[:-1, :-1] + count[1:, :-1] + count[:-1, 1:] + count[1:, 1:]
    if not (squares >= 3).any():
        raise no_triangles(path, instead="omit --surface")


def no_triangles(
    path: Path | None = None, *, instead: str = "omit glb from the formats"
) -> InputError:
    """Return the error for a mesh without triangles."""
    return InputError(
        "the mesh has no triangles, because no three pixels of the object form a corner",
        path=path,
        hint=f"Enlarge the mask, or {instead}",
    )


def vertex_normals(vertices: Floats, triangles: Integers) -> Float64Array:
    """Return the unit normals (V, 3) of vertices, averaged over their triangles with weights by
    area.

    A vertex without triangles has the normal (0, 0, 1).
    """
    first, second, third = np.moveaxis(vertices[triangles].astype(np.float64), 1, 0)
    faces = np.cross(second - first, third - first).repeat(3, axis=0)
    sums = [np.bincount(triangles.ravel(), faces[:, axis], len(vertices)) for axis in range(3)]
    normals: Float64Array = unit(np.stack(sums, axis=1).astype(np.float64))
    normals[~normals.any(axis=1)] = (0, 0, 1)
    return normals


def texture_coordinates(points: Floats, shape: tuple[int, ...]) -> Float32Array:
    """Return the texture coordinates (V, 2) of image points (V, 2); see SurfaceMesh.uvs."""
    return ((points + 0.5) / (shape[1], shape[0])).astype(np.float32)


def fill_outside(texture: NDArray[Any], known: Bools) -> NDArray[Any]:
    """Return a texture (H, W) or (H, W, 3) whose unknown pixels have the value of the nearest known
    pixel.

    Viewers interpolate between pixels and reduce textures, so the background would appear at the
    border.
    """
    from scipy.ndimage import distance_transform_edt

    if known.all() or not known.any():
        return texture
    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(texture[rows, columns])


def _triangles(heights: Float64Array, mask: Bools) -> NDArray[np.int32]:
    number = np.full(mask.shape, -1, np.int32)
    number[mask] = np.arange(len(heights))
    # The corners of each square, counter-clockwise from the top left (y up).
    corners = (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    squares = np.stack(corners, axis=-1).reshape(-1, 4)
    inside = squares >= 0
    whole = squares[inside.all(axis=1)]
    step = np.abs(heights[whole[:, :2]] - heights[whole[:, 2:]])
    across = step[:, 0] <= step[:, 1]
    halves = {True: ([0, 1, 2], [0, 2, 3]), False: ([0, 1, 3], [1, 2, 3])}
    parts = [whole[across == way][:, three] for way, pair in halves.items() for three in pair]
    three = inside.sum(axis=1) == 3
    parts.append(squares[three][inside[three]].reshape(-1, 3))
    return np.concatenate(parts)


# Number of pixels above which the triangles of blocks are decimated, because all are too many
LARGE_MAP = 500_000
# A border is smoothed over about this many vertices on either side.
_OUTLINE_ROUNDS = 4
# Tolerance of barycentric coordinates, so that no pixel is lost between triangles
_OUTSIDE = 1e-6


def decimated_mesh(
    depth: Floats,
    mask: Bools,
    camera_matrix: Floats | None = None,
    *,
    n_triangles: int,
    normal_map: Floats,
    largest_step: float | None = None,
) -> SurfaceMesh:
    """Return a mesh of about `n_triangles` triangles, with a texture of the normals.

    The outline is smoothed, and edges are collapsed where this changes the surface least (Garland
    and Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997). A mesh without
    more triangles than that is returned unchanged.

    Args:
        depth, mask, camera_matrix, largest_step: see surface_mesh.
        n_triangles: at least 1.
        normal_map: (H, W, 3), unit on the object, zero outside.

    Raises:
        UsageError: fast-simplification is not installed, or the largest step is negative.
        InputError: no triangle is left.
    """
    # Collapsing all edges of a large map takes much memory. If far fewer triangles than pixels are
    # requested, a mesh of blocks with at least four times the requested number has the same shape,
    # and the normal texture preserves the detail.
    mesh, n_pixels = None, np.count_nonzero(mask)
    step = int((2 * n_pixels / (4 * n_triangles)) ** 0.5)
    if step > 1 and n_pixels > LARGE_MAP:
        mesh = _mesh_of_blocks(depth, mask, camera_matrix, step, normal_map, largest_step)
    if mesh is None or len(mesh.triangles) <= n_triangles:
        mesh = surface_mesh(
            depth, mask, camera_matrix, normal_map=normal_map, largest_step=largest_step
        )
    if n_triangles >= len(mesh.triangles):
        return mesh
    mesh = with_smooth_outline(mesh)
    simplify = import_extra("fast_simplification", "mesh").simplify
    # The library has thresholds in the unit of the vertices, which are suitable for pixels.
    pixel = 1 if camera_matrix is None else 1 / focal_length(camera_matrix)
    vertices, triangles = simplify(
        mesh.vertices.astype(np.float64) / pixel, mesh.triangles, target_count=n_triangles
    )
    if not len(triangles):
        raise InputError(
            f"no mesh of {n_triangles} triangles is left",
            hint="Request more triangles with --decimate",
        )
    vertices = vertices * pixel
    normals = vertex_normals(vertices, triangles)
    tangents = _tangents(vertices, normals, camera_matrix)
    points = image_points(vertices, mask.shape, camera_matrix)
    return SurfaceMesh(
        vertices.astype(np.float32),
        triangles.astype(np.int32),
        normals.astype(np.float32),
        texture_coordinates(points, mask.shape),
        tangents=tangents.astype(np.float32),
        normal_texture=_normal_texture(points, triangles, normals, tangents, normal_map),
    )


def with_smooth_outline(mesh: SurfaceMesh) -> SurfaceMesh:
    """Return a mesh of pixels whose border does not have the steps of single pixels.

    The vertices of the border are smoothed along it, except where two borders meet.
    """
    count = len(mesh.vertices)
    start = mesh.triangles.ravel().astype(np.int64)
    end = np.roll(mesh.triangles, -1, axis=1).ravel().astype(np.int64)
    border = ~np.isin(start * count + end, end * count + start)
    start, end = start[border], end[border]
    once = (np.bincount(start, minlength=count) == 1) & (np.bincount(end, minlength=count) == 1)
    following, preceding = np.arange(count), np.arange(count)
    following[start[once[start]]] = end[once[start]]
    preceding[end[once[end]]] = start[once[end]]
    places: Floats = np.hstack((mesh.vertices, mesh.uvs))
    for _ in range(_OUTLINE_ROUNDS):
        places = places / 2 + (places[preceding] + places[following]) / 4
    return replace(mesh, vertices=places[:, :3], uvs=places[:, 3:])


def _mesh_of_blocks(
    depth: Floats,
    mask: Bools,
    camera_matrix: Floats | None,
    step: int,
    normal_map: Floats,
    largest_step: float | None,
) -> SurfaceMesh:
    """Return the mesh of a map's blocks of step x step pixels, in the frame of the map."""
    blocks = Blocks.of_step(mask, step)
    pixels = np.concatenate((depth[mask][:, None], normal_map[mask]), axis=1)
    of_blocks = on_map(blocks.average(pixels, mask).astype(np.float64), blocks.mask)
    # Without a camera matrix, lengths are measured in blocks instead of pixels.
    scale = step if camera_matrix is None else 1
    mesh = surface_mesh(
        of_blocks[..., 0] / scale,
        blocks.mask,
        blocks.shrink_camera(camera_matrix),
        normal_map=unit(of_blocks[..., 1:]),
        largest_step=largest_step,
    )
    shift = np.zeros(3)
    if camera_matrix is None:
        shift[:2] = step * np.array(blocks.mask.shape[::-1]) - mask.shape[::-1]
    vertices = mesh.vertices * scale + shift * (0.5, -0.5, 0)
    return replace(mesh, vertices=vertices.astype(np.float32))


def _tangents(
    vertices: Float64Array, normals: Float64Array, camera_matrix: Floats | None
) -> Float64Array:
    """Return the unit tangents (V, 3), which follow the rows of the image along the surface.

    They are perpendicular to the normals, and in the plane that contains the viewing rays of a row.
    Viewers compute tangents in the same way, as the derivative of the position along u
    (MikkTSpace).
    """
    along = np.array((1.0, 0.0, 0.0)) if camera_matrix is None else ray_basis(camera_matrix)[0]
    rays = np.array((0.0, 0.0, -1.0)) if camera_matrix is None else vertices
    tangents = unit(np.cross(np.cross(along, rays), normals))
    tangents[~tangents.any(axis=1)] = unit(along)
    return tangents


def _normal_texture(
    points: Float64Array,
    triangles: Integers,
    normals: Float64Array,
    tangents: Float64Array,
    normal_map: Floats,
) -> Picture:
    """Return the normal texture (H, W, 3) of a mesh.

    Pixels outside the mesh have the value of the nearest pixel inside. `points` (V, 2) are the
    columns and rows of the vertices in the image, `triangles` (T, 3) their indices, and `normals`
    and `tangents` (V, 3) unit vectors. The normal map (H, W, 3) is zero outside the object.
    """
    texture = np.full(normal_map.shape, (128, 128, 255), np.uint8)
    known = np.zeros(normal_map.shape[:2], np.bool_)
    on_object = np.asarray(normal_map.any(axis=2))
    for number, weights, rows, columns in _covered_pixels(points, triangles, known.shape):
        known_here = on_object[rows, columns]
        corners, weights = triangles[number[known_here]], weights[known_here]
        rows, columns = rows[known_here], columns[known_here]
        frames = (unit(np.einsum("qc,qcx->qx", weights, of[corners])) for of in (normals, tangents))
        texels = _in_frame(normal_map[rows, columns].astype(np.float64), *frames)
        texture[rows, columns] = np.rint((texels + 1) / 2 * 255)
        known[rows, columns] = True
    return fill_outside(texture, known)


def _in_frame(
    measured: Float64Array, normals: Float64Array, tangents: Float64Array
) -> Float64Array:
    """Return the unit coordinates (Q, 3) of normals in the frames T, B = N x T, N.

    T may deviate from being perpendicular to N.
    """
    bitangents = np.cross(normals, tangents)
    axes = (tangents, bitangents, normals)
    along, up, out = (np.einsum("qx,qx->q", measured, axis) for axis in axes)
    skew = np.einsum("qx,qx->q", tangents, normals)
    square = np.maximum(1 - skew**2, 1e-6)
    texels = np.stack((along - skew * out, up, out - skew * along), axis=1) / square[:, None]
    texels[:, 2] = np.maximum(texels[:, 2], 1 / 255)  # glTF allows no normal below the surface
    return unit(texels)


def _covered_pixels(
    points: Float64Array, triangles: Integers, shape: tuple[int, ...]
) -> Iterator[tuple[Indices, Float64Array, Indices, Indices]]:
    """Yield the pixels whose centres are in triangles.

    Each item contains the triangles (Q,), the barycentric coordinates (Q, 3), and the rows and
    columns.
    """
    for start in range(0, len(triangles), 50_000):
        numbers = np.arange(start, min(start + 50_000, len(triangles)))
        corners = points[triangles[numbers]]
        forms = _barycentric_forms(corners)
        usable = np.isfinite(forms).all(axis=(1, 2))
        numbers, corners, forms = numbers[usable], corners[usable], forms[usable]
        # Find the rows of each triangle, and in each row the columns with positive coordinates.
        first = np.ceil(corners[..., 1].min(axis=1) - _OUTSIDE).clip(0, shape[0])
        last = np.floor(corners[..., 1].max(axis=1) + _OUTSIDE).clip(-1, shape[0] - 1)
        which, rows = _ranges(first, last)
        slope, by_row, constant = np.moveaxis(forms[which], 2, 0)
        rest = by_row * rows[:, None] + constant + _OUTSIDE
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -rest / slope
        elsewhere = np.where((slope == 0) & (rest < 0), np.inf, -np.inf)
        low = np.where(slope > 0, crossing, elsewhere).max(axis=1)
        high = np.where(slope < 0, crossing, np.inf).min(axis=1)
        first, last = np.ceil(low).clip(0, shape[1]), np.floor(high).clip(-1, shape[1] - 1)
        span, columns = _ranges(first, last)
        which, rows = which[span], rows[span]
        place = np.stack((columns, rows, np.ones(len(rows))), axis=1)
        yield numbers[which], np.einsum("qcx,qx->qc", forms[which], place), rows, columns


def _barycentric_forms(corners: Float64Array) -> Float64Array:
    """Return linear forms (T, 3, 3) from (column, row, 1) to barycentric coordinates."""
    following, last = np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)
    edge = last - following
    normal = np.stack((-edge[..., 1], edge[..., 0]), axis=-1)
    area = np.einsum("tcx,tcx->tc", normal, corners - following)
    area[np.abs(area) < 1e-9] = np.nan  # a triangle viewed edge-on covers no pixels
    normal = normal / area[..., None]
    return np.concatenate((normal, -np.einsum("tcx,tcx->tc", normal, following)[..., None]), axis=2)


def _ranges(first: Float64Array, last: Float64Array) -> tuple[Indices, Indices]:
    """Return the index of the range for each integer in ranges (first to last), and these
    integers.
    """
    lengths = np.maximum(last - first + 1, 0).astype(np.intp)
    which = np.repeat(np.arange(len(lengths)), lengths)
    within = np.arange(len(which)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return which, first.astype(np.intp)[which] + within
