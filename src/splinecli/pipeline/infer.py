"""Estimate the normals of one capture: read it, check it, run the method, write the results.

Both `infer` and splinecli.estimate_normals use this code. A distilled estimator may replace the
network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splinecli.capture import Capture, CaptureSource, capture_name
from splinecli.capture.files import digest
from splinecli.capture.formats.facts import StoredSize
from splinecli.capture.formats.images import check_memory
from splinecli.capture.light_files import rows_text
from splinecli.capture.source import BYTES_OF_RESULTS, capture_bytes
from splinecli.errors import OutputError, SplinecliError, UsageError
from splinecli.estimate.inference import NormalEstimate, estimate_normals, find_surface, lighting_on
from splinecli.estimate.methods import DEFAULT_METHOD, Estimator, MethodOptions, make_estimator
from splinecli.estimate.methods.estimator import FEWEST_TO_DISTIL, student_sizes
from splinecli.judge.checks import TILT_ADVICE, check_confidence, refuse_if_strict
from splinecli.judge.tilt import find_tilt
from splinecli.lights.draws import draw_lights
from splinecli.maths import Bools, Float32Array
from splinecli.pictures.capture_sheet import sheet_of
from splinecli.pictures.maps import encode_png
from splinecli.pictures.plots import sky_plot
from splinecli.pipeline.expected_seconds import AUTOMATIC_FROM, expected_seconds
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.integrate import view_of_report
from splinecli.recipe.steps import begin, follow, images_to_read
from splinecli.recipe.work import Work
from splinecli.records.capture_warnings import (
    EIGHT_BIT,
    FAULTS_OF_LIGHTS,
    LIGHTS_MENDED,
    LIGHTS_TILTED,
    LIGHTS_UNCERTAIN,
    NOT_DISTILLED,
    ROUGH_LIGHTS,
    UNDECIDED,
    UNTRAINED_LIGHTS,
    CaptureWarning,
    lights_mended,
)
from splinecli.records.output_files import (
    BYTES_OF_SURFACE,
    CAPTURE_SHEET,
    FOUND_LIGHTS,
    FOUND_MASK,
    MAPS,
    MENDED_LIGHTS,
    PAGE,
    OutputMap,
)
from splinecli.results import files
from splinecli.results.files import report_of
from splinecli.results.maps import chosen_maps, make_map, map_files, map_picture
from splinecli.results.material import (
    base_colour_picture,
    gloss_picture,
    material_facts,
    material_warnings,
)
from splinecli.results.pages import result_page
from splinecli.surface.make import SurfaceSettings, make_surface
from splinecli.surface.mesh import Textures, check_triangles
from splinecli.surface.surface_files import DEFAULT_FORMATS, encode_surface
from splinecli.system.files import expanded, file_sha256
from splinecli.system.progress import SILENT, Clock, Observer, ignore
from splinecli.system.publishing import Content, held_folder, refuse_link

if TYPE_CHECKING:
    from splinecli.estimate.methods.distilled import DistilledEstimator


# memory for Python, PyTorch and a batch of pixels, without the capture and its refinement
BASE_BYTES = 500 * 2**20
# largest number of pixels refined at once (a tile with its margin), and bytes per pixel
REFINED_PIXELS, REFINED_BYTES = (736**2, 1100)


_SHEET_CAPTION = (
    "The images as they are used, each with its light; the rim of the disc is at 90° from the"
    " camera axis"
)
_LOWERING = (LIGHTS_UNCERTAIN, UNDECIDED)  # notes that explain a low confidence
_LIGHTS_CAPTION = (
    "The estimated lights around the camera axis; the radius of each circle is the expected error"
)

_TILT_ERROR_DEG = 2.0  # which remains after the lights were tilted back
_OF_TILT = LIGHTS_TILTED, UNDECIDED  # warnings that a clear tilt replaces
# If all lights are tilted, the network's normals are tilted by less, so the tilt is undone in
# steps. Each step must reduce the curl to this share or less.
_TILTS, _LEAST_FALL, _SMALL_TILT_DEG, _LEAST_CHANGE = 3, 0.95, 4.0, 0.03


def infer_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the memory in bytes that spline-net needs for a capture, in addition to BASE_BYTES.

    It follows from the size of the largest image, the number of pixels in the mask and the number
    of images.
    """
    of_indirect_light = 4 * n_pixels
    of_pixels = of_indirect_light + REFINED_BYTES * min(n_pixels, REFINED_PIXELS)
    return capture_bytes(largest, n_pixels, n_lights) + of_pixels


def source_bytes(open_source: Callable[[], CaptureSource], n_lights: int = 0) -> float:
    """Return the approximate memory in bytes for a capture; 0 if it cannot be read and so will
    fail.

    It follows from the header of the first image and, for large captures, from the mask. `n_lights`
    is the number of images that are used; 0 stands for all.
    """
    try:
        source = open_source()
        size = source.facts[0].size
        n_lights = n_lights or source.n_lights
        n_pixels = source.window.of(np.broadcast_to(np.True_, size[0][:2])).size
        n_bytes = infer_bytes(size, n_pixels, n_lights)
        is_large = n_bytes > 10**9  # so reading the mask is worth the time
        if is_large and (source.files.mask is not None or source.files.boundaries):
            n_bytes = infer_bytes(
                size, int(np.count_nonzero(source.read_mask(size[0][:2]))), n_lights
            )
    except (SplinecliError, OSError, MemoryError):
        return 0.0
    return float(n_bytes)


def distil_for(
    capture: Capture, estimator: Estimator, wanted: bool | None, clock: Clock | None = None
) -> tuple[DistilledEstimator | None, list[CaptureWarning]]:
    """Return a distilled estimator for a capture, or None to use `estimator` on every pixel, and
    warnings.

    Under near lamps, the capture must contain its surface points. If `wanted` is None,
    AUTOMATIC_FROM decides. Raises UsageError if distillation is requested, but the method does not
    estimate a confidence or the capture is too small.
    """

    def refuse(problem: str) -> tuple[None, list[CaptureWarning]]:
        if wanted:
            raise UsageError(problem, hint="Leave --distil out")
        return None, []

    clock = clock or Clock()
    if wanted is False or (wanted is None and capture.n_pixels < AUTOMATIC_FROM):
        return None, []
    if not estimator.has_confidence:
        return refuse(
            f"method {estimator.name} cannot be distilled, because it does not provide confidence"
        )
    sizes = student_sizes(capture.n_pixels)
    if sizes[0].sample < FEWEST_TO_DISTIL:
        return refuse(f"{capture.name}: {capture.n_pixels} pixels are too few to distil")
    lighting_at = partial(lighting_on(capture), None)
    teacher = estimator.bind(lighting_at, capture.mask)
    from splinecli.estimate.methods.distilled import distil

    for size in sizes:
        try:
            advance = clock.begin("distil", 2 * size.sample, "learning the capture")
            distilled = distil(teacher, lighting_at, capture.n_pixels, size, progress=advance)
        except UsageError as error:  # most pixels are a dark background
            return refuse(f"{capture.name}: {error.problem}")
        if distilled.distillation.is_good:
            return distilled, []
    text = (
        "The full network was applied to every pixel, because a smaller one, trained on a sample,"
        f" deviated from it by {distilled.distillation.mean_deg:.1f} degrees. The predicted errors"
        f" of the full network are {distilled.distillation.expected_deg:.1f} degrees."
    )
    return None, [CaptureWarning(NOT_DISTILLED, text)]


def estimate_capture(
    work: Work,
    load: Callable[[], Estimator],
    *,
    distil: bool | None = None,
    progress: Callable[[int], object] | None = None,
    clock: Clock | None = None,
) -> tuple[NormalEstimate, DistilledEstimator | None, Work]:
    """Return the normals of a prepared capture, the distilled estimator if one was used, and the
    work with its clear faults corrected.

    The estimate contains the capture with all warnings. The capture is checked before `load` is
    called, which returns the estimator. `distil` is as in distil_for. `progress` is called with the
    number of pixels just estimated. If the options of the recipe are strict, a warning that an
    input is probably wrong becomes an InputError. The clock times the stages and shows them.
    """
    clock = clock or Clock()
    clock.begin("check", note="checking")
    strict = work.options.strict
    work = follow(work, "judgement", until="refinement")
    prepared = work.made.warnings
    judged = work.judgement.warnings if work.judgement else ()
    remedy = work.judgement.remedy if work.judgement else None
    mended = {LIGHTS_TILTED, *(fault.warning.kind for fault in (remedy.faults if remedy else ()))}
    if work.options.keeps_lights:
        mended -= FAULTS_OF_LIGHTS
    refuse_if_strict([*prepared, *judged], work.made.name, strict=strict, mended=mended)
    capture = follow(work, "refinement").made
    if work.options.refine_lights:
        judged = tuple(warning for warning in judged if warning.kind != ROUGH_LIGHTS)
    warnings = [*prepared, *judged, *capture.warnings[len(prepared) :]]
    capture = replace(capture, warnings=tuple(warnings))
    capture = find_surface(capture)
    estimator = load()
    distilled, found = distil_for(capture, estimator, distil, clock)
    advance = clock.begin("estimate", capture.n_pixels, "estimating")
    estimate = estimate_normals(
        capture, distilled or estimator, progress=progress or advance, clock=clock
    )
    again = partial(estimate_normals, estimator=distilled or estimator, clock=clock)
    estimate, of_tilt = undo_tilt(estimate, again, mends=work.options.mends_lights)
    if of_tilt:
        warnings = [warning for warning in warnings if warning.kind not in _OF_TILT]
    warnings += [*found, *of_tilt]
    warnings += [
        CaptureWarning(UNTRAINED_LIGHTS, text)
        for text in estimator.warn_of_lights(capture.n_lights)
    ]
    # Other warnings about errors already explain a low confidence.
    if not any(each.error_deg and (each.is_error or each.kind in _LOWERING) for each in warnings):
        warnings += check_confidence(estimate.expected_under_5)
    refuse_if_strict(warnings, capture.name, strict=strict, mended=mended)
    estimate = replace(estimate, capture=replace(estimate.capture, warnings=tuple(warnings)))
    return estimate, distilled, work


def undo_tilt(
    estimate: NormalEstimate, again: Callable[[Capture], NormalEstimate], *, mends: bool
) -> tuple[NormalEstimate, list[CaptureWarning]]:
    """Return the estimate, and warnings, after undoing a common tilt of all lights.

    The tilt is found in the normals of a network. If `mends`, the lights are tilted back, provided
    that this reduces the curl of the new normals and does not increase the errors that the network
    predicts.
    """
    capture = estimate.capture
    others = tuple(each for each in capture.warnings if each.kind not in _OF_TILT)
    capture = replace(capture, warnings=others)
    measured = capture.lamps is None and capture.camera_matrix is None
    if estimate.confidence_map is None or not measured or capture.light_errors_deg is not None:
        return estimate, []
    tilt = find_tilt(estimate.normal_map, capture.mask)
    if tilt is None or not tilt.is_clear:
        return estimate, []
    cause = f"The lights {tilt.cause}"
    accepted, left = estimate, tilt
    for _ in range(_TILTS if mends else 0):
        lights = accepted.capture.light_directions @ left.matrix.T
        if (lights[:, 2] <= 0).any():
            break
        tried = again(replace(capture, light_directions=lights))
        found = find_tilt(tried.normal_map, capture.mask)
        if found is None or found.curl > _LEAST_FALL * left.curl:
            break
        # Tilting correct lights increases the errors that the network predicts.
        if (tried.expected_under_5 or 0) < (estimate.expected_under_5 or 0) - _LEAST_CHANGE:
            if accepted is estimate:
                return estimate, []
            break
        accepted, left = tried, found
        if left.degrees < _SMALL_TILT_DEG or left.left > _LEAST_FALL:
            break
    if accepted is not estimate:
        codes = tuple(dict.fromkeys((*capture.mended, LIGHTS_TILTED.code)))
        note = replace(lights_mended(cause), error_deg=_TILT_ERROR_DEG)
        lights = accepted.capture.light_directions
        capture = replace(
            capture, light_directions=lights, mended=codes, warnings=(*capture.warnings, note)
        )
        return again(capture), [note]
    warning = CaptureWarning(LIGHTS_TILTED, f"{cause} {TILT_ADVICE}.", tilt.degrees)
    # With this warning, the confidence accounts for the tilt.
    return again(replace(capture, warnings=(*capture.warnings, warning))), [warning]


def infer_capture(
    folder: Path,
    options: InferOptions,
    observer: Observer = SILENT,
    *,
    load: Callable[[], Estimator] | None = None,
) -> dict[str, Any]:
    """Estimate the normals of the capture in `folder`, write the results and return the report.

    The results in `options.output`/<capture name>/ replace earlier ones, as in new_files. No other
    process may write there in the meantime.

    Args:
        load: returns `make_method(options)`, which can be reused in a batch to save time. It is
            called after the capture was read and checked.

    Raises:
        InputError: the capture cannot be read, or with options.strict, its lights or images are
            probably wrong.
        UsageError: the options do not fit the capture or the method.
        ModelError: the weights cannot be used.
        OutputError: the results cannot be written, or another process writes to the same folder
            (BusyError).

    Examples:
        >>> from pathlib import Path
        >>> from splinecli.pipeline.infer import infer_capture
        >>> from splinecli.pipeline.infer_options import InferOptions
        >>> options = InferOptions(method="ls", output="results")
        >>> infer_capture(Path("examples/medallion"), options)["n_pixels"]
        11836
    """
    name = capture_name(folder)
    with held_results(name, options, observer) as target, observer.progress(name, 1.0) as show:
        clock = Clock(show)
        load = load or cache(partial(make_method, options))
        source = options.open(folder)
        if not source.has_lights:
            _check_light_files(target)
            load()  # sets the number of threads of PyTorch, which estimates the lights
        work = _prepare(source, options, clock)
        _check_results(work.made, folder, options)
        estimate, distilled, work = estimate_capture(work, load, distil=options.distil, clock=clock)
        source, capture = work.files, work.made
        for warning in estimate.capture.warnings:
            # In a batch, these warnings usually apply to all captures.
            once = warning.text if warning.kind is EIGHT_BIT else None
            again = f"{capture.name}: {warning.again}" if warning.again else ""
            once = warning.code if again else once
            observer.warn(f"{capture.name}: {warning}", once=once, again=again)
        estimator = load()
        loaded = None if estimator.weights is None else estimator.weights["sha256"]
        report = report_of(
            estimate,
            estimator,
            options.as_dict(),
            inputs_sha256(source, options.weights, loaded=loaded),
            light_file=source.files.light_directions,
            distillation=None if distilled is None else distilled.report(),
            alignment=None
            if source.alignment is None
            else source.alignment.as_dict(capture.light_indices),
        )
        if source.files.kept is not None:
            report["light_indices"] = [
                source.files.kept[index] for index in report["light_indices"]
            ]
        found = _make_files(source, estimate, report, options, observer, clock)
        clock.begin("write", note="writing")
        return files.write_estimate(report, target, chain.from_iterable(found), clock)


def inputs_sha256(source: CaptureSource, weights: str | None, *, loaded: str | None = None) -> str:
    """Return a digest that changes whenever the weight file or a file of the capture changes.

    `loaded` is the SHA-256 of the weight file at the time it was loaded. If it is None, the file is
    read.
    """
    if weights is not None and (path := expanded(weights)).is_file():
        weights = loaded or file_sha256(path)
    return digest([*source.stamp, weights])


@contextmanager
def held_results(name: str, options: InferOptions, observer: Observer) -> Iterator[Path]:
    """Yield the folder for the results of a capture, locked with held_folder. Raises
    OutputError.
    """
    target = Path(options.output) / name
    refuse_link(target)
    with held_folder(target, observer.warn):
        yield target


def make_method(options: InferOptions) -> Estimator:
    """Return the estimator selected by the options. Loading a network takes about a second.

    Raises ModelError, or UsageError if the options require weights or a confidence that the method
    does not have.
    """
    estimator = make_estimator(options.method, options.method_options)
    if options.weights is not None and estimator.weights is None:
        raise UsageError(
            f"method {options.method} does not use weights", hint="Leave --weights out"
        )
    for name in options.maps:
        if MAPS[name].needs_confidence and not estimator.has_confidence:
            raise UsageError(
                f"method {options.method} does not provide {name}",
                hint=f"Leave {name} out of --maps",
            )
    return estimator


def loads_first(options: InferOptions) -> bool:
    """Return whether the method has to be loaded before a capture is read, because an option may be
    invalid.

    The precision is always valid.
    """
    chosen = replace(options.method_options, precision="auto") != MethodOptions()
    return chosen or options.method != DEFAULT_METHOD


def _prepare(source: CaptureSource, options: InferOptions, clock: Clock) -> Work:
    """Return the capture of a source, prepared but not judged."""
    indices = source.places_of(options.light_indices)
    if options.n_lights is not None:
        directions = source.light_directions
        indices = draw_lights(directions, options.n_lights, trials=1, seed=options.seed)[0]
    work = begin(source, indices, options.recipe)
    height, width, *_ = source.facts[0].size[0]
    n_reads = images_to_read(work)
    seconds = partial(
        expected_seconds,
        image_pixels=len(work.indices) * height * width,
        read_pixels=n_reads * height * width,
        network=options.method.startswith(DEFAULT_METHOD),
        align=options.align,
        maps=chosen_maps(options.maps, page=options.html),
    )
    clock.expect(seconds(height * width, distils=options.distil))
    work = follow(work, until="judgement", advance=clock.begin("read", n_reads, "reading"))
    rest = seconds(work.made.n_pixels, distils=options.distil)
    clock.expect({stage: rest[stage] for stage in rest if stage != "read"})
    return work


def _check_results(capture: Capture, folder: Path, options: InferOptions) -> None:
    """Raise InputError, before hours of work, if the results need too much memory or a mesh is
    empty.
    """
    rows = chosen_maps(options.maps, page=options.html)
    for row in rows:
        row.check_lights(capture.n_lights, folder)
    costly = [row.name for row in rows if row.bytes_per_pixel]
    avoidable = [f"--maps {name}" for name in costly if name in options.maps]
    avoidable += ["--html"] * options.html + ["--surface"] * options.surface
    hint = "Mask the object, or use --scale or --crop"
    hint += f", or leave out {' and '.join(avoidable)}" if avoidable else ""
    needed = results_bytes(capture.n_pixels, capture.n_lights, maps=costly, surface=options.surface)
    check_memory(needed, f"the results of {capture.n_pixels} pixels take", folder, hint=hint)
    if options.surface:
        check_triangles(capture.mask, folder)


def _check_light_files(target: Path) -> None:
    """Raise OutputError if the folder of results contains a light file from another source."""
    own = files.own_light_files(target)
    for name in FOUND_LIGHTS:
        if (target / name).exists() and name not in own:
            problem = (
                "--lights estimate would overwrite this file, which was not written by an earlier"
                " run"
            )
            raise OutputError(problem, path=target / name, hint="Choose another folder with -o")


def _make_files(
    source: CaptureSource,
    estimate: NormalEstimate,
    report: dict[str, Any],
    options: InferOptions,
    observer: Observer,
    clock: Clock,
) -> list[Iterable[tuple[str, Content]]]:
    """Compute the requested results, add the surface to the report, and return the files."""
    capture = estimate.capture
    clock.begin("pictures", note="maps")
    made = _costly_maps(source, estimate, options, clock)
    if "material" in made:
        facts = material_facts(made["material"], capture.mask)
        report["material"] = facts.as_dict()
        for warning in material_warnings(facts):
            report["warnings"].append({"code": warning.code, "text": warning.text})
            observer.warn(f"{capture.name}: {warning}")
    scales = dict(options.map_scales)

    def map_of(row: OutputMap) -> Iterator[tuple[str, Content]]:
        """Yield the files of a map, which is computed when they are written unless it exists."""
        values = made[row.name] if row.name in made else make_map(row, source, estimate)
        if values is not None:
            scale = scales.get(row.name)
            yield from map_files(row, values, capture.mask, options.formats, scale=scale)

    found: list[Iterable[tuple[str, Content]]] = [
        files.normal_files(estimate, options.formats, options.convention),
        *map(map_of, chosen_maps(options.maps)),
    ]
    pictures = {_SHEET_CAPTION: sheet_of(source, capture)}
    found.append([(CAPTURE_SHEET, pictures[_SHEET_CAPTION])])
    if (errors_deg := capture.light_errors_deg) is not None:
        light_plot = sky_plot(capture.light_directions, capture.name, errors_deg=errors_deg)
        pictures[_LIGHTS_CAPTION] = light_plot
        found.append(files.light_files(capture, light_plot))
    if any(each.kind is LIGHTS_MENDED for each in capture.warnings):
        found.append([(MENDED_LIGHTS, rows_text(capture.light_directions))])
    if source.automatic_mask is not None:
        found.append([(FOUND_MASK, encode_png(source.window.filled(capture.mask) * np.uint8(255)))])
    if options.surface:
        advance = clock.begin("surface", note="integrating")
        camera_matrix, pixel_size = view_of_report(report)
        surface, report["surface"] = make_surface(
            estimate.normal_map,
            capture.mask,
            camera_matrix,
            _textures(made, capture.mask),
            SurfaceSettings(options.discontinuity, pixel_size),
            advance,
        )
        formats = (*DEFAULT_FORMATS, *(("exr",) if "exr" in options.formats else ()))
        found.append(encode_surface(surface, formats))
    if options.html:
        clock.begin("pictures")
        page = result_page(
            {**report, "seconds": clock.seconds()},
            estimate.normal_map,
            capture.mask,
            values={name: made[name] for name, row in MAPS.items() if name in made and row.caption},
            material=made.get("material"),
            error_map_deg=estimate.error_map_deg,
            pictures=pictures,
        )
        found.append([(PAGE, page)])
    return found


def _costly_maps(
    source: CaptureSource, estimate: NormalEstimate, options: InferOptions, clock: Clock
) -> dict[str, Float32Array]:
    """Return the maps that need much memory or are shown on the page.

    The others are computed when they are written.
    """
    made: dict[str, Float32Array] = {}
    for row in chosen_maps(options.maps, page=options.html):
        if not (row.bytes_per_pixel or (options.html and row.caption)):
            continue
        count: Callable[[], object] = ignore
        if row.reads_images:
            n_images = estimate.capture.n_lights
            count = partial(clock.begin("pictures", n_images, row.name), 1)
        values = make_map(row, source, estimate, count)
        if values is not None:
            made[row.name] = values
    return made


def _textures(made: Mapping[str, Float32Array], mask: Bools) -> Textures:
    """Return the textures of a mesh from the maps that were made."""
    if (material := made.get("material")) is not None:
        return Textures(  # the base colour excludes highlights
            base_colour_picture(material[..., :3], mask),
            gloss_picture(material[..., 3:5], mask),
            material[..., 5],
        )
    if (albedo := made.get("albedo")) is not None:
        return Textures(map_picture(MAPS["albedo"], albedo, mask))
    return Textures()


def results_bytes(
    n_pixels: int, n_lights: int, *, maps: Sequence[str] = (), surface: bool = False
) -> int:
    """Return the memory in bytes for a capture's results, in addition to its observations."""
    # The memory of each map is freed before the next one is computed.
    each = [
        MAPS[name].bytes_per_pixel + MAPS[name].bytes_per_observation * n_lights for name in maps
    ]
    return n_pixels * (BYTES_OF_RESULTS + max([*each, BYTES_OF_SURFACE * surface]))
