"""The files that `infer` writes for a capture: their names, and functions that write them, all or none."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.capture.lights.light_files import rows_text
from splinecli.inference import NormalEstimate
from splinecli.maths.derivatives import curvature_of_normals, gradient_of_normals
from splinecli.maths.normals import Convention, describe, encode_picture
from splinecli.pictures.maps import (
    CURVATURE_SCALE,
    RELIEF_SCALE,
    albedo_picture,
    confidence_picture,
    preview_picture,
    signed_picture,
)
from splinecli.pictures.png import encode_png
from splinecli.results.clock import Clock
from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, file_names
from splinecli.system.files import read_json
from splinecli.system.publishing import NewFiles, is_plain, new_files

NORMALS = {
    "png": "normals.png",
    "png8": "normals_8bit.png",
    "npy": "normals.npy",
    "tiff": "normals.tiff",
    "exr": "normals.exr",
}
"""The file of the normal map in each format."""

ERROR_MAP = "error_map.png"
REPORT, PAGE, FOUND_MASK = "report.json", "page.html", "found_mask.png"
ALBEDO_PICTURE, ALBEDO, ALBEDO_EXR, PREVIEW = "albedo.png", "albedo.npy", "albedo.exr", "preview.png"
CONFIDENCE_PICTURE, CONFIDENCE = "confidence.png", "confidence.npy"
LIGHT_DIRECTIONS, LIGHT_INTENSITIES, LIGHT_PLOT = (
    "light_directions.txt",
    "light_intensities.txt",
    "lights.png",
)
GRADIENT, CURVATURE_PICTURE, CURVATURE = "gradient.npy", "curvature.png", "curvature.npy"
RELIEF_PICTURE, RELIEF = "relief.png", "relief.npy"
MAPS = {
    "albedo": (ALBEDO_PICTURE, ALBEDO, ALBEDO_EXR),
    "confidence": (CONFIDENCE_PICTURE, CONFIDENCE),
    "preview": (PREVIEW,),
    "gradient": (GRADIENT,),
    "curvature": (CURVATURE_PICTURE, CURVATURE),
    "relief": (RELIEF_PICTURE, RELIEF),
}
"""The files of each optional map."""

OWN_FILES = (
    *NORMALS.values(),
    ERROR_MAP,
    *(name for names in MAPS.values() for name in names),
    *file_names(tuple(SURFACE_FILES)),
    SURFACE_REPORT,
    FOUND_MASK,
    PAGE,
    REPORT,
)
"""All files that `infer` and `integrate` may write into a capture's folder of results, but LIGHT_FILES."""

LIGHT_FILES = (LIGHT_DIRECTIONS, LIGHT_INTENSITIES, LIGHT_PLOT)
"""What `infer` writes of lights that it found. In a folder that is also the capture's, such files may be the user's."""


class UnfinishedError(ValueError):
    """A folder has no whole set of results."""


def write_estimate(
    estimate: NormalEstimate,
    report: dict[str, Any],
    folder: Path,
    *,
    formats: Sequence[str],
    convention: Convention,
    clock: Clock,
    more: Sequence[Callable[[NewFiles], None]] = (),
) -> dict[str, Any]:
    """Write the results of a capture into `folder` and return the finished report.

    The files replace those of an earlier run in the folder (see new_files). The caller holds the folder.

    Args:
        estimate: the result.
        report: what report_of returned.
        folder: the capture's folder of results.
        formats: keys of NORMALS.
        convention: whether green is y up or y down in pictures of normals.
        clock: tells the seconds of all stages, of which writing is the last.
        more: functions that write further files of OWN_FILES, such as write_albedo.

    Raises:
        OutputError: a file cannot be written.
    """
    # The user may have edited the mask of an earlier run and passed it to this run: keep it.
    stale = [name for name in OWN_FILES if name != FOUND_MASK] + own_light_files(folder)
    with new_files(folder, report=REPORT, stale=stale) as new:
        for form in formats:
            with new.open(NORMALS[form]) as file:
                write_normals(estimate, form, file, convention)
        if estimate.error_map_deg is not None:
            write_error_map(estimate.error_map_deg, new)
        for write in more:
            write(new)
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


def write_lights(capture: Capture, plot: bytes, new: NewFiles) -> None:
    """Write lights that were found from the images as `--lights` and `--intensities` read them, and their plot."""
    new.write(LIGHT_DIRECTIONS, rows_text(capture.light_directions))
    if capture.estimated_intensities is not None:
        new.write(LIGHT_INTENSITIES, rows_text(np.repeat(capture.estimated_intensities[:, None], 3, axis=1)))
    new.write(LIGHT_PLOT, plot)


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
    changeable = (
        FOUND_MASK,
        *(file_names(tuple(SURFACE_FILES)) if is_plain(folder / SURFACE_REPORT) else ()),
    )
    for name in files:
        path = folder / name
        if name in changeable:
            continue
        if path.parent != folder or not is_plain(path):
            raise UnfinishedError(f"contains earlier results, but {name} is missing")
        if name in sizes and path.stat().st_size != sizes[name]:
            raise UnfinishedError(f"contains earlier results, but {name} has another size than {REPORT} states")
    return report


def write_normals(estimate: NormalEstimate, form: str, file: IO[bytes], convention: Convention) -> None:
    """Write the normal map as a 16-bit or 8-bit PNG picture, or as a float32 NPY, TIFF or EXR file.

    EXR has the colours of the pictures, (n + 1) / 2 and black outside the mask, because renderers expect them.
    """
    if form in ("png", "png8"):
        bits = 8 if form == "png8" else 16
        picture = encode_picture(estimate.normal_map, estimate.capture.mask, bits=bits, convention=convention)
        file.write(encode_png(picture, {"normals": describe(convention)}))
    elif form == "npy":
        np.save(file, estimate.normal_map, allow_pickle=False)
    elif form == "exr":
        from splinecli.system.exr import encode_exr

        signs = np.array((1, 1 if convention == "opengl" else -1, 1), np.float32)
        colours = (estimate.normal_map * signs + 1) / 2 * estimate.capture.mask[..., None]
        file.write(encode_exr(colours, {"normals": f"(n + 1) / 2; {describe(convention)}"}))
    else:
        import tifffile

        tifffile.imwrite(file, estimate.normal_map, photometric="rgb", description=f"normals: {describe('opengl')}")


def write_error_map(error_map_deg: NDArray[np.float32], new: NewFiles) -> None:
    """Write a picture of an error map (H, W) in degrees, NaN where there is no error."""
    from splinecli.pictures.error_map import error_map_picture

    new.write(ERROR_MAP, encode_png(error_map_picture(error_map_deg)))


def write_albedo(albedo: NDArray[np.float32], mask: NDArray[np.bool_], new: NewFiles, *, exr: bool) -> None:
    """Write a linear albedo map (H, W, 3) as a float32 NPY file, as a picture and, with exr, as a float16 EXR file."""
    with new.open(ALBEDO) as file:
        np.save(file, albedo, allow_pickle=False)
    if exr:
        from splinecli.system.exr import encode_exr

        largest = np.finfo(np.float16).max
        content = encode_exr(albedo.clip(0, largest).astype(np.float16), {"colours": "linear RGB"})
        new.write(ALBEDO_EXR, content)
    new.write(ALBEDO_PICTURE, encode_png(albedo_picture(albedo, mask)))


def write_confidence(confidence_map: NDArray[np.float32], new: NewFiles) -> None:
    """Write a confidence map (H, W) as a float32 NPY file and as a gray picture."""
    with new.open(CONFIDENCE) as file:
        np.save(file, confidence_map, allow_pickle=False)
    new.write(CONFIDENCE_PICTURE, encode_png(confidence_picture(confidence_map)))


def write_mask(mask: NDArray[np.bool_], new: NewFiles) -> None:
    """Write a mask (H, W) as a black and white picture."""
    new.write(FOUND_MASK, encode_png(mask * np.uint8(255)))


def write_preview(estimate: NormalEstimate, new: NewFiles) -> None:
    """Write a shaded picture of the surface."""
    new.write(PREVIEW, encode_png(preview_picture(estimate.normal_map, estimate.capture.mask)))


def write_gradient(estimate: NormalEstimate, new: NewFiles) -> None:
    """Write the slopes (H, W, 2) as a float32 NPY file."""
    with new.open(GRADIENT) as file:
        np.save(file, gradient_of_normals(estimate.normal_map, estimate.capture.mask), allow_pickle=False)


def write_curvature(estimate: NormalEstimate, new: NewFiles) -> None:
    """Write the mean and Gaussian curvature (H, W, 2) as a float32 NPY file, and the mean one as a gray picture."""
    curvature = curvature_of_normals(estimate.normal_map, estimate.capture.mask)
    with new.open(CURVATURE) as file:
        np.save(file, curvature, allow_pickle=False)
    scale = f"mean curvature, black {-CURVATURE_SCALE}, gray 0, white {CURVATURE_SCALE} per pixel"
    new.write(CURVATURE_PICTURE, encode_png(signed_picture(curvature[..., 0], CURVATURE_SCALE), {"curvature": scale}))


def write_relief(relief: NDArray[np.float32], new: NewFiles) -> None:
    """Write a relief (H, W) as a float32 NPY file and as a gray picture."""
    with new.open(RELIEF) as file:
        np.save(file, relief, allow_pickle=False)
    scale = f"height, black {-RELIEF_SCALE}, gray 0, white {RELIEF_SCALE} pixels"
    new.write(RELIEF_PICTURE, encode_png(signed_picture(relief, RELIEF_SCALE), {"relief": scale}))
