"""What `infer` writes for a capture: the normal map's files, the error map and the report, whole or not at all."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli import __version__
from splinecli.errors import OutputError
from splinecli.files import current_umask, refusals_as_output_errors
from splinecli.inference import NormalEstimate
from splinecli.methods import Estimator
from splinecli.normals import Convention, encode_picture
from splinecli.surface.surface_files import SURFACE_FILES, SURFACE_REPORT
from splinecli.transfer import encode_srgb

NORMALS = {"png": "normals.png", "png8": "normals_8bit.png", "npy": "normals.npy", "tiff": "normals.tiff"}
ERROR_MAP = "error_map.png"
REPORT, PAGE, FOUND_MASK = "report.json", "page.html", "found_mask.png"
ALBEDO_PICTURE, ALBEDO, PREVIEW = "albedo.png", "albedo.npy", "preview.png"
CONFIDENCE_PICTURE, CONFIDENCE = "confidence.png", "confidence.npy"
MAPS = {
    "albedo": (ALBEDO_PICTURE, ALBEDO),
    "confidence": (CONFIDENCE_PICTURE, CONFIDENCE),
    "preview": (PREVIEW,),
}
"""The files of each map that is written where it is asked for."""
OWN_FILES = (
    *NORMALS.values(),
    ERROR_MAP,
    *(name for names in MAPS.values() for name in names),
    *SURFACE_FILES.values(),
    SURFACE_REPORT,
    FOUND_MASK,
    PAGE,
    REPORT,
)

RAKING_LIGHT = (-0.72, 0.48, 0.5)
"""Of the preview: low, from the upper left, as relief is looked at."""


def finished_report(
    folder: Path, options: dict[str, Any], inputs: Callable[[], str]
) -> dict[str, Any] | None:
    """The report in the folder; None unless this version made it, of these inputs, as asked for, and all is there."""
    try:
        report = json.loads((folder / REPORT).read_text("utf-8"))
        whole = all((folder / name).is_file() for name in report["files"])
        same = (report["options"], report["version"]) == (json.loads(json.dumps(options)), __version__)
        # Last, for it reads the capture's small files.
        same = same and whole and report["inputs_sha256"] == inputs()
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return report if same else None


def report_of(
    estimate: NormalEstimate,
    estimator: Estimator,
    options: dict[str, Any],
    inputs: str,
    *,
    read_seconds: float,
    warnings: Sequence[str],
) -> dict[str, Any]:
    """The report of the contract (docs/infer.md), all but `seconds.write` and `files`.

    Args:
        options: what was asked for.
        inputs: SHA-256 over what tells that the files read are the same.
    """
    capture, expected = estimate.capture, estimate.expected_under_5
    return {
        "capture": capture.name,
        "method": estimator.name,
        "weights": estimator.weights,
        "n_lights": capture.n_lights,
        "light_indices": list(capture.light_indices),
        "estimated_intensities": None
        if capture.estimated_intensities is None
        else capture.estimated_intensities.round(4).tolist(),
        "n_pixels": capture.n_pixels,
        "image_size": [capture.mask.shape[1], capture.mask.shape[0]],
        "device": estimator.device,
        "precision": estimator.precision,
        "seconds": {"read": round(read_seconds, 3), "estimate": round(estimate.seconds, 3)},
        "peak_memory_mib": peak_memory_mib(),
        "warnings": list(warnings),
        "angular_error_deg": None
        if estimate.errors is None
        else {name: round(value, 4) for name, value in asdict(estimate.errors).items()},
        "expected_under_5": None if expected is None else round(expected, 4),
        "options": options,
        "inputs_sha256": inputs,
        "version": __version__,
    }


def write_estimate(
    estimate: NormalEstimate,
    report: dict[str, Any],
    folder: Path,
    *,
    formats: Sequence[str],
    convention: Convention,
    more: Sequence[Callable[[Path], None]] = (),
) -> dict[str, Any]:
    """Write the files into `folder`, replacing those of an earlier run there; returns the finished report.

    Args:
        formats: keys of NORMALS.
        more: what writes further ones of OWN_FILES into a folder, such as write_albedo.

    Everything is written into a folder beside it first, so that a failure or Ctrl-C leaves nothing half-done.
    Raises OutputError.
    """
    started = time.perf_counter()
    with refusals_as_output_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            for form in formats:
                write_normals(estimate, form, stage / NORMALS[form], convention)
            if estimate.error_map_deg is not None:
                from splinecli.pictures.error_map import error_map_picture

                (stage / ERROR_MAP).write_bytes(encode_png(error_map_picture(estimate.error_map_deg)))
            for write in more:
                write(stage)
            files = [*(path.name for path in sorted(stage.iterdir())), REPORT]
            seconds = {**report["seconds"], "write": round(time.perf_counter() - started, 3)}
            report = {**report, "seconds": seconds, "files": files}
            (stage / REPORT).write_text(json.dumps(report, indent=2) + "\n", "utf-8")
            _publish(stage, folder)
        finally:
            # Also on Ctrl-C: nothing half-written stays behind.
            shutil.rmtree(stage, ignore_errors=True)
    return report


def write_normals(estimate: NormalEstimate, form: str, path: Path, convention: Convention) -> None:
    """The normal map as a 16-bit or 8-bit PNG picture, or as float32 NPY or TIFF."""
    if form in ("png", "png8"):
        bits = 8 if form == "png8" else 16
        picture = encode_picture(estimate.normal_map, estimate.capture.mask, bits=bits, convention=convention)
        path.write_bytes(encode_png(picture))
    elif form == "npy":
        np.save(path, estimate.normal_map, allow_pickle=False)
    else:
        import tifffile

        tifffile.imwrite(path, estimate.normal_map, photometric="rgb")


def write_albedo(albedo: NDArray[np.float32], mask: NDArray[np.bool_], folder: Path) -> None:
    """An albedo map (H, W, 3), linear, as float32 NPY and as a picture."""
    np.save(folder / ALBEDO, albedo, allow_pickle=False)
    (folder / ALBEDO_PICTURE).write_bytes(encode_png(albedo_picture(albedo, mask)))


def write_confidence(confidence_map: NDArray[np.float32], folder: Path) -> None:
    """A confidence map (H, W) as float32 NPY and as a gray picture, 1 white."""
    np.save(folder / CONFIDENCE, confidence_map, allow_pickle=False)
    (folder / CONFIDENCE_PICTURE).write_bytes(encode_png(confidence_picture(confidence_map)))


def write_mask(mask: NDArray[np.bool_], folder: Path) -> None:
    """A mask (H, W) as a black and white picture."""
    (folder / FOUND_MASK).write_bytes(encode_png(mask * np.uint8(255)))


def write_preview(estimate: NormalEstimate, folder: Path) -> None:
    """The shaded picture."""
    picture = preview_picture(estimate.normal_map, estimate.capture.mask)
    (folder / PREVIEW).write_bytes(encode_png(picture))


def albedo_picture(albedo: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """An albedo map (H, W, 3) as an 8-bit sRGB picture; white is the brightest hundredth of the mask (H, W)."""
    white = max(float(np.quantile(albedo[mask].max(axis=1), 0.99)), 1e-12)
    return encode_srgb(albedo / white)


def confidence_picture(confidence_map: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A confidence map (H, W) as an 8-bit gray picture (H, W): the share of white is the probability."""
    return np.rint(255 * confidence_map).astype(np.uint8)


def preview_picture(normal_map: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The surface, matte white under RAKING_LIGHT, as an 8-bit sRGB picture; black outside the mask (H, W)."""
    light = np.array(RAKING_LIGHT, np.float32)
    shading = (normal_map @ (light / np.linalg.norm(light))) * mask
    return np.repeat(encode_srgb(shading)[..., None], 3, axis=2)


def encode_png(picture: NDArray[np.unsignedinteger]) -> bytes:
    """PNG of an RGB (H, W, 3) or gray (H, W) picture, 8 or 16 bits."""
    import cv2

    done, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not done:
        raise OutputError("the picture could not be encoded as PNG")
    return encoded.tobytes()


def peak_memory_mib() -> int | None:
    """Largest memory of this process so far in MiB; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))


def _publish(stage: Path, folder: Path) -> None:
    """Move the finished files to their place; where that fails, those of an earlier run come back."""
    if not folder.exists():
        stage.chmod(0o777 & ~current_umask())
        stage.rename(folder)
        return
    new = [path.name for path in stage.iterdir()]
    earlier = stage / "earlier"
    earlier.mkdir()
    try:
        for name in OWN_FILES:
            # A mask that was found before may have been mended since, and be what this run has read.
            if (folder / name).exists() and (name != FOUND_MASK or name in new):
                (folder / name).replace(earlier / name)
        for name in new:
            (stage / name).replace(folder / name)
    except BaseException:
        for name in new:
            if not (stage / name).exists():
                (folder / name).unlink()
        for path in earlier.iterdir():
            path.replace(folder / path.name)
        raise
