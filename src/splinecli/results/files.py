"""Write the results of `infer` for a capture: either all of them or none."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import convert

from splinecli._version import __version__
from splinecli.capture import Capture
from splinecli.capture.light_files import rows_text
from splinecli.capture.record import name_reading
from splinecli.maths.normals import AngularErrors, Convention, describe, encode_picture
from splinecli.pictures.maps import encode_png
from splinecli.pictures.plots import error_map_picture
from splinecli.records import output_files
from splinecli.records.documents import (
    AlignmentReport,
    Distillation,
    EstimateReport,
    NearLampsReport,
    UsedWeights,
    WarningReport,
)
from splinecli.records.output_files import REPORT, SURFACE_FILES, SURFACE_REPORT, file_names
from splinecli.surface.surface_files import encode_exr
from splinecli.system.files import read_json
from splinecli.system.publishing import Content, is_plain, new_files

if TYPE_CHECKING:
    from splinecli.estimate.inference import NormalEstimate
    from splinecli.estimate.methods import Estimator
    from splinecli.system.progress import Clock


def report_of(
    estimate: NormalEstimate,
    estimator: Estimator,
    options: Mapping[str, Any],
    inputs: str,
    *,
    light_file: Path | None,
    distillation: Mapping[str, Any] | None = None,
    alignment: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the report of an estimate (docs/infer.md), without material and surface.

    write_estimate adds `seconds`, `folder` and `files`.

    Args:
        options: the options of `infer` as JSON values.
        inputs: a digest that changes when an input file changes.
        light_file: None if the lights were estimated from the images.
        distillation: the result of DistilledEstimator.report, or None if the method was applied to
            every pixel.
        alignment: the result of AlignedImages.as_dict, or None.
    """
    capture = estimate.capture
    intensities, errors = capture.estimated_intensities, estimate.errors
    expected, light_errors_deg = estimate.expected_under_5, capture.light_errors_deg
    height, width = capture.mask.shape
    return EstimateReport(
        schema=3,
        capture=capture.name,
        method=estimator.name,
        weights=None if estimator.weights is None else UsedWeights(**estimator.weights),
        n_lights=capture.n_lights,
        light_indices=list(capture.light_indices),
        light_source="given" if light_errors_deg is None else "estimated",
        light_file=None if light_file is None else str(light_file.absolute()),
        light_directions=capture.light_directions.round(6).tolist(),
        light_errors_deg=None if light_errors_deg is None else light_errors_deg.round(2).tolist(),
        near_lamps=None if capture.lamps is None else NearLampsReport(**capture.lamps.as_dict()),
        camera_matrix=None if capture.camera_matrix is None else capture.camera_matrix.tolist(),
        estimated_intensities=None if intensities is None else intensities.round(4).tolist(),
        n_pixels=capture.n_pixels,
        image_size=(width, height),
        device=estimator.device,
        precision=estimator.precision,
        distillation=None if distillation is None else convert(distillation, Distillation),
        peak_memory_mib=peak_memory_mib(),
        warnings=[WarningReport(code=each.code, text=each.text) for each in capture.warnings],
        angular_error_deg=None
        if errors is None
        else AngularErrors(*(round(value, 4) for value in astuple(errors))),
        expected_under_5=None if expected is None else round(expected, 4),
        capture_judged=None if expected is None else estimate.capture_judged,
        options=dict(options),
        inputs_sha256=inputs,
        version=__version__,
        reading=name_reading(as_stored=options["as_stored"]),
        white_level=capture.white_level,
        removed_blur=None if capture.removed_blur is None else round(capture.removed_blur, 2),
        alignment=None if alignment is None else convert(alignment, AlignmentReport),
        mended=list(capture.mended),
        material=None,
        surface=None,
    ).as_dict()


def peak_memory_mib() -> int | None:
    """Return the peak memory usage of this process in MiB; None if the system does not report
    it.
    """
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))


Files = Iterator[tuple[str, Content]]  # names and contents, each computed on demand


class UnfinishedError(ValueError):
    """A folder does not contain a complete set of results."""


UNUSABLE = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""The errors raised for a report that cannot be used, for example because it was edited."""


def write_estimate(
    report: dict[str, Any], folder: Path, files: Iterable[tuple[str, Content]], clock: Clock
) -> dict[str, Any]:
    """Write the results of a capture to `folder` and return the finished report.

    `report` comes from report_of. The files, whose names are in own_files() and FOUND_LIGHTS,
    replace the files of an earlier run (see new_files). The caller must have locked the folder.
    Writing is the clock's last stage. Raises OutputError if a file cannot be written.
    """
    # The user may have edited the mask of an earlier run and passed it to this run, so it is kept.
    stale = {*output_files.own_files(), *own_light_files(folder)} - {output_files.FOUND_MASK}
    with new_files(folder, report=REPORT, stale=stale) as new:
        for name, content in files:
            new.write(name, content)
            del content  # before the next one is computed
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
    """Return which FOUND_LIGHTS were written to a folder by an earlier run, according to its
    report.
    """
    try:
        return [name for name in output_files.FOUND_LIGHTS if name in read_report(folder)["files"]]
    except UNUSABLE:
        return []


def read_report(folder: Path) -> dict[str, Any]:
    """Return the report in a folder of results if the listed files exist. Links are not followed.

    The rest of the report is not checked.

    Raises:
        UnfinishedError: the report or a file is missing, or a file has another size.
        UNUSABLE: the report cannot be used.
    """
    if not is_plain(folder / REPORT):
        raise UnfinishedError(f"has no {REPORT}")
    report: dict[str, Any] = read_json(folder / REPORT)
    files, sizes = report["files"], report.get("file_sizes", {})  # not in earlier versions
    convert((files, sizes), tuple[list[str], dict[str, Any]])  # raises ValueError
    # Users may edit the mask, and `integrate` may have replaced the surface.
    surface_files = file_names(tuple(SURFACE_FILES)) if is_plain(folder / SURFACE_REPORT) else ()
    changeable = (output_files.FOUND_MASK, *surface_files)
    for name in files:
        path = folder / name
        if name in changeable:
            continue
        if path.parent != folder or not is_plain(path):
            raise UnfinishedError(f"contains earlier results, but {name} is missing")
        if name in sizes and path.stat().st_size != sizes[name]:
            raise UnfinishedError(
                f"contains earlier results, but the size of {name} differs from {REPORT}"
            )
    return report


def normal_files(estimate: NormalEstimate, formats: Sequence[str], convention: Convention) -> Files:
    """Yield the normal map in these formats (keys of NORMALS), and the error map if it is known."""
    for form in formats:
        yield output_files.NORMALS[form], encode_normals(estimate, form, convention)
    if estimate.error_map_deg is not None:
        yield output_files.ERROR_MAP, encode_png(error_map_picture(estimate.error_map_deg))


def encode_normals(estimate: NormalEstimate, form: str, convention: Convention) -> Content:
    """Return the file of the normal map: a PNG picture, or float32 NPY, TIFF or EXR.

    The picture has 16 or 8 bits. EXR files have the same colours as the pictures, (n + 1) / 2 and
    black outside the mask, because renderers expect them.
    """
    if form in ("png", "png8"):
        picture = encode_picture(
            estimate.normal_map,
            estimate.capture.mask,
            bits=8 if form == "png8" else 16,
            convention=convention,
        )
        return encode_png(picture, {"normals": describe(convention)})
    if form == "npy":
        return estimate.normal_map
    if form == "exr":
        signs = np.array((1, 1 if convention == "opengl" else -1, 1), np.float32)
        colours = (estimate.normal_map * signs + 1) / 2 * estimate.capture.mask[..., None]
        return encode_exr(colours, {"normals": f"(n + 1) / 2; {describe(convention)}"})
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(
        file, estimate.normal_map, photometric="rgb", description=f"normals: {describe('opengl')}"
    )
    return file.getvalue()


def light_files(capture: Capture, plot: bytes) -> Files:
    """Yield the lights estimated from the images, in the format of `--lights`, and their plot."""
    yield output_files.FOUND_DIRECTIONS, rows_text(capture.light_directions)
    if (intensities := capture.estimated_intensities) is not None:
        text = rows_text(np.repeat(intensities[:, None], 3, axis=1))
        yield output_files.FOUND_INTENSITIES, text
    yield output_files.LIGHT_PLOT, plot
