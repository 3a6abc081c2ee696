"""The files that `infer` writes for a capture: their names, and functions that write them, all or none."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.inference import NormalEstimate
from splinecli.normals import Convention, describe, encode_picture
from splinecli.pictures.maps import albedo_picture, confidence_picture, preview_picture
from splinecli.pictures.png import encode_png
from splinecli.publishing import new_files
from splinecli.results.clock import Clock
from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, file_names

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
MAPS = {
    "albedo": (ALBEDO_PICTURE, ALBEDO, ALBEDO_EXR),
    "confidence": (CONFIDENCE_PICTURE, CONFIDENCE),
    "preview": (PREVIEW,),
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
"""All files that `infer` and `integrate` may write into a capture's folder of results."""


def write_estimate(
    estimate: NormalEstimate,
    report: dict[str, Any],
    folder: Path,
    *,
    formats: Sequence[str],
    convention: Convention,
    clock: Clock,
    more: Sequence[Callable[[Path], None]] = (),
) -> dict[str, Any]:
    """Write the results of a capture into `folder` and return the finished report.

    The files replace those of an earlier run in the folder, all or none. The caller holds the folder (see held_folder).

    Args:
        estimate: the result.
        report: what report_of returned.
        folder: the capture's folder of results.
        formats: keys of NORMALS.
        convention: whether green is y up or y down in pictures of normals.
        clock: tells the seconds of all stages, of which writing is the last.
        more: functions that write further files of OWN_FILES into a folder, such as write_albedo.

    Raises:
        OutputError: a file cannot be written.
    """
    # The user may have edited the mask of an earlier run and passed it to this run: keep it.
    stale = [name for name in OWN_FILES if name != FOUND_MASK]
    with new_files(folder, report=REPORT, stale=stale) as stage:
        for form in formats:
            write_normals(estimate, form, stage / NORMALS[form], convention)
        if estimate.error_map_deg is not None:
            write_error_map(estimate.error_map_deg, stage)
        for write in more:
            write(stage)
        files = [*(path.name for path in sorted(stage.iterdir())), REPORT]
        report = {**report, "seconds": clock.seconds(), "folder": str(folder.absolute()), "files": files}
        (stage / REPORT).write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    return report


def write_normals(estimate: NormalEstimate, form: str, path: Path, convention: Convention) -> None:
    """Write the normal map as a 16-bit or 8-bit PNG picture, or as a float32 NPY, TIFF or EXR file.

    EXR has the colours of the pictures, (n + 1) / 2 and black outside the mask, because renderers expect them.
    """
    if form in ("png", "png8"):
        bits = 8 if form == "png8" else 16
        picture = encode_picture(estimate.normal_map, estimate.capture.mask, bits=bits, convention=convention)
        path.write_bytes(encode_png(picture, {"normals": describe(convention)}))
    elif form == "npy":
        np.save(path, estimate.normal_map, allow_pickle=False)
    elif form == "exr":
        from splinecli.exr import encode_exr

        signs = np.array((1, 1 if convention == "opengl" else -1, 1), np.float32)
        colours = (estimate.normal_map * signs + 1) / 2 * estimate.capture.mask[..., None]
        path.write_bytes(encode_exr(colours, {"normals": f"(n + 1) / 2; {describe(convention)}"}))
    else:
        import tifffile

        tifffile.imwrite(
            path, estimate.normal_map, photometric="rgb", description=f"normals: {describe('opengl')}"
        )


def write_error_map(error_map_deg: NDArray[np.float32], folder: Path) -> None:
    """Write a picture of an error map (H, W) in degrees, NaN where there is no error."""
    from splinecli.pictures.error_map import error_map_picture

    (folder / ERROR_MAP).write_bytes(encode_png(error_map_picture(error_map_deg)))


def write_albedo(albedo: NDArray[np.float32], mask: NDArray[np.bool_], folder: Path, *, exr: bool) -> None:
    """Write a linear albedo map (H, W, 3) as a float32 NPY file, as a picture and, with exr, as a float16 EXR file."""
    np.save(folder / ALBEDO, albedo, allow_pickle=False)
    if exr:
        from splinecli.exr import encode_exr

        largest = np.finfo(np.float16).max
        content = encode_exr(albedo.clip(0, largest).astype(np.float16), {"colours": "linear RGB"})
        (folder / ALBEDO_EXR).write_bytes(content)
    (folder / ALBEDO_PICTURE).write_bytes(encode_png(albedo_picture(albedo, mask)))


def write_confidence(confidence_map: NDArray[np.float32], folder: Path) -> None:
    """Write a confidence map (H, W) as a float32 NPY file and as a gray picture."""
    np.save(folder / CONFIDENCE, confidence_map, allow_pickle=False)
    (folder / CONFIDENCE_PICTURE).write_bytes(encode_png(confidence_picture(confidence_map)))


def write_mask(mask: NDArray[np.bool_], folder: Path) -> None:
    """Write a mask (H, W) as a black and white picture."""
    (folder / FOUND_MASK).write_bytes(encode_png(mask * np.uint8(255)))


def write_preview(estimate: NormalEstimate, folder: Path) -> None:
    """Write a shaded picture of the surface."""
    picture = preview_picture(estimate.normal_map, estimate.capture.mask)
    (folder / PREVIEW).write_bytes(encode_png(picture))
