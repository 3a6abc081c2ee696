"""Estimate the normals of one capture: read it, run the method, write the results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.errors import OutputError, UsageError
from splinecli.pipeline.finished import inputs_sha256
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.observer import SILENT, Observer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.capture import Capture, CaptureSource
    from splinecli.inference import NormalEstimate
    from splinecli.methods import Estimator
    from splinecli.results.clock import Clock
    from splinecli.system.publishing import NewFiles


def infer_capture(
    folder: Path, options: InferOptions, observer: Observer = SILENT, *, estimator: Estimator | None = None
) -> dict[str, Any]:
    """Estimate the normals of the capture in `folder` and return the report.

    The results go to `options.output`/<capture name>/, where they replace earlier ones (see new_files). Meanwhile no
    other process may write there.

    Args:
        folder: the capture.
        options: how to read it, which method to run, what to write.
        observer: receives warnings and progress.
        estimator: what `make_method(options)` returned; it saves time in a batch.

    Raises:
        InputError: the capture cannot be read, or with options.strict, its lights or images are probably wrong.
        UsageError: the options do not fit the capture or the method.
        ModelError: the weights cannot be used.
        OutputError: the results cannot be written, or another process writes into that folder (BusyError).
    """
    from splinecli.capture import capture_name

    with held_results(capture_name(folder), options, observer) as target:
        return _infer_into(folder, target, options, observer, estimator)


@contextmanager
def held_results(name: str, options: InferOptions, observer: Observer) -> Iterator[Path]:
    """Hold the folder of results of a capture (see held_folder) and yield it. Raises OutputError."""
    from splinecli.system.publishing import held_folder, refuse_link

    target = Path(options.output) / name
    refuse_link(target)
    with held_folder(target, observer.warn):
        yield target


def _infer_into(
    folder: Path, target: Path, options: InferOptions, observer: Observer, estimator: Estimator | None
) -> dict[str, Any]:
    """Do the work of infer_capture in the folder of results, which the caller holds."""
    from splinecli.diagnosis.checks import check_capture
    from splinecli.pipeline.estimate import estimate_capture
    from splinecli.results.clock import Clock
    from splinecli.results.files import write_estimate
    from splinecli.results.report import report_of

    clock = Clock()
    if options.finds_lights:
        _check_light_files(target)
    source, capture = _read(folder, options, observer)
    if estimator is None:
        estimator = make_method(options)
    _check_results(capture, folder, options)
    estimate, distilled = estimate_capture(
        capture,
        estimator,
        partial(check_capture, source, strict=options.strict),
        refine_lights=_light_refinement(source, options),
        distil=options.distil,
        strict=options.strict,
        observer=observer,
        clock=clock,
    )
    for warning in estimate.capture.warnings:
        observer.warn(f"{capture.name}: {warning}")
    loaded = None if estimator.weights is None else estimator.weights["sha256"]
    report = report_of(
        estimate,
        estimator,
        options.as_dict(),
        inputs_sha256(source, options.weights, loaded=loaded),
        light_file=source.files.light_directions,
        as_stored=options.as_stored,
        distillation=None if distilled is None else distilled.report(),
    )
    further = _further_files(source, estimate, report, options, observer, clock)
    clock.begin("write")
    return write_estimate(
        estimate,
        report,
        target,
        formats=options.formats,
        convention=options.convention,
        clock=clock,
        more=further,
    )


def make_method(options: InferOptions) -> Estimator:
    """Return the estimator that the options ask for. Loading a network takes about a second.

    Raises:
        UsageError: the method uses no weights or gives no confidence, and the options ask for it.
        ModelError: the weights cannot be used.
    """
    from splinecli.methods import make_estimator
    from splinecli.methods.estimator import tells_confidence

    estimator = make_estimator(options.method, options.method_options)
    if options.weights is not None and estimator.weights is None:
        raise UsageError(f"method {options.method} uses no weights", hint="Leave --weights out")
    if "confidence" in options.maps and not tells_confidence(estimator):
        raise UsageError(f"method {options.method} gives no confidence", hint="Leave confidence out of --maps")
    return estimator


def _read(folder: Path, options: InferOptions, observer: Observer) -> tuple[CaptureSource, Capture]:
    """Return the opened capture, and the capture under the chosen lights."""
    source = options.open(folder)
    name = source.files.name
    if options.auto_mask:
        with observer.progress(f"{name}: finding the object", source.n_lights) as advance:
            source = source.find_mask(lambda: advance(1))
    indices = _choose_lights(source, options)
    count = source.n_lights if indices is None else len(indices)
    with observer.progress(f"{name}: reading", count) as advance:
        capture = source.read(indices, progress=lambda: advance(1), as_stored=options.as_stored)
    return source, capture


def _choose_lights(source: CaptureSource, options: InferOptions) -> Sequence[int] | None:
    if options.n_lights is None:
        return options.light_indices
    from splinecli.capture.lights.draws import draw_lights

    return draw_lights(source.light_directions, options.n_lights, trials=1, seed=options.seed)[0]


def _check_results(capture: Capture, folder: Path, options: InferOptions) -> None:
    """Raise InputError, before hours of work, for results that take more memory than is left, or an empty mesh."""
    from splinecli.capture.capture_size import results_bytes
    from splinecli.capture.formats.image_size import check_memory

    albedo = "albedo" in options.maps or options.html
    check_memory(
        results_bytes(
            capture.n_pixels, capture.n_lights, albedo=albedo, surface=options.surface or "relief" in options.maps
        ),
        f"the results of {capture.n_pixels} pixels take",
        folder,
        hint="Mask the object, or use --scale or --crop"
        + (", or leave --surface out" if options.surface else "")
        + (", or neither albedo in --maps nor --html" if albedo else ""),
    )
    if options.surface:
        from splinecli.surface.mesh import check_triangles

        check_triangles(capture.mask)


def _check_light_files(target: Path) -> None:
    """Raise OutputError for a light file in the folder of results that no earlier run wrote."""
    from splinecli.results.files import LIGHT_FILES, own_light_files

    own = own_light_files(target)
    for name in LIGHT_FILES:
        if (target / name).exists() and name not in own:
            raise OutputError(
                "the file is not from an earlier run, and --lights estimate would overwrite it",
                path=target / name,
                hint="Choose another -o",
            )


def _light_refinement(source: CaptureSource, options: InferOptions) -> Callable[[Capture], Capture] | None:
    if not options.refine_lights:
        return None
    from splinecli.capture.restore.light_refinement import refine_capture

    known = source.intensities_known
    return partial(refine_capture, intensities_known=known)


def _further_files(
    source: CaptureSource,
    estimate: NormalEstimate,
    report: dict[str, Any],
    options: InferOptions,
    observer: Observer,
    clock: Clock,
) -> list[Callable[[NewFiles], None]]:
    """Compute what else the options ask for. Each function that is returned writes some files."""
    from splinecli.pictures.light_sky import sky_plot
    from splinecli.results import files

    capture = estimate.capture
    writers: list[Callable[[NewFiles], None]] = []
    albedo = colours = None
    clock.begin("pictures")
    if "albedo" in options.maps or options.html:
        from splinecli.pictures.maps import albedo_picture
        from splinecli.results.albedo import albedo_map

        with observer.progress(f"{capture.name}: albedo", capture.n_lights) as advance:
            albedo = albedo_map(source, capture, estimate.normal_map, progress=lambda: advance(1))
        colours = albedo_picture(albedo, capture.mask)
        if "albedo" in options.maps:
            writers.append(partial(files.write_albedo, albedo, capture.mask, exr="exr" in options.formats))
    if "confidence" in options.maps and estimate.confidence_map is not None:
        writers.append(partial(files.write_confidence, estimate.confidence_map))
    for name, write in (
        ("preview", files.write_preview),
        ("gradient", files.write_gradient),
        ("curvature", files.write_curvature),
    ):
        if name in options.maps:
            writers.append(partial(write, estimate))
    if "relief" in options.maps:
        from splinecli.surface.integration import relief_of_normals

        writers.append(partial(files.write_relief, relief_of_normals(estimate.normal_map, capture.mask)))
    light_plot = None
    if capture.light_errors_deg is not None:
        light_plot = sky_plot(capture.light_directions, capture.name, errors_deg=capture.light_errors_deg)
        writers.append(partial(files.write_lights, capture, light_plot))
    if source.automatic_mask is not None:
        writers.append(partial(files.write_mask, source.window.filled(capture.mask)))
    if options.surface:
        clock.begin("surface")
        writers.append(_surface(estimate, colours, report, options, observer))
    if options.html:
        clock.begin("pictures")
        writers.append(_page(estimate, albedo, {**report, "seconds": clock.seconds()}, light_plot))
    return writers


def _surface(
    estimate: NormalEstimate,
    colours: NDArray[np.uint8] | None,
    report: dict[str, Any],
    options: InferOptions,
    observer: Observer,
) -> Callable[[NewFiles], None]:
    """Integrate the normals, put what the report says of the surface into it, and return what writes the files."""
    from splinecli.pipeline.surface import make_surface, view_of_report
    from splinecli.surface.surface_files import DEFAULT_FORMATS, encode_surface

    camera_matrix, pixel_size = view_of_report(report)
    with observer.progress(f"{estimate.capture.name}: integrating", 1) as advance:
        surface, report["surface"] = make_surface(
            estimate.normal_map,
            estimate.capture.mask,
            camera_matrix,
            colours,
            stiffness=options.stiffness,
            pixel_size_mm=pixel_size,
            progress=advance,
        )
    formats = (*DEFAULT_FORMATS, *(("exr",) if "exr" in options.formats else ()))

    def write(new: NewFiles) -> None:
        for name, content in encode_surface(surface, formats):
            new.write(name, content)

    return write


def _page(
    estimate: NormalEstimate,
    albedo: NDArray[np.float32] | None,
    report: dict[str, Any],
    light_plot: bytes | None,
) -> Callable[[NewFiles], None]:
    from splinecli.results.files import PAGE
    from splinecli.results.page import result_page

    page = result_page(
        report,
        estimate.normal_map,
        estimate.capture.mask,
        albedo=albedo,
        confidence_map=estimate.confidence_map,
        error_map_deg=estimate.error_map_deg,
        light_plot=light_plot,
    )
    return lambda new: new.write(PAGE, page)
