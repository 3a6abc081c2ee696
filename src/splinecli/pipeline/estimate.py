"""From a capture to its normals, with all checks and warnings: for `infer` and for splinecli.estimate_normals."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from splinecli.capture import Capture
from splinecli.capture.capture_warnings import ROUGH_LIGHTS, UNTRAINED_LIGHTS, CaptureWarning
from splinecli.diagnosis.checks import check_confidence, refuse_if_strict
from splinecli.inference import NormalEstimate, estimate_normals
from splinecli.methods import Estimator
from splinecli.methods.near_light import find_surface
from splinecli.pipeline.distillation import distil_for
from splinecli.pipeline.observer import SILENT, Advance, Observer
from splinecli.results.clock import Clock

if TYPE_CHECKING:
    from splinecli.methods.distilled import DistilledEstimator

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

    Args:
        capture: with the warnings from reading it.
        estimator: the method.
        check: returns the warnings about the capture's lights and images; see diagnosis/checks.py.
        refine_lights: returns the capture with refined lights.
        distil: see distil_for.
        strict: raise InputError where a warning says that an input is probably wrong.
        observer: receives the progress.
        progress: called with the number of pixels that were just estimated, in place of the observer.
        clock: is told of the stages.
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
    warnings += [*found, *_untrained_lights(estimator, capture), *check_confidence(estimate.expected_under_5)]
    refuse_if_strict(warnings, capture.name, strict=strict)
    return replace(estimate, capture=replace(estimate.capture, warnings=tuple(warnings))), distilled


def _untrained_lights(estimator: Estimator, capture: Capture) -> list[CaptureWarning]:
    if estimator.weights is None:
        return []
    from splinecli.networks.weights import untrained_warning

    warnings = untrained_warning(estimator.weights["sha256"], capture.n_lights)
    return [CaptureWarning(UNTRAINED_LIGHTS, text) for text in warnings]
