"""What `infer` does with each capture: read, estimate, make what else was asked for, write."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.cli.talk import Talk
from splinecli.errors import UsageError

if TYPE_CHECKING:
    from splinecli.capture import Capture, CaptureSource, RadiometricCalibration
    from splinecli.inference import NormalEstimate
    from splinecli.methods import Estimator, MethodOptions
    from splinecli.normals import Convention


@dataclass(frozen=True)
class Job:
    """What the command line asked for, the same for every capture."""

    radiometry: RadiometricCalibration
    files: dict[str, Path | None]
    output: Path
    formats: list[str]
    maps: list[str]
    auto_mask: bool
    surface: bool
    html: bool
    asked: dict[str, Any]
    convention: Convention
    n_lights: int | None
    seed: int
    light_indices: list[int] | None
    method: str
    options: MethodOptions
    talk: Talk

    @cached_property
    def estimator(self) -> Estimator:
        """Made when the first capture has turned out to be one: loading a network takes a second."""
        from splinecli.methods import make_estimator
        from splinecli.methods.estimator import tells_confidence

        estimator = make_estimator(self.method, self.options)
        if self.options.weights is not None and estimator.weights is None:
            raise UsageError(f"method {self.method} uses no weights", hint="Leave --weights out")
        if "confidence" in self.maps and not tells_confidence(estimator):
            raise UsageError(
                f"method {self.method} does not tell how sure it is", hint="Leave confidence out of --maps"
            )
        return estimator

    def read(self, folder: Path) -> tuple[CaptureSource, Capture, float]:
        """The capture under the lights asked for, whence it comes, and the seconds that it took."""
        from splinecli.capture import open_capture

        started = time.perf_counter()
        source = open_capture(folder, radiometry=self.radiometry, **self.files)
        if self.auto_mask:
            with self.talk.progress(f"{source.files.name}: finding the object", source.n_lights) as advance:
                source = source.find_mask(lambda: advance(1))
        chosen = self._choose_lights(source)
        count = source.n_lights if chosen is None else len(chosen)
        with self.talk.progress(f"{source.files.name}: reading", count) as advance:
            capture = source.read(chosen, progress=lambda: advance(1))
        return source, capture, time.perf_counter() - started

    def estimate(self, source: CaptureSource, capture: Capture, read_seconds: float) -> dict[str, Any]:
        """Estimate and write the normals; returns the report."""
        from splinecli.inference import estimate_normals
        from splinecli.results.files import report_of, write_estimate

        estimator = self.estimator
        with self.talk.progress(f"{capture.name}: estimating", capture.n_pixels) as advance:
            estimate = estimate_normals(capture, estimator, progress=advance)
        warnings = [*capture.warnings]
        if estimator.weights is not None:
            from splinecli.networks.weights import untrained_warning

            warnings += untrained_warning(estimator.weights["sha256"], capture.n_lights)
        for warning in warnings:
            self.talk.warn(f"{capture.name}: {warning}")
        inputs = inputs_sha256(source, self.options.weights)
        report = report_of(
            estimate, estimator, self.asked, inputs, read_seconds=read_seconds, warnings=warnings
        )
        return write_estimate(
            estimate,
            report,
            self.output / capture.name,
            formats=self.formats,
            convention=self.convention,
            more=self._make_more(source, estimate, report),
        )

    def _make_more(
        self, source: CaptureSource, estimate: NormalEstimate, report: dict[str, Any]
    ) -> list[Callable[[Path], None]]:
        """What else was asked for, made and ready to be written."""
        from splinecli.results.files import (
            albedo_picture,
            write_albedo,
            write_confidence,
            write_mask,
            write_preview,
        )

        capture = estimate.capture
        more: list[Callable[[Path], None]] = []
        albedo = colours = None
        if "albedo" in self.maps or self.html:
            from splinecli.results.albedo import albedo_map

            with self.talk.progress(f"{capture.name}: albedo", capture.n_lights) as advance:
                albedo = albedo_map(source, capture, estimate.normal_map, progress=lambda: advance(1))
            colours = albedo_picture(albedo, capture.mask)
            if "albedo" in self.maps:
                more.append(partial(write_albedo, albedo, capture.mask))
        if "confidence" in self.maps and estimate.confidence_map is not None:
            more.append(partial(write_confidence, estimate.confidence_map))
        if "preview" in self.maps:
            more.append(partial(write_preview, estimate))
        if source.found_mask is not None:
            more.append(partial(write_mask, capture.mask))
        if self.surface:
            from splinecli.surface.integration import integrate_normals
            from splinecli.surface.mesh import surface_mesh
            from splinecli.surface.surface_files import write_surface

            with self.talk.progress(f"{capture.name}: integrating", 1) as advance:
                depth = integrate_normals(estimate.normal_map, capture.mask)
                advance(1)
            mesh = surface_mesh(depth, capture.mask, colours=colours)
            more.append(partial(write_surface, depth=depth, mesh=mesh))
        if self.html:
            from splinecli.files import write_text
            from splinecli.results.files import PAGE
            from splinecli.results.page import result_page

            page = result_page(
                report,
                estimate.normal_map,
                capture.mask,
                albedo=albedo,
                confidence_map=estimate.confidence_map,
                error_map_deg=estimate.error_map_deg,
            )
            more.append(lambda folder: write_text(folder / PAGE, page))
        return more

    def _choose_lights(self, source: CaptureSource) -> Sequence[int] | None:
        if self.n_lights is None:
            return self.light_indices
        from splinecli.capture.lights.draws import draw_lights

        return draw_lights(source.light_directions, self.n_lights, trials=1, seed=self.seed)[0]


def inputs_sha256(source: CaptureSource, weights: str | None) -> str:
    """Changes when any file that is read for the capture does."""
    import hashlib

    from splinecli.evaluation.trials import place_size_and_time, stamp_files
    from splinecli.files import file_sha256

    flats = [place_size_and_time(path) for path in source.radiometry.flat_field]
    own_weights = weights if weights is None or not Path(weights).is_file() else file_sha256(Path(weights))
    stamps = [*stamp_files(source.files), flats, own_weights]
    return hashlib.sha256(json.dumps(stamps).encode()).hexdigest()
