"""`splinecli infer`: captures in, normal maps out."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.options import (
    AmbientOption,
    BatchSizeOption,
    Device,
    DeviceOption,
    FlatFieldOption,
    JsonOption,
    NormalConvention,
    Precision,
    PrecisionOption,
    QuietOption,
    RotationsOption,
    SeedOption,
    TransferOption,
    WeightsOption,
    parse_development,
    parse_indices,
    split_commas,
)
from splinecli.cli.talk import Talk
from splinecli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splinecli.capture import Capture, CaptureSource, Development
    from splinecli.inference import NormalEstimate
    from splinecli.methods import Estimator, MethodOptions


def infer(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURE", help="Folders of images of one object each.")
    ],
    lights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Light directions, a line x y z for each image (z to the camera)."),
    ] = None,
    intensities: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Light intensities, a line r g b for each image.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture that is bright on the object. [default: all]")
    ] = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="True normals (.mat, .npy, text, PNG, TIFF) to compare with."),
    ] = None,
    transfer: TransferOption = "linear",
    ambient: AmbientOption = None,
    flat_field: FlatFieldOption = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Results go to OUT/<capture name>/.")
    ] = Path("out"),
    method: Annotated[
        str,
        typer.Option(metavar="METHOD", help="spline-net, cnn-ps, ls, ls-trimmed, l1, iw12, st14 or ia14."),
    ] = "spline-net",
    weights: WeightsOption = None,
    n_lights: Annotated[
        int | None, typer.Option(metavar="K", help="Use K lights drawn at random. [default: all]")
    ] = None,
    seed: SeedOption = 0,
    light_indices: Annotated[
        str | None, typer.Option(metavar="I,J,...", help="Use these lights, counted from 0.")
    ] = None,
    rotations: RotationsOption = None,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    formats: Annotated[
        str, typer.Option("--format", metavar="LIST", help="Any of png (16-bit), npy, tiff (both float32).")
    ] = "png,npy",
    maps: Annotated[
        str | None, typer.Option(metavar="LIST", help="Also write any of albedo, preview (shaded picture).")
    ] = None,
    html: Annotated[
        bool, typer.Option("--html", help="Also write page.html: pictures and a view under a movable light.")
    ] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="Also write mesh.ply, depth.npy and depth.tiff: see integrate.")
    ] = False,
    convention: Annotated[
        NormalConvention, typer.Option(help="Green of the PNG: opengl is y up, directx is y down.")
    ] = NormalConvention.opengl,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace earlier results.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Estimate the normal map of each CAPTURE.

    A capture is a folder of images taken by a fixed camera under different lights, with a light file (in it, or given
    by --lights). Writes OUT/<name>/normals.png, normals.npy and report.json, and error_map.png where there is ground
    truth. A bad capture among several is named and passed over; the exit code is then 3. Those that were finished
    before with the same options are left as they are.
    """
    from splinecli.capture import capture_name
    from splinecli.capture.record import check_light_indices
    from splinecli.evaluation.draws import check_draw_settings
    from splinecli.files import check_free
    from splinecli.methods import MethodOptions, check_method
    from splinecli.outputs import MAPS, NORMALS, OWN_FILES, finished_report

    if n_lights is not None and light_indices is not None:
        raise UsageError("--n-lights and --light-indices exclude each other")
    check_method(method)
    indices = None if light_indices is None else parse_indices(light_indices, "--light-indices")
    if n_lights is not None:
        check_draw_settings(n_lights, 1, seed)
    if indices is not None:
        check_light_indices(indices, max(indices) + 1)
    development = parse_development(transfer, ambient, flat_field)
    _refuse_same_names(captures)
    options = {
        "method": method, "weights": weights, "rotations": rotations, "precision": precision.value,
        "n_lights": n_lights, "seed": seed if n_lights is not None else None, "light_indices": indices,
        "lights": lights, "intensities": intensities, "mask": mask, "ground_truth": ground_truth,
        "transfer": transfer, "ambient": ambient, "flat_field": flat_field,
        "formats": formats, "convention": convention.value, "maps": maps, "surface": surface, "html": html,
    }  # fmt: skip
    options = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
    files = {"lights": lights, "intensities": intensities, "mask": mask, "ground_truth": ground_truth}

    def inputs_of(folder: Path) -> str:
        from splinecli.capture import open_capture

        try:
            return _inputs_sha256(open_capture(folder, development=development, **files), weights)
        except InputError:
            return ""  # told when its turn comes

    finished = {}
    for folder in captures:
        target = output / capture_name(folder)
        report = (
            None
            if overwrite or len(captures) == 1
            else finished_report(target, options, partial(inputs_of, folder))
        )
        if report is None:
            check_free(target, OWN_FILES, overwrite=overwrite)
        else:
            finished[folder] = report
    job = _Job(
        development=development,
        files=files,
        output=output,
        formats=split_commas(formats, "--format", list(NORMALS)),
        surface=surface,
        html=html,
        asked=options,
        maps=[] if maps is None else split_commas(maps, "--maps", list(MAPS)),
        convention=convention.value,
        n_lights=n_lights,
        seed=seed,
        light_indices=indices,
        method=method,
        options=MethodOptions(weights, rotations, batch_size, device.value, precision.value),
        talk=Talk(quiet=quiet),
    )
    reports, exit_code = [], 0
    for folder in captures:
        if folder in finished:
            reports.append(finished[folder])
            job.talk.say(f"{output / capture_name(folder)}: finished before, left as it is")
            continue
        try:
            source, capture, read_seconds = job.read(folder)
        except (InputError, UsageError) as error:
            if len(captures) == 1:
                raise
            exit_code = InputError.exit_code
            print(f"splinecli: {error}", file=sys.stderr)
            report = {"capture": capture_name(folder), "error": str(error)}
        else:
            report = job.estimate(source, capture, read_seconds)
            if not (quiet or as_json):
                print(_summary(report, output))
        reports.append(report)
    if len(captures) > 1:
        failed = sum("error" in report for report in reports)
        done = len(captures) - len(finished) - failed
        job.talk.say(f"{len(captures)} captures: {done} done, {len(finished)} finished before, {failed} bad")
    if as_json:
        print(json.dumps(reports[0] if len(captures) == 1 else reports, indent=2))
    return exit_code


@dataclass
class _Job:
    """What the command line asked for, the same for every capture."""

    development: Development
    files: dict[str, Path | None]
    output: Path
    formats: list[str]
    maps: list[str]
    surface: bool
    html: bool
    asked: dict[str, Any]
    convention: Any
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

        estimator = make_estimator(self.method, self.options)
        if self.options.weights is not None and estimator.weights is None:
            raise UsageError(f"method {self.method} uses no weights", hint="Leave --weights out")
        return estimator

    def read(self, folder: Path) -> tuple[CaptureSource, Capture, float]:
        """The capture under the lights asked for, whence it comes, and the seconds that it took."""
        from splinecli.capture import open_capture

        started = time.perf_counter()
        source = open_capture(folder, development=self.development, **self.files)
        chosen = self._choose_lights(source)
        count = source.n_lights if chosen is None else len(chosen)
        with self.talk.progress(f"{source.files.name}: reading", count) as advance:
            capture = source.read(chosen, progress=lambda: advance(1))
        return source, capture, time.perf_counter() - started

    def estimate(self, source: CaptureSource, capture: Capture, read_seconds: float) -> dict[str, Any]:
        """Estimate and write the normals; returns the report."""
        from splinecli.inference import estimate_normals
        from splinecli.outputs import report_of, write_estimate

        estimator = self.estimator
        with self.talk.progress(f"{capture.name}: estimating", capture.n_pixels) as advance:
            estimate = estimate_normals(capture, estimator, progress=advance)
        warnings = [*capture.warnings]
        if estimator.weights is not None:
            from splinecli.networks.weights import untrained_warning

            warnings += untrained_warning(estimator.weights["sha256"], capture.n_lights)
        for warning in warnings:
            self.talk.warn(f"{capture.name}: {warning}")
        inputs = _inputs_sha256(source, self.options.weights)
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
        from splinecli.outputs import albedo_picture, write_albedo, write_preview

        capture = estimate.capture
        more: list[Callable[[Path], None]] = []
        albedo = colours = None
        if "albedo" in self.maps:
            from splinecli.albedo import albedo_map

            with self.talk.progress(f"{capture.name}: albedo", capture.n_lights) as advance:
                albedo = albedo_map(source, capture, estimate.normal_map, progress=lambda: advance(1))
            more.append(partial(write_albedo, albedo, capture.mask))
            colours = albedo_picture(albedo, capture.mask)
        if "preview" in self.maps:
            more.append(partial(write_preview, estimate))
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
            from splinecli.outputs import PAGE
            from splinecli.page import result_page

            page = result_page(
                report,
                estimate.normal_map,
                capture.mask,
                albedo=albedo,
                error_map_deg=estimate.error_map_deg,
            )
            more.append(lambda folder: write_text(folder / PAGE, page))
        return more

    def _choose_lights(self, source: CaptureSource) -> Sequence[int] | None:
        if self.n_lights is None:
            return self.light_indices
        from splinecli.evaluation.draws import draw_lights

        return draw_lights(source.light_directions, self.n_lights, trials=1, seed=self.seed)[0]


def _inputs_sha256(source: CaptureSource, weights: str | None) -> str:
    """Changes when any file that is read for the capture does."""
    import hashlib

    from splinecli.evaluation.trials import place_size_and_time, stamp_files
    from splinecli.files import file_sha256

    flats = [place_size_and_time(path) for path in source.development.flat_field]
    own_weights = weights if weights is None or not Path(weights).is_file() else file_sha256(Path(weights))
    stamps = [*stamp_files(source.files), flats, own_weights]
    return hashlib.sha256(json.dumps(stamps).encode()).hexdigest()


def _refuse_same_names(captures: list[Path]) -> None:
    from splinecli.capture import capture_name

    seen: dict[str, Path] = {}
    for folder in captures:
        other = seen.setdefault(capture_name(folder), folder)
        if other is not folder:
            raise UsageError(
                f"{other} and {folder} have the same name, so their results would overwrite each other",
                hint="Run them one by one with different -o",
            )


def _summary(report: dict[str, Any], output: Path) -> str:
    errors = report["angular_error_deg"]
    scored = f", MAE {errors['mean']:.2f} deg (median {errors['median']:.2f})" if errors else ""
    counts = f"{report['n_pixels']} pixels, {report['n_lights']} lights"
    return f"{output / report['capture']}: {counts}, {report['method']}{scored}"
