"""The surface of a normal map: integrated, as a mesh, in its unit, with its report. `integrate` and `infer` make it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.linearise import parse_window
from splinecli.errors import UsageError
from splinecli.surface.bilateral_equations import STIFFNESS
from splinecli.surface.integration import integrate_normals
from splinecli.surface.mesh import decimated_mesh, surface_mesh
from splinecli.surface.pixel_grid import focal_length
from splinecli.surface.surface_files import Surface

BYTES_OF_SURFACE = 600  # of each pixel of the mask: integration, or the mesh and its files, whichever takes more
SMALLEST_PIXEL_MM, LARGEST_PIXEL_MM = 1e-6, 1e6


def make_surface(
    normal_map: NDArray[np.float32],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None = None,
    colours: NDArray[np.uint8] | None = None,
    *,
    stiffness: float = STIFFNESS,
    largest_step: float | None = None,
    n_triangles: int | None = None,
    pixel_size_mm: float | None = None,
    prior: NDArray[np.floating] | None = None,
    prior_detail: float | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> tuple[Surface, dict[str, Any]]:
    """Return the surface of a normal map, and what the reports say of it.

    Arguments and errors are those of integrate_normals, surface_mesh and decimated_mesh. Without `n_triangles`, the
    mesh keeps all. `pixel_size_mm` is the width of a pixel on the object, for a surface in millimetres; None for one in
    pixels, or, with a camera matrix, in mean depths. The prior is in the unit of the surface. With a camera matrix this
    is the millimetre, so that pixel_size_mm is not needed.
    """
    if prior is not None and camera_matrix is None and pixel_size_mm is not None:
        prior = prior / pixel_size_mm
    depth = integrate_normals(
        normal_map, mask, camera_matrix, stiffness=stiffness, prior=prior, prior_detail=prior_detail, progress=progress
    )
    surface = depth, mask, camera_matrix, colours
    if n_triangles is None:
        mesh = surface_mesh(*surface, normal_map=normal_map, largest_step=largest_step)
    else:
        mesh = decimated_mesh(*surface, n_triangles=n_triangles, normal_map=normal_map, largest_step=largest_step)
    pixel = 1.0 if camera_matrix is None else 1 / focal_length(camera_matrix)
    unit, millimetres = "pixel" if camera_matrix is None else "mean depth", 1 / pixel
    if prior is not None and camera_matrix is not None:
        unit, millimetres = "millimetre", 1.0
    elif pixel_size_mm is not None:
        unit, millimetres, scale = "millimetre", 1.0, pixel_size_mm / pixel
        depth, mesh = depth * scale, replace(mesh, vertices=mesh.vertices * np.float32(scale))
    report = {
        "camera": "orthographic" if camera_matrix is None else "perspective",
        "unit": unit,
        "pixel_size_mm": pixel_size_mm,
        "range": [float(f"{end(depth):.7g}") for end in (np.nanmin, np.nanmax)],  # the digits of float32
        "n_vertices": len(mesh.vertices),
        "n_triangles": len(mesh.triangles),
        "normal_texture": mesh.normal_texture is not None,
        "stiffness": stiffness,
    }
    return Surface(depth, mesh, unit, millimetres), report


def view_of_report(
    report: Mapping[str, Any], camera_matrix: NDArray[np.floating] | None = None, pixel_size_mm: float | None = None
) -> tuple[NDArray[np.float64] | None, float | None]:
    """Return camera matrix and pixel size in millimetres of the normal map that a report of `infer` describes.

    `camera_matrix` and `pixel_size_mm` are those of the photographs, in place of those of the report. Raises KeyError,
    TypeError, ValueError or UsageError if it is no report of this version of `infer`.
    """
    options, lamps = report["options"], report["near_lamps"]
    window = parse_window(options["crop"], options["scale"])
    matrix = None if camera_matrix is None else window.camera(camera_matrix)
    if matrix is None and lamps is not None and lamps["camera"] == "perspective":
        matrix = np.array(lamps["camera_matrix"], np.float64).reshape(3, 3)  # of what the window reads
    # Without a surface, it only scaled near lamps, whose unit may be any.
    if pixel_size_mm is None and options["surface"] and options["pixel_size"] is not None:
        pixel_size_mm = float(options["pixel_size"])
    check_pixel_size(pixel_size_mm)
    return matrix, None if pixel_size_mm is None else pixel_size_mm * window.step


def check_pixel_size(pixel_size: float | None) -> None:
    """Raise UsageError for a pixel size (mm) out of range."""
    if pixel_size is not None and not SMALLEST_PIXEL_MM <= pixel_size <= LARGEST_PIXEL_MM:
        raise UsageError(f"the pixel size is {pixel_size:g} mm, expected {SMALLEST_PIXEL_MM:g} to {LARGEST_PIXEL_MM:g}")
