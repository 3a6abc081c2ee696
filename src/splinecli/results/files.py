"""What `infer` leaves for a capture: its albedo, its report, and the files of its maps, of which all are written or
none."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import convert
from numpy.typing import NDArray

from splinecli import __version__
from splinecli.capture import Capture, CaptureSource
from splinecli.capture.files import (
    ALBEDO,
    ALBEDO_EXR,
    ALBEDO_PICTURE,
    CONFIDENCE,
    CONFIDENCE_PICTURE,
    CURVATURE,
    CURVATURE_PICTURE,
    CURVATURE_TIFF,
    ERROR_MAP,
    FOUND_DIRECTIONS,
    FOUND_INTENSITIES,
    FOUND_LIGHTS,
    FOUND_MASK,
    GRADIENT,
    GRADIENT_TIFF,
    LIGHT_PLOT,
    NORMALS,
    OWN_FILES,
    PREVIEW,
    RELIEF,
    RELIEF_PICTURE,
    RELIEF_TIFF,
    REPORT,
)
from splinecli.capture.light_files import rows_text
from splinecli.capture.linearise import StoredPixels, take_pixels
from splinecli.capture.record import name_reading
from splinecli.documents import Distillation, EstimateReport, NearLampsReport, UsedWeights, WarningReport
from splinecli.maths.normals import (
    AngularErrors,
    Convention,
    curvature_of_normals,
    describe,
    encode_picture,
    gradient_of_normals,
)
from splinecli.pictures.maps import (
    albedo_picture,
    confidence_picture,
    encode_png,
    error_map_picture,
    preview_picture,
    signed_picture,
)
from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT, encode_exr, encode_tiff, file_names
from splinecli.system.files import read_json
from splinecli.system.publishing import Content, is_plain, new_files

if TYPE_CHECKING:
    from splinecli.inference import NormalEstimate
    from splinecli.methods import Estimator
    from splinecli.system.progress import Clock


LIT = 0.15  # a light counts for a pixel if n.l is above this
AGREEING = 0.3  # an observation counts within this share of the median albedo: no highlights, no cast shadows
RESTORED_WEIGHT = 1e-3  # of a restored observation, whose colour is saturated: the others decide
_TILE_PIXELS = 65_536


def albedo_map(
    source: CaptureSource,
    capture: Capture,
    normal_map: NDArray[np.float32],
    progress: Callable[[], object] = lambda: None,
) -> NDArray[np.float32]:
    """Return the linear RGB diffuse albedo (H, W, 3), zero outside the mask and where no light reaches.

    A pixel's albedo is the least-squares solution of Lambert's law, I = albedo * n.l, over the lights that agree with
    the pixel's median of I / (n.l). Its scale is that of the images divided by the light intensities, so it is known up
    to one factor for the whole capture unless the intensities are absolute.

    The images of the source are read again, one at a time, for their colours; `progress` is called after each. The
    capture is what the source read; under near lamps, with the points of its surface. The normal map (H, W, 3) is unit
    in its mask. Raises InputError if an image can no longer be read.
    """
    normals = take_pixels(normal_map, capture.mask)
    counts = np.empty(capture.observations.shape, np.bool_)
    for start in range(0, len(normals), _TILE_PIXELS):
        tile = slice(start, start + _TILE_PIXELS)
        cosines, strengths = _shading(capture, normals, tile, range(capture.n_lights))
        counts[tile] = _agreeing(capture.observations[tile] / strengths, cosines)
    total, squares = np.zeros((len(normals), 3), np.float32), np.zeros(len(normals), np.float32)
    images = source.read_pixels(capture.mask, capture.light_indices, StoredPixels.colours, progress)
    for position, colours in enumerate(images):
        cosines, strengths = _shading(capture, normals, slice(None), [position])
        cosine = cosines[:, 0] * counts[:, position]
        colours /= strengths
        if capture.estimated_colours is not None:
            colours /= capture.estimated_colours[position].astype(np.float32)
        if capture.estimated_intensities is not None:
            colours /= np.float32(capture.estimated_intensities[position])
        weight = cosine
        if capture.restored is not None:
            weight = cosine * np.where(capture.restored[:, position], np.float32(RESTORED_WEIGHT), np.float32(1))
        colours *= weight[:, None]  # in place, because large captures need the memory
        total += colours
        squares += weight * cosine
        del colours
    albedo = np.zeros((*capture.mask.shape, 3), np.float32)
    albedo[capture.mask] = np.divide(total, squares[:, None], out=total, where=squares[:, None] > 0)
    return albedo


def _shading(
    capture: Capture, normals: NDArray[np.float32], rows: slice, positions: Sequence[int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return n.l (p, K) of some pixels under K lights, and the strengths of these: (p, K), or (1, 1) if distant."""
    if capture.lamps is None:
        lights = capture.light_directions[list(positions)].astype(np.float32)
        return normals[rows] @ lights.T, np.ones((1, 1), np.float32)
    assert capture.lamps.points is not None
    directions, strengths = capture.lamps.choose_lights(positions).light_at(capture.lamps.points[rows])
    return np.einsum("pfc,pc->pf", directions, normals[rows]), strengths


def _agreeing(observations: NDArray[np.float32], cosine: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which observations (P, F) are lit and neither highlights nor in cast shadow; `cosine` (P, F) is n.l."""
    lit = cosine > LIT
    albedo = np.divide(observations, cosine, out=np.full_like(observations, np.inf), where=lit)
    # The median of the lit observations, which sorting moves to the front.
    ordered, number = np.sort(albedo, axis=1), lit.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum((number - 1) // 2, 0)[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        close: NDArray[np.bool_] = lit & (np.abs(albedo - middle) <= AGREEING * middle)
    return close


def report_of(
    estimate: NormalEstimate,
    estimator: Estimator,
    options: Mapping[str, Any],
    inputs: str,
    *,
    light_file: Path | None,
    distillation: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the report of an estimate (docs/infer.md), without the surface.

    write_estimate adds `seconds`, `folder` and `files`. The options are those of `infer`, ready for JSON. `inputs` is a
    digest that changes when an input file changes. `light_file` is None where the lights were found from the images,
    and `distillation`, what DistilledEstimator.report returns, where the method estimated every pixel.
    """
    capture = estimate.capture
    intensities, errors, expected = capture.estimated_intensities, estimate.errors, estimate.expected_under_5
    height, width = capture.mask.shape
    return EstimateReport(
        schema=3,
        capture=capture.name,
        method=estimator.name,
        weights=None if estimator.weights is None else UsedWeights(**estimator.weights),
        n_lights=capture.n_lights,
        light_indices=list(capture.light_indices),
        light_file=None if light_file is None else str(light_file.absolute()),
        light_directions=capture.light_directions.round(6).tolist(),
        light_errors_deg=None if capture.light_errors_deg is None else capture.light_errors_deg.round(2).tolist(),
        near_lamps=None if capture.lamps is None else NearLampsReport(**capture.lamps.as_dict()),
        camera_matrix=None if capture.camera_matrix is None else capture.camera_matrix.tolist(),
        estimated_intensities=None if intensities is None else intensities.round(4).tolist(),
        n_pixels=capture.n_pixels,
        image_size=(width, height),
        device=estimator.device,
        precision=estimator.precision,
        distillation=None if distillation is None else convert(distillation, Distillation),
        peak_memory_mib=peak_memory_mib(),
        warnings=[WarningReport(code=warning.code, text=warning.text) for warning in capture.warnings],
        angular_error_deg=None if errors is None else AngularErrors(*(round(value, 4) for value in astuple(errors))),
        expected_under_5=None if expected is None else round(expected, 4),
        capture_judged=None if expected is None else estimate.capture_judged,
        options=dict(options),
        inputs_sha256=inputs,
        version=__version__,
        reading=name_reading(as_stored=options["as_stored"]),
        white_level=capture.white_level,
        removed_blur=None if capture.removed_blur is None else round(capture.removed_blur, 2),
        surface=None,
    ).as_dict()


def peak_memory_mib() -> int | None:
    """Return the largest memory that this process has used in MiB, or None if the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))


Files = Iterator[tuple[str, Content]]  # names and contents, each made when it is asked for


class UnfinishedError(ValueError):
    """A folder has no whole set of results."""


def write_estimate(
    report: dict[str, Any], folder: Path, files: Iterable[tuple[str, Content]], clock: Clock
) -> dict[str, Any]:
    """Write the results of a capture into `folder` and return the finished report; `report` is that of report_of.

    The files, of OWN_FILES and FOUND_LIGHTS, replace those of an earlier run in the folder (see new_files), which the
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
    """Return those of FOUND_LIGHTS in a folder of results that an earlier run wrote, as its report says."""
    try:
        return [name for name in FOUND_LIGHTS if name in read_report(folder)["files"]]
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
    yield FOUND_DIRECTIONS, rows_text(capture.light_directions)
    if capture.estimated_intensities is not None:
        yield FOUND_INTENSITIES, rows_text(np.repeat(capture.estimated_intensities[:, None], 3, axis=1))
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
