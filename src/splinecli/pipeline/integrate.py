"""Integrate normal maps: compute the surface, as `infer` also does, and write its files."""

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from splinecli.capture import read_image, read_normal_map
from splinecli.capture.formats.images import ExpectedSize, check_memory
from splinecli.capture.formats.normal_files import read_depth
from splinecli.capture.linearise import parse_window
from splinecli.capture.near_lamps import read_camera_matrix
from splinecli.documents import SurfaceFacts, Unit
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.maths.normals import Convention, encode_picture
from splinecli.maths.normals import unit as unit_vectors
from splinecli.output_files import BYTES_OF_SURFACE, GLOSS, MAPS, NORMALS, REPORT
from splinecli.pictures.maps import encode_png
from splinecli.pipeline.infer_options import check_pixel_size
from splinecli.pipeline.options import IntegrateOptions
from splinecli.results.files import UnfinishedError, read_report
from splinecli.surface import surface_files
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.integration import integrate_normals
from splinecli.surface.levelling import level_heights, level_normals, plane_slopes
from splinecli.surface.mesh import decimated_mesh, fill_outside, surface_mesh
from splinecli.surface.pixel_grid import focal_length, ray_basis
from splinecli.surface.surface_files import (
    LEVEL_MAP,
    LEVEL_NORMALS,
    LEVEL_PICTURE,
    SURFACE_FILES,
    SURFACE_REPORT,
    Surface,
    encode_surface,
)
from splinecli.system.files import check_free, read_json
from splinecli.system.machine import import_extra
from splinecli.system.progress import SILENT, Observer
from splinecli.system.publishing import held_folder, new_files


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

    The arguments and errors are the same as for integrate_normals, surface_mesh and decimated_mesh. `gloss` (H, W, 3)
    is glTF's texture of roughness and metalness; with None, the mesh is matte. `specular` (H, W) is 0.5 for a
    reflectance of 4 %. Without `n_triangles`, the mesh keeps all triangles. `pixel_size_mm` is the width of a pixel on
    the object and gives a surface in millimetres; with None, the unit is the pixel or, with a camera matrix, the mean
    depth. The prior is in the unit of the surface. With a camera matrix, a prior is in millimetres, so pixel_size_mm is
    not needed. `level` is as in plane_slopes, or None; like a height of the pixels other than their width, it raises
    UsageError with a camera matrix.
    """
    if camera_matrix is not None and (level is not None or pixel_aspect != 1):
        option = "--pixel-aspect" if level is None else "--level"
        hint = "Its fx and fy describe the pixels" if level is None else "Level the mesh in another program"
        raise UsageError(f"{option} needs an orthographic camera, but there is a camera matrix", hint=hint)
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
        mesh = decimated_mesh(*surface, n_triangles=n_triangles, normal_map=normal_map, largest_step=largest_step)
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
    low, high = (float(f"{end(depth):.7g}") for end in (np.nanmin, np.nanmax))  # the digits of float32
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
        found["level"] = {"slopes": [round(slope, 6) for slope in slopes], "tilt_deg": round(tilt_deg, 4)}
    return Surface(depth, mesh, unit, millimetres, level_map), found


def _stretched(normal_map: NDArray[np.float32], mask: NDArray[np.bool_], aspect: float) -> NDArray[np.float32]:
    """Return the normals of a surface that has the same heights on square pixels."""
    stretched = np.zeros_like(normal_map)
    stretched[mask] = unit_vectors(normal_map[mask] * np.array((1, aspect, 1), np.float32))
    return stretched


def view_of_report(
    report: Mapping[str, Any], camera_matrix: NDArray[np.floating] | None = None, pixel_size_mm: float | None = None
) -> tuple[NDArray[np.float64] | None, float | None]:
    """Return the camera matrix and the pixel size in millimetres of the normal map described by a report of `infer`.

    `camera_matrix` and `pixel_size_mm` refer to the photographs and override the values in the report. Raises KeyError,
    TypeError, ValueError or UsageError if the document is not a report from this version of `infer`.
    """
    options, lamps = report["options"], report["near_lamps"]
    window = parse_window(options["crop"], options["scale"])
    matrix = None if camera_matrix is None else window.camera(camera_matrix)
    seen = report.get("camera_matrix")  # reports of earlier versions lack it
    if lamps is not None and lamps["camera"] == "perspective":
        seen = lamps["camera_matrix"]
    if matrix is None and seen is not None:
        matrix = np.array(seen, np.float64).reshape(3, 3)  # of the part of the image that the window covers
    # Without a surface, the pixel size only scaled near lamps, which may be in any unit.
    if pixel_size_mm is None and options["surface"] and options["pixel_size"] is not None:
        pixel_size_mm = float(options["pixel_size"])
    if pixel_size_mm is not None:
        check_pixel_size(pixel_size_mm)
    return matrix, None if pixel_size_mm is None else pixel_size_mm * window.step


def integrate_normal_map(options: IntegrateOptions, observer: Observer = SILENT) -> dict[str, Any]:
    """Integrate a normal map, write the surface and its report, and return the report. Raises SplinecliError."""
    if options.decimate is not None:
        import_extra("fast_simplification", "mesh")
    surface_files.check_exr(options.formats)
    with held_folder(options.folder, observer.warn):
        check_free(options.folder, options.files, overwrite=options.overwrite)
        return _integrate_into(options, observer)


def _integrate_into(options: IntegrateOptions, observer: Observer) -> dict[str, Any]:
    started = time.perf_counter()
    path = _find_normal_map(options.normals) if options.normals.is_dir() else options.normals
    made_by = _report_of(path)
    convention = options.convention or ("opengl" if made_by is None else made_by["options"]["convention"])
    normal_map = read_normal_map(path, options.mask, convention=convention)
    mask = np.asarray(normal_map.any(axis=2))
    n_pixels = int(np.count_nonzero(mask))
    check_memory(
        n_pixels * BYTES_OF_SURFACE,
        f"the surface of {n_pixels} pixels takes",
        options.normals,
        hint="Mask the object with --mask, or reduce the normal map (infer --scale)",
    )
    discontinuity = options.discontinuity
    if discontinuity is None:
        discontinuity = DISCONTINUITY if made_by is None else float(made_by["options"]["discontinuity"])
    camera_matrix = None if options.camera_matrix is None else read_camera_matrix(options.camera_matrix)
    pixel_size = options.pixel_size
    if made_by is not None:
        camera_matrix, pixel_size = view_of_report(made_by, camera_matrix, pixel_size)
    prior = None
    if options.prior is not None:
        prior = read_depth(options.prior, ExpectedSize(mask.shape, "the normal map", "a depth map"))
    names = ("base_colour.png", GLOSS, "specular.npy")
    of_material = [options.normals / MAPS["material"].files[name] for name in names]
    has_material = all(path.is_file() for path in of_material)
    picture, gloss, specular = options.colours, None, None
    of_folder = of_material[0] if has_material else options.normals / MAPS["albedo"].files["png"]
    if picture is None and of_folder.is_file():
        picture = of_folder
        if has_material:
            gloss = _read_picture(of_material[1], mask.shape)
            stored = read_depth(of_material[2], ExpectedSize(mask.shape, "the normal map", "a map"))
            specular = np.nan_to_num(stored).clip(0, 12.5).astype(np.float32)  # up to full reflection
    colours = None if picture is None else _read_picture(picture, mask.shape)
    with observer.progress("integrating", 1.0) as advance:
        surface, found = make_surface(
            normal_map,
            mask,
            camera_matrix,
            colours,
            gloss,
            specular,
            discontinuity=discontinuity,
            largest_step=options.largest_step,
            n_triangles=options.decimate,
            pixel_size_mm=pixel_size,
            prior=prior,
            prior_detail=options.prior_detail,
            level=options.level,
            pixel_aspect=options.pixel_aspect,
            progress=advance,
        )
    report = {
        "schema": 3,
        "normals": str(options.normals),
        "colours": None if picture is None else str(picture),
        "prior": None if options.prior is None else str(options.prior),
        "level": None,
        "pixel_aspect": options.pixel_aspect,
        "n_pixels": n_pixels,
        "image_size": [mask.shape[1], mask.shape[0]],
        **found,
    }
    with new_files(options.folder, report=SURFACE_REPORT, stale=_earlier_files(options.folder)) as new:
        for name, content in encode_surface(surface, options.formats):
            new.write(name, content)
        if surface.level_normals is not None:
            new.write(LEVEL_MAP, surface.level_normals)
            new.write(LEVEL_PICTURE, encode_png(encode_picture(surface.level_normals, mask)))
        report["seconds"] = round(time.perf_counter() - started, 3)
        report["folder"] = str(options.folder.absolute())
        report["files"] = [name for name in options.files if name in new.sizes or name == SURFACE_REPORT]
        new.write(SURFACE_REPORT, json.dumps(report, indent=2) + "\n")
    if report["level"] is not None:
        observer.say(f"The surface was levelled by {report['level']['tilt_deg']:.2f} degrees")
    return report


def _read_picture(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return an image as a picture (H, W, 3) of 8 bits. Raises InputError if its size is not (H, W)."""
    image = np.broadcast_to(read_image(path, ExpectedSize(shape, "the normal map")), (*shape, 3))
    return np.asarray(np.rint(255 * image.clip(0, 1)), np.uint8)


def summary_line(options: IntegrateOptions, report: dict[str, Any]) -> str:
    """Return a one-line summary of the files that were written."""
    unit = {"pixel": "pixels", "mean depth": "times the mean depth", "millimetre": "mm"}[report["unit"]]
    low, high = report["range"]
    return (
        f"{options.folder}: {report['n_pixels']} pixels, from {low:.4g} to {high:.4g} {unit}, {report['seconds']:.1f} s"
    )


class _Listing(Struct):
    """The part of a report that lists its files."""

    files: list[str]


def _earlier_files(folder: Path) -> list[str]:
    """Return the surface files that an earlier `integrate` wrote to the folder; files from `infer` are kept."""
    try:
        named = read_json(folder / SURFACE_REPORT, _Listing).files
        return [name for name in (*surface_files.file_names(tuple(SURFACE_FILES)), *LEVEL_NORMALS) if name in named]
    except (OSError, ValueError):
        return []


def _find_normal_map(folder: Path) -> Path:
    names = [NORMALS[name] for name in ("npy", "tiff", "png", "png8")]  # exact ones first
    try:
        files = read_report(folder)["files"]
        return folder / next(name for name in names if name in files)
    except StopIteration:
        problem = f"the folder has no normal map ({', '.join(names)})"
    except UnfinishedError as error:
        problem = f"the folder has no whole results of infer: it {error}"
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        problem = f"the folder has no whole results of infer: its {REPORT} is damaged"
    raise InputError(problem, path=folder, hint="Give a folder that 'splinecli infer' wrote, or one of its files")


def _report_of(path: Path) -> dict[str, Any] | None:
    """Return the report of the `infer` run that wrote a normal map, or None if it has another origin."""
    try:
        report: dict[str, Any] = read_json(path.parent / REPORT)
        if path.name not in report["files"]:
            return None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    with suppress(ValueError, KeyError, TypeError, AttributeError, OverflowError, SplinecliError):
        camera_matrix, _ = view_of_report(report)
        if camera_matrix is not None:
            ray_basis(camera_matrix)
        convention, discontinuity = report["options"]["convention"], float(report["options"]["discontinuity"])
        if convention in get_args(Convention) and 0 <= discontinuity < math.inf:
            return report
    problem = "is damaged, or from another version: it does not say how the normal map beside it was made"
    hint = "Run 'splinecli infer' again, or move the normal map to another folder"
    raise InputError(problem, path=path.parent / REPORT, hint=hint)
