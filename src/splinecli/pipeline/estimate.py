"""From a capture to its normals, with all checks and warnings: for `infer` and for splinecli.estimate_normals.

A distilled estimator replaces a network on large captures, or where the user asks for it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from splinecli.capture import Capture
from splinecli.capture_warnings import NOT_DISTILLED, PROBABLY_WRONG, ROUGH_LIGHTS, UNTRAINED_LIGHTS, CaptureWarning
from splinecli.diagnosis.checks import check_confidence, refuse_if_strict
from splinecli.errors import UsageError
from splinecli.inference import NormalEstimate, estimate_normals, light_on
from splinecli.methods import Estimator
from splinecli.methods.estimator import for_capture, tells_confidence
from splinecli.methods.near_light import find_surface
from splinecli.methods.student_size import FEWEST_PIXELS, student_sizes
from splinecli.system.progress import SILENT, Advance, Clock, Observer

if TYPE_CHECKING:
    from splinecli.methods.distilled import DistilledEstimator

AUTOMATIC_FROM = 100_000
"""Pixels from which a capture is distilled by default.

Fixed, not timed: the load of a machine must not change normals. From this size on, distillation takes less than half of
the network's time on 1 to 16 cores and on an H100, under 10 and 96 lights.
"""


def distil_for(
    capture: Capture, estimator: Estimator, wanted: bool | None, observer: Observer = SILENT
) -> tuple[DistilledEstimator | None, list[CaptureWarning]]:
    """Return a distilled estimator for a capture, or None to use `estimator` on every pixel; and warnings.

    A capture under near lamps has the points of its surface. `wanted` is None for AUTOMATIC_FROM. Raises UsageError if
    it is wanted, but the method gives no confidence, or the capture is too small.
    """
    if wanted is False or (wanted is None and capture.n_pixels < AUTOMATIC_FROM):
        return None, []
    if not tells_confidence(estimator):
        return _refuse(wanted, f"method {estimator.name} gives no confidence and cannot be distilled")
    sizes = student_sizes(capture.n_pixels)
    if sizes[0].sample < FEWEST_PIXELS:
        return _refuse(wanted, f"{capture.name}: {capture.n_pixels} pixels are too few to distil")
    light_of = partial(light_on, capture)
    teacher = for_capture(estimator, light_of, capture.n_pixels)
    from splinecli.methods.distilled import distil

    for size in sizes:
        try:
            with observer.progress(f"{capture.name}: learning", 2 * size.sample, unit="pixels") as advance:
                distilled = distil(teacher, light_of, capture.n_pixels, size, progress=advance)
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


_STAGES = {"removing indirect light": "indirect_light", "refining": "refine"}  # as the clock calls them


def estimate_capture(
    capture: Capture,
    estimator: Estimator,
    check: Callable[[Capture], list[CaptureWarning]],
    *,
    refine_lights: Callable[[Capture], Capture] | None = None,
    distil: bool | None = None,
    strict: bool = False,
    observer: Observer = SILENT,
    progress: Callable[[int], object] | None = None,
    clock: Clock | None = None,
) -> tuple[NormalEstimate, DistilledEstimator | None]:
    """Return the normals of a capture, which then has all warnings, and the distilled estimator if there was one.

    The capture has the warnings from reading it. `check` returns those about its lights and images
    (diagnosis/checks.py), and `refine_lights` the capture with refined lights. `distil` is as in distil_for. `progress`
    is called with the number of pixels that were just estimated, in place of the observer. With `strict`, a warning
    that an input is probably wrong is an InputError. The observer is shown the stages, the clock measures them.
    """
    clock = clock or Clock()
    clock.begin("check")
    warnings = [*capture.warnings, *check(capture)]
    refuse_if_strict(warnings, capture.name, strict=strict)
    if refine_lights is not None:
        before = len(capture.warnings)
        capture = refine_lights(capture)
        warnings = [warning for warning in warnings if warning.code != ROUGH_LIGHTS]
        warnings += capture.warnings[before:]
    capture = replace(capture, warnings=tuple(warnings))
    clock.begin("estimate")
    capture = find_surface(capture)
    clock.begin("distil")
    distilled, found = distil_for(capture, estimator, distil, observer)
    with ExitStack() as stages:

        def stage(name: str) -> AbstractContextManager[Advance]:
            stages.close()  # one bar at a time
            clock.begin(_STAGES.get(name, "estimate"))
            return observer.progress(f"{capture.name}: {name}", capture.n_pixels, unit="pixels")

        advance = stages.enter_context(stage("estimating"))
        estimate = estimate_normals(capture, distilled or estimator, progress=progress or advance, stage=stage)
    if estimator.weights is not None:
        from splinecli.networks.weights import untrained_warning

        texts = untrained_warning(estimator.weights["sha256"], capture.n_lights)
        found = [*found, *(CaptureWarning(UNTRAINED_LIGHTS, text) for text in texts)]
    warnings += found
    # Others of these say why the confidence is low.
    if not any(warning.error_deg and warning.code in PROBABLY_WRONG for warning in warnings):
        warnings += check_confidence(estimate.expected_under_5)
    refuse_if_strict(warnings, capture.name, strict=strict)
    return replace(estimate, capture=replace(estimate.capture, warnings=tuple(warnings))), distilled
