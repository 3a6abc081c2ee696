"""The report that `infer` writes for a capture, report.json, and the clock of its stages."""

import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.capture.record import name_reading
from splinecli.inference import NormalEstimate
from splinecli.methods import Estimator

SCHEMA = 2  # rises when a field of the report changes its meaning


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
    return {
        "schema": SCHEMA,
        "capture": capture.name,
        "method": estimator.name,
        "weights": estimator.weights,
        "n_lights": capture.n_lights,
        "light_indices": list(capture.light_indices),
        "light_file": None if light_file is None else str(light_file.absolute()),
        "light_directions": capture.light_directions.round(6).tolist(),
        "light_errors_deg": None if capture.light_errors_deg is None else capture.light_errors_deg.round(2).tolist(),
        "near_lamps": None if capture.lamps is None else capture.lamps.as_dict(),
        "estimated_intensities": None if intensities is None else intensities.round(4).tolist(),
        "n_pixels": capture.n_pixels,
        "image_size": [width, height],
        "device": estimator.device,
        "precision": estimator.precision,
        "distillation": distillation,
        "peak_memory_mib": peak_memory_mib(),
        "warnings": [{"code": warning.code, "text": warning.text} for warning in capture.warnings],
        "angular_error_deg": None
        if errors is None
        else {name: round(value, 4) for name, value in asdict(errors).items()},
        "expected_under_5": None if expected is None else round(expected, 4),
        "capture_judged": None if expected is None else estimate.capture_judged,
        "options": options,
        "inputs_sha256": inputs,
        "version": __version__,
        "reading": name_reading(as_stored=options["as_stored"]),
        "white_level": None if capture.white_level is None else asdict(capture.white_level),
        "surface": None,
    }


def peak_memory_mib() -> int | None:
    """Return the largest memory that this process has used in MiB, or None if the system does not report it."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))
