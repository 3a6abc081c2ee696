"""Replace a network by a distilled estimator where that is faster, or where the user asks for it."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.capture_warnings import NOT_DISTILLED, CaptureWarning
from splinecli.errors import UsageError
from splinecli.inference import light_on
from splinecli.methods import Estimator
from splinecli.methods.estimator import ConfidentEstimator, tells_confidence
from splinecli.methods.student_size import FEWEST_PIXELS, StudentSize, student_sizes
from splinecli.pipeline.observer import SILENT, Observer
from splinecli.system.devices import count_available_cores

if TYPE_CHECKING:
    from splinecli.methods.distilled import DistilledEstimator

AUTOMATIC_FROM = 100_000  # pixels: smaller captures are distilled only where the user asks for it
GAIN = 2.0  # above that size, learning must be this many times as fast as the network; a GPU may not need it


def distil_for(
    capture: Capture, estimator: Estimator, wanted: bool | None, observer: Observer = SILENT
) -> tuple[DistilledEstimator | None, list[CaptureWarning]]:
    """Return a distilled estimator for a capture, or None to use `estimator` on every pixel; and warnings.

    Raises UsageError if it is wanted, but the method gives no confidence, or the capture is too small.

    Args:
        capture: under near lamps, with the points of its surface.
        wanted: whether to distil; None for the faster way.
    """
    if wanted is False or (wanted is None and capture.n_pixels < AUTOMATIC_FROM):
        return None, []
    if not tells_confidence(estimator):
        return _refuse(wanted, f"method {estimator.name} gives no confidence and cannot be distilled")
    sizes = student_sizes(capture.n_pixels)
    if sizes[0].sample < FEWEST_PIXELS:
        return _refuse(wanted, f"{capture.name}: {capture.n_pixels} pixels are too few to distil")
    if wanted is None and not _is_faster(capture, estimator, sizes[0]):
        return None, []
    from splinecli.methods.distilled import distil

    for size in sizes:
        try:
            with observer.progress(f"{capture.name}: learning", 2 * size.sample, unit="pixels") as advance:
                distilled = distil(estimator, partial(light_on, capture), capture.n_pixels, size, progress=advance)
        except UsageError as error:  # most pixels are a dark background
            return _refuse(wanted, f"{capture.name}: {error.problem}")
        if distilled.distillation.is_good:
            return distilled, []
    text = (
        f"The network estimated every pixel. A small one learned from a sample, but was"
        f" {distilled.distillation.mean_deg:.1f} degrees away from it, where it expects errors of"
        f" {distilled.distillation.expected_deg:.1f} degrees."
    )
    return None, [CaptureWarning(NOT_DISTILLED, text)]


def _refuse(wanted: bool | None, problem: str) -> tuple[None, list[CaptureWarning]]:
    if wanted:
        raise UsageError(problem, hint="Leave --distil out")
    return None, []


def _is_faster(capture: Capture, estimator: ConfidentEstimator, size: StudentSize) -> bool:
    """Measure whether learning takes at most a GAIN-th of the time of the network on every pixel."""
    from splinecli.methods.distilled import seconds_of_learning

    count = max(1024, 256 * count_available_cores())  # a batch for each core
    light = light_on(capture, np.linspace(0, capture.n_pixels - 1, count).astype(np.intp))
    for _ in range(2):  # the first time, a GPU also loads its kernels
        started = time.perf_counter()
        estimator.estimate(light.observations, light.directions)
        per_pixel = (time.perf_counter() - started) / len(light.observations)
    learning = size.sample * per_pixel + seconds_of_learning(light.directions, size, estimator.device)
    return GAIN * learning < capture.n_pixels * per_pixel
