"""Integrate normal maps: compute the surface, as `infer --surface` does, and write its files."""

import json
import math
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import numpy as np
from msgspec import Struct

from splinecli.capture import read_image, read_normal_map
from splinecli.capture.formats.images import ExpectedSize, check_memory
from splinecli.capture.formats.normal_files import read_depth
from splinecli.capture.lamp_files import read_camera_matrix
from splinecli.capture.linearise import parse_window
from splinecli.errors import InputError, SplinecliError
from splinecli.maths import Float64Array, Floats, Picture
from splinecli.maths.normals import Convention, encode_picture
from splinecli.maths.pixel_grid import ray_basis
from splinecli.pictures.maps import encode_png
from splinecli.pipeline.infer_options import check_pixel_size
from splinecli.pipeline.options import IntegrateOptions
from splinecli.records.output_files import (
    BYTES_OF_SURFACE,
    GLOSS,
    LEVEL_MAP,
    LEVEL_NORMALS,
    LEVEL_PICTURE,
    MAPS,
    NORMALS,
    REPORT,
    SURFACE_FILES,
    SURFACE_REPORT,
    file_names,
)
from splinecli.results.files import UNUSABLE, UnfinishedError, read_report
from splinecli.surface import surface_files
from splinecli.surface.bilateral_equations import DISCONTINUITY
from splinecli.surface.make import SurfaceSettings, make_surface
from splinecli.surface.mesh import Textures
from splinecli.surface.surface_files import encode_surface
from splinecli.system.files import check_free, read_json
from splinecli.system.machine import import_extra
from splinecli.system.progress import SILENT, Observer
from splinecli.system.publishing import held_folder, new_files


def view_of_report(
    report: Mapping[str, Any],
    camera_matrix: Floats | None = None,
    pixel_size_mm: float | None = None,
) -> tuple[Float64Array | None, float | None]:
    """Return the camera matrix and the pixel size in millimetres from a report of `infer`.

    `camera_matrix` and `pixel_size_mm` refer to the whole photographs and override the values in
    the report. Raises KeyError, TypeError, ValueError or UsageError if the document is not a report
    from this version of `infer`.
    """
    options, lamps = report["options"], report["near_lamps"]
    window = parse_window(options["crop"], options["scale"])
    matrix = None if camera_matrix is None else window.camera(camera_matrix)
    # The matrices in a report refer to the window. Earlier versions have none for distant lights.
    stored = report.get("camera_matrix")
    if lamps is not None and lamps["camera"] == "perspective":
        stored = lamps["camera_matrix"]
    if matrix is None and stored is not None:
        matrix = np.array(stored, np.float64).reshape(3, 3)
    # Without a surface, the pixel size applies only to near lamps and may be in any unit.
    if pixel_size_mm is None and options["surface"] and options["pixel_size"] is not None:
        pixel_size_mm = float(options["pixel_size"])
    if pixel_size_mm is not None:
        check_pixel_size(pixel_size_mm)
    return matrix, None if pixel_size_mm is None else pixel_size_mm * window.step


def integrate_normal_map(options: IntegrateOptions, observer: Observer = SILENT) -> dict[str, Any]:
    """Integrate a normal map, write the surface and its report, and return the report.

    Raises SplinecliError.
    """
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
    used: Mapping[str, Any] = {"convention": "opengl", "discontinuity": DISCONTINUITY}
    if made_by is not None:
        used = made_by["options"]
    convention = options.convention or used["convention"]
    normal_map = read_normal_map(path, options.mask, convention=convention)
    mask = np.asarray(normal_map.any(axis=2))
    n_pixels = int(np.count_nonzero(mask))
    check_memory(
        n_pixels * BYTES_OF_SURFACE,
        f"the surface of {n_pixels} pixels takes",
        options.normals,
        hint="Mask the object with --mask, or reduce the normal map (infer --scale)",
    )
    discontinuity, camera_matrix, prior = options.discontinuity, None, None
    if options.camera_matrix is not None:
        camera_matrix = read_camera_matrix(options.camera_matrix)
    pixel_size = options.pixel_size
    if made_by is not None:
        camera_matrix, pixel_size = view_of_report(made_by, camera_matrix, pixel_size)
    if options.prior is not None:
        prior = read_depth(options.prior, ExpectedSize(mask.shape, "the normal map", "a depth map"))
    settings = SurfaceSettings(
        float(used["discontinuity"]) if discontinuity is None else discontinuity,
        pixel_size,
        options.largest_step,
        options.decimate,
        prior,
        options.prior_detail,
        options.level,
        options.pixel_aspect,
        options.solid,
    )
    picture, textures = _read_textures(options, mask.shape)
    with observer.progress("integrating", 1.0) as advance:
        surface, found = make_surface(normal_map, mask, camera_matrix, textures, settings, advance)
    report = {
        "schema": 3,
        "normals": str(options.normals),
        "colours": None if picture is None else str(picture),
        "prior": None if options.prior is None else str(options.prior),
        "level": None,
        "pixel_aspect": options.pixel_aspect,
        "solid_mm": options.solid,
        "n_pixels": n_pixels,
        "image_size": [mask.shape[1], mask.shape[0]],
        **found,
    }
    stale = _earlier_files(options.folder)
    with new_files(options.folder, report=SURFACE_REPORT, stale=stale) as new:
        for name, content in encode_surface(surface, options.formats):
            new.write(name, content)
        if surface.level_normals is not None:
            new.write(LEVEL_MAP, surface.level_normals)
            new.write(LEVEL_PICTURE, encode_png(encode_picture(surface.level_normals, mask)))
        report["seconds"] = round(time.perf_counter() - started, 3)
        report["folder"] = str(options.folder.absolute())
        report["files"] = [name for name in options.files if name in {*new.sizes, SURFACE_REPORT}]
        new.write(SURFACE_REPORT, json.dumps(report, indent=2) + "\n")
    if report["level"] is not None:
        observer.say(f"The surface was levelled by {report['level']['tilt_deg']:.2f} degrees")
    return report


def _read_textures(
    options: IntegrateOptions, shape: tuple[int, ...]
) -> tuple[Path | None, Textures]:
    """Return the image of the colours, if any, and the textures (H, W) for the mesh.

    They come from the options, or from the maps in the folder.
    """
    folder, picture = options.normals, options.colours
    material = MAPS["material"].files
    base, gloss, specular = (
        folder / material[name] for name in ("base_colour.png", GLOSS, "specular.npy")
    )
    has_material = all(path.is_file() for path in (base, gloss, specular))
    of_folder = base if has_material else folder / MAPS["albedo"].files["png"]
    if picture is None and of_folder.is_file():
        picture = of_folder
    if picture is None:
        return None, Textures()
    colours = _read_picture(picture, shape)
    if options.colours is not None or not has_material:
        return picture, Textures(colours)
    stored = np.nan_to_num(read_depth(specular, ExpectedSize(shape, "the normal map", "a map")))
    # limited to full reflection
    reflection = stored.clip(0, 12.5).astype(np.float32)
    return picture, Textures(colours, _read_picture(gloss, shape), reflection)


def _read_picture(path: Path, shape: tuple[int, ...]) -> Picture:
    """Return an image as an 8-bit picture (H, W, 3). Raises InputError if its size is not (H,
    W).
    """
    image = np.broadcast_to(read_image(path, ExpectedSize(shape, "the normal map")), (*shape, 3))
    return np.asarray(np.rint(255 * image.clip(0, 1)), np.uint8)


def summary_line(options: IntegrateOptions, report: dict[str, Any]) -> str:
    """Return a one-line summary of the surface."""
    units = {"pixel": "pixels", "mean depth": "times the mean depth", "millimetre": "mm"}
    low, high = report["range"]
    extent = f"from {low:.4g} to {high:.4g} {units[report['unit']]}"
    pixels, seconds = report["n_pixels"], report["seconds"]
    return f"{options.folder}: {pixels} pixels, {extent}, {seconds:.1f} s"


class _Listing(Struct):
    """The list of files in a report."""

    files: list[str]


def _earlier_files(folder: Path) -> list[str]:
    """Return the surface files that an earlier `integrate` wrote to the folder. Files of `infer`
    are kept.
    """
    try:
        named = read_json(folder / SURFACE_REPORT, _Listing).files
    except (OSError, ValueError):
        return []
    return [name for name in (*file_names(tuple(SURFACE_FILES)), *LEVEL_NORMALS) if name in named]


def _find_normal_map(folder: Path) -> Path:
    names = [NORMALS[name] for name in ("npy", "tiff", "png", "png8")]  # the most precise first
    try:
        files = read_report(folder)["files"]
        return folder / next(name for name in names if name in files)
    except StopIteration:
        problem = f"the folder has no normal map ({', '.join(names)})"
    except UnfinishedError as error:
        problem = f"the folder has no complete results of infer: it {error}"
    except UNUSABLE:
        problem = f"the folder has no complete results of infer: its {REPORT} is damaged"
    raise InputError(
        problem, path=folder, hint="Pass a folder written by 'splinecli infer', or one of its files"
    )


def _report_of(path: Path) -> dict[str, Any] | None:
    """Return the report of the run that wrote a normal map; None if there is none."""
    try:
        report: dict[str, Any] = read_json(path.parent / REPORT)
        if path.name not in report["files"]:
            return None
    except UNUSABLE:
        return None
    with suppress(*UNUSABLE, OverflowError, SplinecliError):
        camera_matrix, _ = view_of_report(report)
        if camera_matrix is not None:
            ray_basis(camera_matrix)
        used = report["options"]
        is_finite = 0 <= float(used["discontinuity"]) < math.inf
        if is_finite and used["convention"] in get_args(Convention):
            return report
    raise InputError(
        "the report is damaged, or from another version, so it is unknown how the normal map in"
        " this folder was made",
        path=path.parent / REPORT,
        hint="Run 'splinecli infer' again, or move the normal map to another folder",
    )
