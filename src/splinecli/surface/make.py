"""The surface of a normal map with its mesh and textures, optionally levelled or in millimetres."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from splinecli.errors import UsageError
from splinecli.maths import Bools, Float32Array, Floats
from splinecli.maths.normals import unit as unit_vectors
from splinecli.maths.pixel_grid import focal_length, on_map
from splinecli.records.documents import SurfaceFacts, Unit
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.integration import integrate_normals
from splinecli.surface.levelling import level_heights, level_normals, plane_slopes
from splinecli.surface.mesh import Textures, decimated_mesh, surface_mesh
from splinecli.surface.solid import close_mesh
from splinecli.surface.surface_files import Surface
from splinecli.system.progress import Progress, ignore


@dataclass(frozen=True, eq=False)
class SurfaceSettings:
    """How a surface is computed from normals; see integrate_normals, surface_mesh and
    decimated_mesh.

    Args:
        pixel_size_mm: the width of a pixel on the object, for a surface in millimetres. None for a
            surface in pixels or, with a camera matrix, in mean depths.
        n_triangles: None keeps all triangles.
        prior: in the unit of the surface. With a camera matrix, it is in millimetres, so
            pixel_size_mm is not needed.
        level: points or (), as in plane_slopes; None does not level the surface.
        pixel_aspect: height of a pixel relative to its width.
        solid_mm: the thickness of a closed mesh at its lowest point (close_mesh), for a surface in
            millimetres. None leaves the mesh open.
    """

    discontinuity: float = DISCONTINUITY
    pixel_size_mm: float | None = None
    largest_step: float | None = None
    n_triangles: int | None = None
    prior: Floats | None = None
    prior_detail: float | None = None
    level: tuple[tuple[int, int], ...] | None = None
    pixel_aspect: float = 1.0
    solid_mm: float | None = None

    def check(self, camera_matrix: Floats | None) -> None:
        """Raise UsageError for a solid without a scale, and for settings that need an orthographic
        camera.

        The camera matrix is None for an orthographic camera.
        """
        has_scale = self.prior is not None and camera_matrix is not None
        if self.solid_mm is not None and self.pixel_size_mm is None and not has_scale:
            raise UsageError(
                f"--solid {self.solid_mm:g} is in millimetres, but the surface has no scale",
                hint="Add --pixel-size with the width of a pixel on the object",
            )
        option, hint = "--level", "Level the mesh in another program"
        if self.level is None:
            option, hint = "--pixel-aspect", "The aspect follows from fx and fy of the matrix"
        if camera_matrix is not None and (self.level is not None or self.pixel_aspect != 1):
            raise UsageError(
                f"{option} requires an orthographic camera, but a camera matrix is given", hint=hint
            )


def make_surface(
    normal_map: Float32Array,
    mask: Bools,
    camera_matrix: Floats | None,
    textures: Textures,
    settings: SurfaceSettings,
    progress: Progress = ignore,
) -> tuple[Surface, dict[str, Any]]:
    """Return the surface of a normal map, and its entry in the reports.

    For the arguments and errors, see integrate_normals, surface_mesh and decimated_mesh. Raises
    UsageError if settings and camera do not match.
    """
    settings.check(camera_matrix)
    prior, aspect = settings.prior, settings.pixel_aspect
    if prior is not None and camera_matrix is None and settings.pixel_size_mm is not None:
        prior = prior / settings.pixel_size_mm
    stretched = normal_map
    if aspect != 1:  # the normals of a surface with the same heights on square pixels
        vectors = normal_map[mask] * np.array((1, aspect, 1), np.float32)
        stretched = on_map(unit_vectors(vectors), mask)
    depth = integrate_normals(
        stretched,
        mask,
        camera_matrix,
        discontinuity=settings.discontinuity,
        prior=prior,
        prior_detail=settings.prior_detail,
        progress=progress,
    )
    slopes = level_map = None
    if settings.level is not None:
        slopes = plane_slopes(depth, settings.level, aspect=aspect)
        depth = level_heights(depth, slopes, aspect=aspect)
        normal_map = level_map = level_normals(normal_map, mask, slopes)
    if settings.n_triangles is None:
        make_mesh = surface_mesh
    else:
        make_mesh = partial(decimated_mesh, n_triangles=settings.n_triangles)
    mesh = make_mesh(
        depth, mask, camera_matrix, normal_map=normal_map, largest_step=settings.largest_step
    )
    mesh = textures.put_on(mesh, mask)
    if aspect != 1:
        mesh = replace(mesh, vertices=mesh.vertices * np.array((1, aspect, 1), np.float32))
    pixel = 1.0 if camera_matrix is None else 1 / focal_length(camera_matrix)
    unit: Unit = "pixel" if camera_matrix is None else "mean depth"
    millimetres = 1 / pixel
    if prior is not None and camera_matrix is not None:
        unit, millimetres = "millimetre", 1.0
    elif settings.pixel_size_mm is not None:
        unit, millimetres, scale = "millimetre", 1.0, settings.pixel_size_mm / pixel
        depth, mesh = depth * scale, replace(mesh, vertices=mesh.vertices * np.float32(scale))
    if settings.solid_mm is not None:
        mesh = close_mesh(mesh, settings.solid_mm, perspective=camera_matrix is not None)
    # rounded to the precision of float32
    low, high = (float(f"{end(depth):.7g}") for end in (np.nanmin, np.nanmax))
    report = SurfaceFacts(
        camera="orthographic" if camera_matrix is None else "perspective",
        unit=unit,
        pixel_size_mm=settings.pixel_size_mm,
        range=(low, high),
        n_vertices=len(mesh.vertices),
        n_triangles=len(mesh.triangles),
        normal_texture=mesh.normal_texture is not None,
        discontinuity=settings.discontinuity,
    ).as_dict()
    if slopes is not None:
        tilt_deg = math.degrees(math.atan(math.hypot(*slopes)))
        report["level"] = {
            "slopes": [round(slope, 6) for slope in slopes],
            "tilt_deg": round(tilt_deg, 4),
        }
    return Surface(depth, mesh, unit, millimetres, level_map), report
