"""The files that `infer` writes for a capture: functions that encode them, and write all or none."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.capture.light_files import rows_text
from splinecli.capture.result_names import (
    ALBEDO,
    ALBEDO_EXR,
    ALBEDO_PICTURE,
    CONFIDENCE,
    CONFIDENCE_PICTURE,
    CURVATURE,
    CURVATURE_PICTURE,
    CURVATURE_TIFF,
    ERROR_MAP,
    FOUND_MASK,
    GRADIENT,
    GRADIENT_TIFF,
    LIGHT_DIRECTIONS,
    LIGHT_FILES,
    LIGHT_INTENSITIES,
    LIGHT_PLOT,
    NORMALS,
    OWN_FILES,
    PREVIEW,
    RELIEF,
    RELIEF_PICTURE,
    RELIEF_TIFF,
    REPORT,
)
from splinecli.maths.normals import Convention, curvature_of_normals, describe, encode_picture, gradient_of_normals
from splinecli.pictures.maps import (
    albedo_picture,
    confidence_picture,
    error_map_picture,
    preview_picture,
    signed_picture,
)
from splinecli.pictures.png import encode_png
from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, encode_exr, encode_tiff, file_names
from splinecli.system.files import read_json
from splinecli.system.publishing import Content, is_plain, new_files

if TYPE_CHECKING:
    from splinecli.inference import NormalEstimate
    from splinecli.system.progress import Clock

Files = Iterator[tuple[str, Content]]  # names and contents, each made when it is asked for


class UnfinishedError(ValueError):
    """A folder has no whole set of results."""


def write_estimate(
    report: dict[str, Any], folder: Path, files: Iterable[tuple[str, Content]], clock: Clock
) -> dict[str, Any]:
    """Write the results of a capture into `folder` and return the finished report; `report` is that of report_of.

    The files, of OWN_FILES and LIGHT_FILES, replace those of an earlier run in the folder (see new_files), which the
    caller holds. Writing is the last stage of the clock. Raises OutputError if a file cannot be written.
    """
    # The user may have edited the mask of an earlier run and passed it to this run: keep it.
    stale = [name for name in OWN_FILES if name != FOUND_MASK] + own_light_files(folder)
    with new_files(folder, report=REPORT, stale=stale) as new:
        for name, content in files:
            new.write(name, content)
            del content  # before the next one is made
        report = {
            **report,
            "seconds": clock.seconds(),
            "folder": str(folder.absolute()),
            "files": [*new.sizes, REPORT],
            "file_sizes": new.sizes,
        }
        new.write(REPORT, json.dumps(report, indent=2) + "\n")
    return report


def own_light_files(folder: Path) -> list[str]:
    """Return those of LIGHT_FILES in a folder of results that an earlier run wrote, as its report says."""
    try:
        return [name for name in LIGHT_FILES if name in read_report(folder)["files"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []


def read_report(folder: Path) -> dict[str, Any]:
    """Return the report of a folder of results whose files are as it states. Links in the folder are not followed.

    Apart from the files, what the report says is not checked.

    Raises:
        UnfinishedError: there is no report, or a file is missing or has another size.
        OSError, ValueError, KeyError, TypeError, AttributeError: the report cannot be used.
    """
    if not is_plain(folder / REPORT):
        raise UnfinishedError(f"has no {REPORT}")
    report: dict[str, Any] = read_json(folder / REPORT)
    files, sizes = report["files"], report.get("file_sizes", {})  # earlier versions stated no sizes
    if not (isinstance(files, list) and all(isinstance(name, str) for name in files) and isinstance(sizes, dict)):
        raise ValueError("the report has no list of files, or no sizes")
    # The mask is made to be edited, and `integrate` may have replaced the surface.
    changeable = (FOUND_MASK, *(file_names(tuple(SURFACE_FILES)) if is_plain(folder / SURFACE_REPORT) else ()))
    for name in files:
        path = folder / name
        if name in changeable:
            continue
        if path.parent != folder or not is_plain(path):
            raise UnfinishedError(f"contains earlier results, but {name} is missing")
        if name in sizes and path.stat().st_size != sizes[name]:
            raise UnfinishedError(f"contains earlier results, but {name} has another size than {REPORT} states")
    return report


def normal_files(estimate: NormalEstimate, formats: Sequence[str], convention: Convention) -> Files:
    """Yield the normal map in some formats, which are keys of NORMALS, and the error map if there is one."""
    for form in formats:
        yield NORMALS[form], encode_normals(estimate, form, convention)
    if estimate.error_map_deg is not None:
        yield ERROR_MAP, encode_png(error_map_picture(estimate.error_map_deg))


def encode_normals(estimate: NormalEstimate, form: str, convention: Convention) -> Content:
    """Return the file of the normal map: a 16-bit or 8-bit PNG picture, or float32 NPY, TIFF or EXR.

    EXR has the colours of the pictures, (n + 1) / 2 and black outside the mask, because renderers expect them.
    """
    if form in ("png", "png8"):
        bits = 8 if form == "png8" else 16
        picture = encode_picture(estimate.normal_map, estimate.capture.mask, bits=bits, convention=convention)
        return encode_png(picture, {"normals": describe(convention)})
    if form == "npy":
        return estimate.normal_map
    if form == "exr":
        signs = np.array((1, 1 if convention == "opengl" else -1, 1), np.float32)
        colours = (estimate.normal_map * signs + 1) / 2 * estimate.capture.mask[..., None]
        return encode_exr(colours, {"normals": f"(n + 1) / 2; {describe(convention)}"})
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(file, estimate.normal_map, photometric="rgb", description=f"normals: {describe('opengl')}")
    return file.getvalue()


def light_files(capture: Capture, plot: bytes) -> Files:
    """Yield lights that were found from the images, as `--lights` and `--intensities` read them, and their plot."""
    yield LIGHT_DIRECTIONS, rows_text(capture.light_directions)
    if capture.estimated_intensities is not None:
        yield LIGHT_INTENSITIES, rows_text(np.repeat(capture.estimated_intensities[:, None], 3, axis=1))
    yield LIGHT_PLOT, plot


def albedo_files(albedo: NDArray[np.float32], mask: NDArray[np.bool_], *, exr: bool) -> Files:
    """Yield a linear albedo map (H, W, 3) as a float32 NPY file, as a picture and, with exr, as a float16 EXR file."""
    yield ALBEDO, albedo
    if exr:
        largest = np.finfo(np.float16).max
        yield ALBEDO_EXR, encode_exr(albedo.clip(0, largest).astype(np.float16), {"colours": "linear RGB"})
    yield ALBEDO_PICTURE, encode_png(albedo_picture(albedo, mask))


def map_files(estimate: NormalEstimate, maps: Sequence[str], curvature_scale: float, *, tiff: bool) -> Files:
    """Yield those of the maps that follow from the normals alone: float32 NPY and TIFF files, and pictures."""
    normal_map, mask = estimate.normal_map, estimate.capture.mask
    if "confidence" in maps and estimate.confidence_map is not None:
        yield CONFIDENCE, estimate.confidence_map
        yield CONFIDENCE_PICTURE, encode_png(confidence_picture(estimate.confidence_map))
    if "preview" in maps:
        yield PREVIEW, encode_png(preview_picture(normal_map, mask))
    if "gradient" in maps:
        gradient = gradient_of_normals(normal_map, mask)
        yield from _value_files((GRADIENT, GRADIENT_TIFF), gradient, "slopes dz/dx and dz/dy, x right, y up", tiff=tiff)
    if "curvature" in maps:
        curvature = curvature_of_normals(normal_map, mask)
        words = f"mean curvature, black {-curvature_scale}, gray 0, white {curvature_scale} per pixel"
        units = "mean and Gaussian curvature, 1/pixel and 1/pixel^2"
        yield from _value_files((CURVATURE, CURVATURE_TIFF), curvature, units, tiff=tiff)
        yield CURVATURE_PICTURE, encode_png(signed_picture(curvature[..., 0], curvature_scale), {"curvature": words})


def relief_files(relief: NDArray[np.float32], scale: float, *, tiff: bool) -> Files:
    """Yield a relief (H, W) as a float32 NPY file, with tiff as a TIFF file, too, and as a gray picture."""
    words = f"height, black {-scale}, gray 0, white {scale} pixels"
    yield from _value_files((RELIEF, RELIEF_TIFF), relief, "heights in pixels", tiff=tiff)
    yield RELIEF_PICTURE, encode_png(signed_picture(relief, scale), {"relief": words})


def _value_files(names: tuple[str, str], values: NDArray[np.float32], description: str, *, tiff: bool) -> Files:
    """Yield a map (H, W) or (H, W, C) as a float32 NPY file and, with tiff, as a TIFF file with a description."""
    yield names[0], values
    if tiff:
        yield names[1], encode_tiff(values, description)
