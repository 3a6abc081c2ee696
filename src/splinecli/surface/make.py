"""The surface of a normal map: integrated, levelled, in millimetres, with its mesh and textures."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import UsageError
from splinecli.maths.normals import unit as unit_vectors
from splinecli.maths.pixel_grid import focal_length
from splinecli.records.documents import SurfaceFacts, Unit
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.integration import integrate_normals
from splinecli.surface.levelling import level_heights, level_normals, plane_slopes
from splinecli.surface.mesh import decimated_mesh, fill_outside, surface_mesh
from splinecli.surface.surface_files import Surface


def make_surface(
    normal_map: NDArray[np.float32],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None = None,
    colours: NDArray[np.uint8] | None = None,
    gloss: NDArray[np.uint8] | None = None,
    specular: NDArray[np.float32] | None = None,
    *,
    discontinuity: float = DISCONTINUITY,
    largest_step: float | None = None,
    n_triangles: int | None = None,
    pixel_size_mm: float | None = None,
    prior: NDArray[np.floating] | None = None,
    prior_detail: float | None = None,
    level: tuple[tuple[int, int], ...] | None = None,
    pixel_aspect: float = 1.0,
    progress: Callable[[float], object] = lambda share: None,
) -> tuple[Surface, dict[str, Any]]:
    """Return the surface of a normal map, and its entry in the reports.

    The arguments and errors are the same as for integrate_normals, surface_mesh and decimated_mesh.
    `gloss` (H, W, 3) is glTF's texture of roughness and metalness; with None, the mesh is matte.
    `specular` (H, W) is 0.5 for a reflectance of 4 %. Without `n_triangles`, the mesh keeps all
    triangles. `pixel_size_mm` is the width of a pixel on the object and gives a surface in
    millimetres; with None, the unit is the pixel or, with a camera matrix, the mean depth. The
    prior is in the unit of the surface. With a camera matrix, a prior is in millimetres, so
    pixel_size_mm is not needed. `level` is as in plane_slopes, or None; like a height of the pixels
    other than their width, it raises UsageError with a camera matrix.
    """
    if camera_matrix is not None and (level is not None or pixel_aspect != 1):
        option = "--pixel-aspect" if level is None else "--level"
        hint = (
            "Its fx and fy describe the pixels"
            if level is None
            else "Level the mesh in another program"
        )
        raise UsageError(
            f"{option} needs an orthographic camera, but there is a camera matrix", hint=hint
        )
    if prior is not None and camera_matrix is None and pixel_size_mm is not None:
        prior = prior / pixel_size_mm
    depth = integrate_normals(
        normal_map if pixel_aspect == 1 else _stretched(normal_map, mask, pixel_aspect),
        mask,
        camera_matrix,
        discontinuity=discontinuity,
        prior=prior,
        prior_detail=prior_detail,
        progress=progress,
    )
    slopes = level_map = None
    if level is not None:
        slopes = plane_slopes(depth, level, aspect=pixel_aspect)
        depth = level_heights(depth, slopes, aspect=pixel_aspect)
        normal_map = level_map = level_normals(normal_map, mask, slopes)
    surface = depth, mask, camera_matrix, colours
    if n_triangles is None:
        mesh = surface_mesh(*surface, normal_map=normal_map, largest_step=largest_step)
    else:
        mesh = decimated_mesh(
            *surface, n_triangles=n_triangles, normal_map=normal_map, largest_step=largest_step
        )
    if pixel_aspect != 1:
        mesh = replace(mesh, vertices=mesh.vertices * np.array((1, pixel_aspect, 1), np.float32))
    if gloss is not None:
        mesh = replace(mesh, gloss=fill_outside(gloss, mask))
    if specular is not None:
        mesh = replace(mesh, specular=fill_outside(specular, mask))
    pixel = 1.0 if camera_matrix is None else 1 / focal_length(camera_matrix)
    unit: Unit = "pixel" if camera_matrix is None else "mean depth"
    millimetres = 1 / pixel
    if prior is not None and camera_matrix is not None:
        unit, millimetres = "millimetre", 1.0
    elif pixel_size_mm is not None:
        unit, millimetres, scale = "millimetre", 1.0, pixel_size_mm / pixel
        depth, mesh = depth * scale, replace(mesh, vertices=mesh.vertices * np.float32(scale))
    # the digits of float32
    low, high = (float(f"{end(depth):.7g}") for end in (np.nanmin, np.nanmax))
    report = SurfaceFacts(
        camera="orthographic" if camera_matrix is None else "perspective",
        unit=unit,
        pixel_size_mm=pixel_size_mm,
        range=(low, high),
        n_vertices=len(mesh.vertices),
        n_triangles=len(mesh.triangles),
        normal_texture=mesh.normal_texture is not None,
        discontinuity=discontinuity,
    )
    found = report.as_dict()
    if slopes is not None:
        tilt_deg = math.degrees(math.atan(math.hypot(*slopes)))
        found["level"] = {
            "slopes": [round(slope, 6) for slope in slopes],
            "tilt_deg": round(tilt_deg, 4),
        }
    return Surface(depth, mesh, unit, millimetres, level_map), found


def _stretched(
    normal_map: NDArray[np.float32], mask: NDArray[np.bool_], aspect: float
) -> NDArray[np.float32]:
    """Return the normals of a surface that has the same heights on square pixels."""
    stretched = np.zeros_like(normal_map)
    stretched[mask] = unit_vectors(normal_map[mask] * np.array((1, aspect, 1), np.float32))
    return stretched
