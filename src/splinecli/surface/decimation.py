"""Meshes of fewer triangles, whose normal texture keeps the detail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.surface.blocks import Blocks
from splinecli.surface.camera import focal_length, image_points, ray_basis
from splinecli.surface.mesh import (
    SurfaceMesh,
    fill_outside,
    surface_mesh,
    texture_coordinates,
    vertex_normals,
)
from splinecli.surface.normal_texture import normal_texture
from splinecli.system.extras import import_extra

TRIANGLES_LEFT = 4
"""Triangles before decimation, over those after it, at least."""

LARGE_MAP = 500_000
"""Pixels from which the triangles of a map are so many that those of blocks are decimated."""


def decimate(
    mesh: SurfaceMesh,
    n_triangles: int,
    normal_map: NDArray[np.floating],
    camera_matrix: NDArray[np.floating] | None = None,
) -> SurfaceMesh:
    """Return a mesh of about `n_triangles` triangles, with a texture of the normals of the normal map.

    Edges are collapsed where this moves the surface least (Garland and Heckbert, Surface simplification using quadric
    error metrics, SIGGRAPH 1997). A mesh that has no more triangles is returned as it is.

    Args:
        mesh: what surface_mesh or mesh_to_decimate returned.
        n_triangles: at least 1.
        normal_map: (H, W, 3), unit on the object, zero outside.
        camera_matrix: (3, 3), the one that surface_mesh had, or None.

    Raises:
        UsageError: fast-simplification is not installed.
        InputError: no triangle is left.
    """
    if n_triangles >= len(mesh.triangles):
        return mesh
    simplify = import_extra("fast_simplification", "mesh").simplify
    # The thresholds of the library are lengths: give it pixels.
    pixel = 1 if camera_matrix is None else 1 / focal_length(camera_matrix)
    vertices, triangles = simplify(mesh.vertices.astype(np.float64) / pixel, mesh.triangles, target_count=n_triangles)
    if not len(triangles):
        raise InputError(f"no mesh of {n_triangles} triangles is left", hint="Ask for more with --decimate")
    vertices = vertices * pixel
    normals = vertex_normals(vertices, triangles)
    tangents = _tangents(vertices, normals, camera_matrix)
    shape = normal_map.shape[:2]
    points = image_points(vertices, shape, camera_matrix)
    return replace(
        mesh,
        vertices=vertices.astype(np.float32),
        triangles=triangles.astype(np.int32),
        normals=normals.astype(np.float32),
        uvs=texture_coordinates(points, shape),
        tangents=tangents.astype(np.float32),
        normal_texture=normal_texture(points, triangles, normals, tangents, normal_map),
    )


def mesh_to_decimate(
    depth: NDArray[np.floating],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None = None,
    colours: NDArray[np.uint8] | None = None,
    *,
    n_triangles: int,
    normal_map: NDArray[np.floating],
    largest_step: float | None = None,
) -> SurfaceMesh:
    """Return a mesh for `decimate`: that of surface_mesh or, of large maps, one of blocks of pixels.

    Collapsing all edges of a large map takes much memory. If far fewer triangles are wanted, those of the blocks, which
    are at least TRIANGLES_LEFT times as many, have the same shape, and the normal texture keeps the detail.

    Args:
        depth, mask, camera_matrix, colours, normal_map, largest_step: see surface_mesh.
        n_triangles: see decimate.
    """
    step = int((2 * np.count_nonzero(mask) / (TRIANGLES_LEFT * n_triangles)) ** 0.5)
    if step >= 2 and np.count_nonzero(mask) > LARGE_MAP:
        blocks = Blocks.of_step(mask, step)
        of_blocks = np.zeros((*blocks.mask.shape, 4))
        pixels = np.concatenate((depth[mask][:, None], normal_map[mask]), axis=1)
        of_blocks[blocks.mask] = blocks.average(pixels, mask)
        # Without a camera, a step counts in blocks, as a pixel does.
        scale = step if camera_matrix is None else 1
        mesh = surface_mesh(
            of_blocks[..., 0] / scale,
            blocks.mask,
            blocks.shrink_camera(camera_matrix),
            normal_map=unit(of_blocks[..., 1:]),
            largest_step=largest_step,
        )
        if len(mesh.triangles) > n_triangles:
            shift = np.zeros(3)
            if camera_matrix is None:
                shift[:2] = step * np.array(blocks.mask.shape[::-1]) - mask.shape[::-1]
            vertices = mesh.vertices * scale + shift * (0.5, -0.5, 0)
            texture = None if colours is None else fill_outside(colours, mask)
            return replace(mesh, vertices=vertices.astype(np.float32), texture=texture)
    return surface_mesh(depth, mask, camera_matrix, colours, normal_map=normal_map, largest_step=largest_step)


def _tangents(
    vertices: NDArray[np.float64], normals: NDArray[np.float64], camera_matrix: NDArray[np.floating] | None
) -> NDArray[np.float64]:
    """Return the unit tangents (V, 3): perpendicular to the normals, and along the surface in a row of the image.

    A row of the image shows the plane that contains the viewing rays of the row. This is how viewers compute tangents
    themselves (MikkTSpace): the derivative of the position along u.
    """
    along = np.array((1.0, 0.0, 0.0)) if camera_matrix is None else ray_basis(camera_matrix)[0]
    rays = np.array((0.0, 0.0, -1.0)) if camera_matrix is None else vertices
    tangents = unit(np.cross(np.cross(along, rays), normals))
    tangents[~tangents.any(axis=1)] = unit(along)
    return tangents
