"""The recipe, which turns the stored pixels of a capture into reliable observations step by step.

    mask -> colours of the lamps -> registration -> mask of the aligned images -> observations,
    without lens blur -> lights -> intensities -> saturation -> judgement -> refined lights

`infer` and `info` follow the table STEPS. `evaluate` reads the observations once; each trial then
starts at the lights, with the images of its draw. Arrays start at the observations. No other code
prepares images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from splinecli.capture.formats.images import common_size
from splinecli.capture.linearise import StoredPixels
from splinecli.capture.reader import CaptureOptions, open_capture
from splinecli.capture.record import Capture, check_light_indices
from splinecli.capture.source import CaptureSource, Source
from splinecli.errors import InputError
from splinecli.images.alignment import MIN_IMAGES
from splinecli.images.lamps import (
    estimate_light_intensities,
    lamp_colours,
    turn_by_intensities_deg,
)
from splinecli.images.lens_blur import are_soft, remove_blur, surroundings
from splinecli.images.mask import find_object
from splinecli.images.saturation import restore_saturated
from splinecli.judge.checks import ALIGN_ADVICE, check_capture, explains_more
from splinecli.judge.evidence import Evidence
from splinecli.judge.explanations import SRGB_EXPONENT
from splinecli.lights.light_fit import refine_capture
from splinecli.lights.outline import is_outlined
from splinecli.maths import Float64Array
from splinecli.maths.transfer import SRGB
from splinecli.recipe.contradiction import ask_network
from splinecli.recipe.reading import (
    Observed,
    compared_pixels,
    exposure_warnings,
    gather_observations,
    look_at_image,
)
from splinecli.recipe.registration import compare_colours, register
from splinecli.recipe.work import USUAL, RecipeOptions, Work
from splinecli.records.capture_warnings import (
    CURVE_MENDED,
    ESTIMATED_INTENSITIES,
    FAULTS_OF_LIGHTS,
    IMAGES_ALIGNED,
    IMAGES_SHIFTED,
    NONLINEARITY_SUSPECTED,
    CaptureWarning,
    WarningKind,
    estimated_lights,
    lights_mended,
    soft_images,
)
from splinecli.system.files import StrPath

Advance = Callable[[float, str], object]  # called after each image, with 1 and the step's note


def find_colours(work: Work, advance: Callable[[], object]) -> Work:
    """Find the colours of the lamps before registration, which compares images."""
    return _with_colours(work, *compare_colours(work.files, work.indices, advance))


def _with_colours(
    work: Work, colours: Float64Array | None, warnings: Sequence[CaptureWarning]
) -> Work:
    """Return the work with the images divided by the colours (F, 3) of their lamps."""
    source, found = work.source.divided_by(work.indices, colours), (*work.warnings, *warnings)
    return replace(work, source=source, colours=colours, colours_known=True, warnings=found)


def find_mask(work: Work, advance: Callable[[], object]) -> Work:
    """Find the object in all images of the source; see find_object.

    Raises InputError if the mask was requested, but no object stands out.
    """
    source = work.files
    shape = common_size(source.facts)[0][:2]  # of all images
    everywhere = source.window.of(np.ones(shape, np.bool_))
    total = np.zeros(everywhere.size, np.float32)
    every = range(source.n_lights)
    for colours in source.read_pixels(everywhere, every, StoredPixels.colours, advance):
        total += colours.mean(axis=1)
    try:
        mask = find_object(total.reshape(everywhere.shape), is_requested=work.options.auto_mask)
    except InputError as error:
        if not work.options.auto_mask:
            return work
        raise InputError(error.problem, path=source.files.folder, hint=error.hint) from None
    if source.alignment is not None:
        mask &= source.alignment.common
    return replace(work, source=replace(source, automatic_mask=mask))


def observe(work: Work, advance: Callable[[], object]) -> Work:
    """Read the images and remove lens blur.

    If the lamps have different colours, the images are read again, because only the mean of their
    channels was kept.

    Raises:
        UsageError: the indices of the images are not valid.
        InputError: an image, the mask or the ground truth cannot be read or does not fit the
            others, or Capture rejects the lights.
    """
    source, indices = work.source, work.indices
    mask = source.mask_for(indices)
    truth, of_truth = source.read_ground_truth(mask)
    sharpens = source.has_neighbours and not work.options.as_stored
    around = surroundings(mask) if sharpens else None

    def read(source: Source) -> Observed:
        look = partial(
            look_at_image, compared_pixels(int(np.count_nonzero(mask))), source.white_level
        )
        images = source.read_pixels(mask, indices, look, advance, around=around)
        return gather_observations(images, len(indices), mask, source.white_level)

    observed = read(source)
    if observed.colours is not None and _compares_colours(work):
        work = _with_colours(work, *lamp_colours(observed.colours))
        if work.colours is not None:
            del observed
            observed = read(source := work.source)
    lamps, of_lamps = source.near_lamps(mask)
    of_mask = source.mask_warnings(mask, indices)
    exposure = exposure_warnings(observed, inverted=bool(of_mask))
    blur, soft = None, list[CaptureWarning]()
    if around is not None:
        if is_outlined(mask) and are_soft(observed.observations, mask, around):
            soft = [soft_images()]
        blur = remove_blur(observed.observations, mask, around)
    capture = Capture(
        source.name,
        observed.observations[: observed.saturation.n_pixels],
        source.light_directions[list(indices)],
        indices,
        mask,
        truth,
        (*source.warnings, *work.warnings, *exposure, *soft, *of_truth, *of_lamps, *of_mask),
        estimated_colours=work.colours,
        white_level=observed.saturation.white_level,
        removed_blur=blur,
        lamps=None if lamps is None else lamps.choose_lights(indices),
        camera_matrix=None if lamps is not None else source.camera(),
    )
    return replace(
        work, capture=capture, saturation=observed.saturation, images=observed.images, warnings=()
    )


def find_lights(work: Work, _: Callable[[], object]) -> Work:
    """Estimate the light directions from the observations.

    Raises InputError if the images do not determine the lights, or if normals cannot be estimated
    under the lights found.
    """
    from splinecli.estimate.light_descent import best_lights
    from splinecli.lights.unknown_lights import find_lights

    capture, options = work.made, work.options
    try:
        found = find_lights(
            capture.observations,
            capture.mask,
            work.source.intensities_known,
            best_lights,
            first_light=options.first_light,
            first_image=work.source.image_names(work.indices)[0],
            refuse=options.refuses_lights,
        )
    except InputError as error:
        problem, hint = error.problem, error.hint
        if not options.finds_lights:
            problem = f"found no light file, and {problem}"
            hint = f"Add --lights FILE if you have measured the lights. {hint}"
        raise InputError(f"{capture.name}: {problem}", hint=hint) from None
    capture = replace(
        capture,
        light_directions=found.directions,
        light_errors_deg=found.errors_deg,
        warnings=(
            *capture.warnings,
            estimated_lights(found.errors_deg, requested=options.finds_lights),
        ),
    )
    return replace(work, capture=capture, found_intensities=found.intensities)


def divide_by_intensities(work: Work, _: Callable[[], object]) -> Work:
    """Divide by light intensities, estimated from all pixels, if they are unknown."""
    capture, intensities, turn_deg = work.made, work.found_intensities, 0.0
    if intensities is None and not work.source.intensities_known:
        intensities = estimate_light_intensities(
            capture.observations, work.saturated.flags, work.lights_of
        )
        if intensities is not None:
            turn_deg = turn_by_intensities_deg(capture.observations, intensities, work.lights_of)
    if intensities is None:
        return work
    lowest, highest = intensities.min(), intensities.max()
    digits = 4 if f"{lowest:.2f}" == f"{highest:.2f}" else 2
    extent = f"from {lowest:.{digits}f} to {highest:.{digits}f} times their mean."
    if turn_deg >= 1:
        extent += f" Their errors turn the normals by about {turn_deg:.0f} degrees."
    text = (
        f"The light intensities were estimated from the images, because they are unequal: {extent}"
        " Use --intensities FILE if you have measured them, or --intensities equal to assume equal"
        " ones."
    )
    again = f"The light intensities were estimated: {extent}"
    capture = replace(
        capture,
        observations=np.divide(capture.observations, intensities, dtype=np.float32),
        estimated_intensities=intensities,
        warnings=(
            *capture.warnings,
            CaptureWarning(ESTIMATED_INTENSITIES, text, turn_deg, again=again),
        ),
    )
    return replace(work, capture=capture)


def restore(work: Work, _: Callable[[], object]) -> Work:
    """Replace saturated observations with estimates; see restore_saturated."""
    flags = work.saturated.flags
    if flags is None:
        return work
    observations = work.made.observations.copy()
    restored = restore_saturated(observations, flags, work.lights_of)
    if restored is None:
        return work
    return replace(work, capture=replace(work.made, observations=observations, restored=restored))


def judge(work: Work, _: Callable[[], object]) -> Work:
    """Check the lights and the images against each other; see judge/checks.py."""
    judgement = check_capture(work.source, work.made, strict=work.options.strict)
    if work.options.asks_network:
        judgement = ask_network(work, judgement)
    judged = replace(work, judgement=judgement)
    return _without_align(judged) if work.options.align else judged


def mend(work: Work, _: Callable[[], object]) -> Work:
    """Read the capture again with its clear faults corrected, except values set by options.

    The capture is left as it is if a correction causes another contradiction with the images.
    """
    judgement, source, options = work.judgement, work.source, replace(work.options, mends=False)
    assert judgement is not None and judgement.remedy is not None  # see _mends
    remedy, notes, mended_kinds = judgement.remedy, list[CaptureWarning](), set[WarningKind]()
    moved_intensities: Float64Array | None = None
    files = source if isinstance(source, CaptureSource) else None

    def causes(*kinds: WarningKind) -> str:
        """Return the causes of the faults of these kinds, and record the kinds as corrected."""
        found = [each for each in remedy.faults if each.warning.kind in kinds]
        mended_kinds.update(each.warning.kind for each in found)
        return " ".join(each.cause for each in found)

    keeps = options.keeps_lights or source.has_positions
    if remedy.lights is not None and not keeps and (remedy.lights[:, 2] > 0).all():
        moved_intensities = _in_order_of(remedy.lights, source, work.indices)
        directions = source.light_directions.copy()
        directions[list(work.indices)] = remedy.lights
        source = replace(source, light_directions=directions)
        why = causes(*FAULTS_OF_LIGHTS)
        note = lights_mended(why, in_files=files is not None)
        notes.append(replace(note, error_deg=remedy.light_error_deg))
    if remedy.curve is not None and files is not None and files.radiometry.automatic:
        curve = SRGB if remedy.curve == SRGB_EXPONENT else remedy.curve
        radiometry = replace(files.radiometry, curve=curve, automatic=False)
        assert isinstance(source, CaptureSource)
        source = replace(source, radiometry=radiometry)
        text = f"{causes(NONLINEARITY_SUSPECTED)} They were decoded; --transfer linear reads them"
        notes.append(CaptureWarning(CURVE_MENDED, f"{text} as they are."))
    moved = ""
    if remedy.align and files is not None and len(work.indices) >= MIN_IMAGES:
        options, moved = replace(options, align=True), causes(IMAGES_SHIFTED)
    faults = [each.warning for each in remedy.faults if each.warning.kind in mended_kinds]
    try:
        mended = follow(begin(source, work.indices, options), until="mending") if faults else None
    except InputError:  # images that cannot be aligned
        mended = None
    if mended is not None and moved_intensities is not None and _errors(mended):
        source = replace(source, light_intensities=moved_intensities)
        other = follow(begin(source, work.indices, options), until="mending")
        if len(_errors(other)) < len(_errors(mended)):
            mended, why = other, "They and the intensities were corrected"
            notes = [
                replace(note, text=note.text.replace("They were corrected", why)) for note in notes
            ]
    if mended is not None and moved:
        before, after = (Evidence.of(each.source, each.made) for each in (work, mended))
        mended = mended if explains_more(after, before) else None
    judged = None if mended is None else mended.judgement
    kept = {each.kind for each in judgement.warnings} - mended_kinds
    if mended is None or judged is None or any(each.kind not in kept for each in _errors(mended)):
        return _without_align(work) if moved else work
    prepared = [
        replace(each, text=f"{moved} {each.text} --as-stored keeps their places.")
        if moved and each.kind is IMAGES_ALIGNED
        else each
        for each in mended.made.warnings
    ]
    codes = tuple(each.code for each in faults)
    capture = replace(mended.made, warnings=(*prepared, *notes), mended=codes)
    judgement = judgement._replace(warnings=judged.warnings)
    return replace(mended, options=work.options, capture=capture, judgement=judgement)


def _errors(work: Work) -> list[CaptureWarning]:
    return [each for each in work.judgement.warnings if each.is_error] if work.judgement else []


def _in_order_of(
    lights: Float64Array, source: Source, indices: Sequence[int]
) -> Float64Array | None:
    """Return the intensities (F, 3) that belong to the lights in another order, if the images were
    exchanged rather than lines of the light file; None if they are not in another order.
    """
    given, places = source.light_directions[list(indices)], np.array(indices)
    order = np.argmax(lights @ given.T, axis=1)
    if not source.intensities_measured or not np.allclose(given[order], lights, atol=1e-6):
        return None
    intensities = source.light_intensities.copy()
    intensities[places] = intensities[places[order]]
    return intensities


def _without_align(work: Work) -> Work:
    """Return the work without the advice to align in its warnings, because aligning was tried."""
    assert work.judgement is not None
    warnings = tuple(
        replace(each, text=each.text.replace(ALIGN_ADVICE, "Photograph from a tripod."))
        for each in work.judgement.warnings
    )
    return replace(work, judgement=work.judgement._replace(warnings=warnings))


def refine(work: Work, _: Callable[[], object]) -> Work:
    """Refine rough light directions; see refine_capture."""
    options, known = work.options, work.source.intensities_known
    refined = refine_capture(work.made, error_deg=options.light_error_deg, intensities_known=known)
    return replace(work, capture=refined)


def _compares_colours(work: Work) -> bool:
    """Return whether the lamps may differ in colour and have not been compared yet."""
    return work.source.lamps_may_differ and not (work.colours_known or work.options.as_stored)


def _mends(work: Work) -> bool:
    judged = work.judgement
    return work.options.mends and judged is not None and judged.remedy is not None


def _finds_mask(work: Work) -> bool:
    return (work.options.auto_mask or _needs_outline(work)) and not work.source.has_mask


def _needs_outline(work: Work) -> bool:
    """Return whether to look for a mask, because the outline helps to estimate the lights."""
    return work.finds_lights and work.options.refuses_lights


def _used(work: Work) -> int:
    return len(work.indices)


def _every(work: Work) -> int:
    return work.source.n_lights


@dataclass(frozen=True)
class Step:
    """A row of STEPS."""

    name: str
    run: Callable[[Work, Callable[[], object]], Work]
    is_wanted: Callable[[Work], bool] = lambda work: True
    n_images: Callable[[Work], int] = lambda work: 0  # number of images that it reads
    note: str = ""  # beside their progress


STEPS = (
    Step("mask", find_mask, _finds_mask, _every, "finding the object"),
    Step(
        "colours",
        find_colours,
        lambda work: work.options.align and _compares_colours(work),
        _used,
        "comparing colours",
    ),
    Step("registration", register, lambda work: work.options.align, _used, "aligning"),
    Step(
        "mask of aligned images",
        find_mask,
        lambda work: work.options.align and _finds_mask(work),
        _every,
        "finding the object",
    ),
    Step("observations", observe, n_images=_used, note="reading"),
    Step("lights", find_lights, lambda work: work.finds_lights),
    Step("intensities", divide_by_intensities, lambda work: not work.options.as_stored),
    Step("saturation", restore, lambda work: not work.options.as_stored),
    Step("judgement", judge, lambda work: work.options.judges),
    Step("mending", mend, _mends),
    Step("refinement", refine, lambda work: work.options.refine_lights),
)
_PLACES = {step.name: place for place, step in enumerate(STEPS)}


def follow(
    work: Work,
    first: str = STEPS[0].name,
    until: str | None = None,
    advance: Advance = lambda amount, note: None,
) -> Work:
    """Return the work after those steps that it needs, from `first` to the one before `until`."""
    for step in STEPS[_PLACES[first] : None if until is None else _PLACES[until]]:
        if step.is_wanted(work):
            work = step.run(work, lambda note=step.note: advance(1, note))  # type: ignore[misc]
    return work


def images_to_read(work: Work) -> int:
    """Return the number of images that the recipe reads, counting an image each time it is read."""
    return sum(step.n_images(work) for step in STEPS if step.is_wanted(work))


def begin(
    source: Source, light_indices: Sequence[int] | None = None, options: RecipeOptions = USUAL
) -> Work:
    """Return the initial Work, before the first step, for the images of the chosen lights (None for
    all).

    Raises UsageError if an index is out of range or repeated, or if there are fewer than three.
    """
    every = tuple(range(source.n_lights))
    indices = every if light_indices is None else check_light_indices(light_indices, len(every))
    return Work(source, indices, options)


def prepare_capture(
    source: Source,
    light_indices: Sequence[int] | None = None,
    options: RecipeOptions = USUAL,
    advance: Advance = lambda amount, note: None,
) -> Capture:
    """Return the capture under the chosen lights (None for all), in the order given.

    Only the images of these lights are read, one at a time. Values outside the mask are ignored.
    Raises the errors of `begin` and of the steps.

    Examples:
        >>> from splinecli.capture import CaptureOptions, open_capture
        >>> from splinecli.recipe.steps import prepare_capture
        >>> capture = prepare_capture(open_capture("examples/medallion"), [0, 2, 4])
        >>> capture.observations.shape, capture.light_directions.shape
        ((11836, 3), (3, 3))
    """
    return follow(begin(source, light_indices, options), until="judgement", advance=advance).made


def read_capture(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
    light_indices: Sequence[int] | None = None,
    as_stored: bool = False,
) -> Capture:
    """Return the capture in a folder, opened with open_capture and read with prepare_capture.

    Examples:
        >>> from splinecli.recipe import read_capture
        >>> read_capture("examples/medallion").n_lights
        10
    """
    source = open_capture(
        folder,
        CaptureOptions(
            lights=lights, intensities=intensities, mask=mask, ground_truth=ground_truth
        ),
    )
    return prepare_capture(source, light_indices, RecipeOptions(as_stored=as_stored))
