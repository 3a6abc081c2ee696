"""Check that the lights and images of a capture are consistent, as `infer` and `info` do."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.sample import leave_out_background
from splinecli.capture.source import Source
from splinecli.errors import InputError
from splinecli.estimate.confidence import COMMON_SHAPE
from splinecli.images.lamps import estimate_light_intensities
from splinecli.judge.evidence import Evidence
from splinecli.judge.explanations import CLEAR, LIKELY, SRGB_EXPONENT, Doubt, Explanation
from splinecli.judge.judge_net import TILTED, TRANSLUCENT
from splinecli.judge.light_check import WRITES_MENDED, LightCheck, light_warnings
from splinecli.judge.odd_images import check_ground_truth
from splinecli.lights.light_fit import would_refine
from splinecli.lights.rough_normals import median_turn_deg
from splinecli.maths import Float64Array, Floats
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.robust import fit_robustly
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning, WarningKind

ALIGN_ADVICE = "Add --align, or photograph from a tripod."
TILT_ADVICE = (
    "They may have been measured in a frame other than the camera's, such as the table's. Tilt them"
    " back"
)
LEAST_EXPECTED = 0.1  # smallest expected share of normals within 5 degrees without a warning
# If another reading reduces the residual to at most this share, lights and images belong together,
# because no reading reduces it as much with wrong lights or moved images.
DECISIVE = 0.35
_MOST_NAMED = 4  # shifted images in a sentence
# Readings that are named although none is likely: the least probability of each and of all, and the
# least expected change of the normals, chosen on rendered captures (benchmarks/judgement.py).
_NAMED_SHARE, _LEAST_DOUBT, _UNDECIDED_DEG = 0.03, 0.1, 2.0
_TRANSLUCENT_DEG = 8.0  # the usual median error of normals of translucent objects


class Finding(NamedTuple):
    """A fault that a check found."""

    warning: CaptureWarning
    # the evidence with the fault corrected, for the next checks; None if it cannot be corrected
    after: Evidence | None = None
    # whether the fault is clear enough to be corrected by default
    clear: bool = False
    # whether the next checks remain reliable if the fault is not corrected
    harmless: bool = False
    cause: str = ""  # a sentence, for a fault that can be corrected


def shifted_images(seen: Evidence) -> Iterator[Finding]:
    shifts, names = seen.shifts, seen.names
    if not shifts:
        return
    after = seen.moved_back(shifts)
    if not explains_more(after, seen):
        return
    named = ", ".join(f"{names[shift.place]} {shift}" for shift in shifts[:_MOST_NAMED])
    more = f" and {len(shifts) - _MOST_NAMED} more" if len(shifts) > _MOST_NAMED else ""
    cause = (
        f"{len(shifts)} of {len(names)} images {'is' if len(shifts) == 1 else 'are'} shifted"
        f" relative to the others, in pixels: {named}{more}. The camera or the object moved."
    )
    text = f"{cause} {ALIGN_ADVICE}"
    warning = CaptureWarning(codes.IMAGES_SHIFTED, text, seen.shift_error_deg)
    yield Finding(warning, after, not seen.found, cause=cause)


def explains_more(after: Evidence, before: Evidence) -> bool:
    """Return whether three images explain the others better once images are moved back, and, under
    given lights, the normals have no more curl than before.
    """
    if after.factors is None or before.factors is None:
        return False
    explained = after.factors.residual < 0.95 * before.factors.residual
    if before.found or not explained:
        return explained
    return bool(after.tilt and before.tilt and after.tilt.curl < 1.05 * before.tilt.curl)


def other_scale(seen: Evidence) -> Iterator[Finding]:
    """Warn about an image whose bit depth seems to differ from the others."""
    values, lights = np.asarray(seen.observations, np.float64), seen.directions
    # one image may be much brighter than the others
    values = values / np.maximum(np.median(values, axis=1, keepdims=True), 1e-12)
    predicted = fit_robustly(values, np.ones_like(values), lights, 6)[0] @ lights.T
    lit = predicted > 0.3  # of a pixel's median
    for place, name in enumerate(seen.names):
        if np.count_nonzero(lit[:, place]) < 30:
            continue
        ratios = values[lit[:, place], place] / predicted[lit[:, place], place]
        factor = float(np.median(ratios))
        # Gloss and shadow scale pixels differently.
        alike = np.abs(ratios / max(factor, 1e-12) - 1) < 0.3
        if alike.mean() < 0.6:
            continue
        stops = abs(np.log2(max(factor, 1e-6)))
        # Cameras with 12, 10 and 8 bits leave 4, 6 and 8 bits of 16-bit files unused. The
        # brightness of an image may deviate from this by 0.2 bits.
        bits = min((4, 6, 8), key=lambda bits: abs(bits - stops))
        if abs(bits - stops) > 0.2:
            continue
        scales = np.ones(len(seen.names))
        scales[place] = 1 / factor
        mended = seen.observations * scales
        how = f"{1 / factor:.0f} times darker" if factor < 1 else f"{factor:.0f} times brighter"
        text = (
            f"{name} is {how} than the other images predict, as if it had {16 - bits} bits and the"
            " others 16, or vice versa. Save all images with the same bit depth, or scale it by"
            f" 2^{bits if factor < 1 else -bits}."
        )
        error_deg = median_turn_deg(seen.observations, lights, lights, mended)
        seen = seen.scaled(scales)
        yield Finding(CaptureWarning(codes.IMAGE_SCALE, text, error_deg), seen)


def odd_image(seen: Evidence) -> Iterator[Finding]:
    """Warn about an image that contradicts the others for a reason other than a shift."""
    for name, largest in zip(seen.names, seen.sample.observations.max(axis=0), strict=True):
        if largest <= 0:
            place = seen.names.index(name)
            text = f"{name} is black, probably because its lamp failed. {_again(seen, place)}"
            error_deg = _turn_by_deg(seen, [place])
            yield Finding(
                CaptureWarning(codes.IMAGE_INCONSISTENT, text, error_deg), seen.without(place)
            )
            return
    odd = seen.light_check.odd_image
    if odd is None or odd.place in seen.moved:
        return
    how = (
        ""
        if odd.brightness is None
        else f" and is {odd.brightness:.2f} times as bright as they predict"
    )
    text = (
        f"{seen.names[odd.place]} contradicts the other images{how}: leaving it out reduces the"
        f" residual to {100 * odd.left:.0f} %. Its lamp may have moved or failed, its exposure may"
        f" differ, or a shadow may have fallen on the object. {_again(seen, odd.place)}"
    )
    error_deg = _turn_by_deg(seen, [odd.place])
    yield Finding(
        CaptureWarning(codes.IMAGE_INCONSISTENT, text, error_deg), seen.without(odd.place)
    )


def _again(seen: Evidence, place: int) -> str:
    """Return the advice about an image that is to be left out."""
    others = [str(index) for index in seen.indices if index != seen.indices[place]]
    named = f" {','.join(others)}" if len(others) <= 20 else ""
    return f"Photograph it again, or leave it out with --light-indices{named}."


def _turn_by_deg(seen: Evidence, places: list[int]) -> float | None:
    """Return the median angle in degrees by which images change the normals estimated from the
    others; None if fewer than three others are left.
    """
    others = [place for place in range(len(seen.names)) if place not in places]
    if len(others) < 3:
        return None
    observations, lights = seen.observations, seen.directions
    return median_turn_deg(observations, lights, lights[others], observations[:, others])


def missing_mask(seen: Evidence) -> Iterator[Finding]:
    if seen.background > 0.5:  # the share of near black pixels
        text = (
            f"{100 * seen.background:.0f} % of the pixels are nearly black. If they are"
            " background, their normals"
        )
        text += " are meaningless, so add --auto-mask or pass a mask."
        yield Finding(CaptureWarning(codes.NO_MASK, text))


def crowded_lights(seen: Evidence) -> Iterator[Finding]:
    spread, in_cone = light_spread(seen.directions)
    if spread < 0.1:  # see light_spread; such lights determine the normals poorly
        where = "in a narrow cone" if in_cone else "nearly in one plane with the object"
        text = (
            f"All lights are {where}, which amplifies noise and errors in the light directions by a"
            f" factor of about {1 / max(spread, 1e-3):.0f}. Add lights from other sides."
        )
        yield Finding(CaptureWarning(codes.LIGHTS_ILL_CONDITIONED, text))


def same_images(seen: Evidence) -> Iterator[Finding]:
    pairs = sorted({*repeated_images(seen.sample.observations), *seen.copies})
    differ = "" if seen.found else ", but their lights differ"
    if differ:
        # Images under lights closer than this may be the same.
        pairs = [pair for pair in pairs if angle_between_deg(*seen.directions[list(pair)]) > 0.01]
    if pairs:
        first, second = (seen.names[place] for place in pairs[0])
        others = len(pairs) - 1
        more = f" (and {others} more pair{'s' if others > 1 else ''})" if others else ""
        text = f"{first} and {second} are the same image{more}{differ}."
        text += " Remove one, or replace it with the right photograph."
        # Either image of a pair may be the wrong one.
        wrong = [sorted({pair[which] for pair in pairs}) for which in (0, 1)] if differ else []
        errors_deg = [
            error for places in wrong if (error := _turn_by_deg(seen, places)) is not None
        ]
        yield Finding(CaptureWarning(codes.REPEATED_IMAGES, text, max(errors_deg, default=None)))


def wrong_lights(seen: Evidence) -> Iterator[Finding]:
    """Warn about lights in a wrong frame or order."""
    check = seen.light_check
    mended = None if check.mended is None else seen.under_lights(check.mended)
    for warning, cause in light_warnings(check, seen.origin, seen.frame, seen.strict):
        after = mended if cause else None
        # Lights in another frame explain the images equally well.
        yield Finding(warning, after, check.is_clear, warning.kind == codes.LIGHT_FRAME, cause)


def tilted_lights(seen: Evidence) -> Iterator[Finding]:
    """Warn about a common tilt of all lights."""
    tilt, probability = seen.tilt, seen.shares.get(TILTED, 0.0)
    if seen.has_positions or tilt is None or probability < LIKELY:
        return
    mended = seen.directions @ tilt.matrix.T
    cause = f"The lights of {seen.origin.name} {tilt.cause}"
    text = f"{cause} {TILT_ADVICE}, as {WRITES_MENDED} does."
    error_deg = median_turn_deg(seen.observations, seen.directions, mended)
    warning = CaptureWarning(codes.LIGHTS_TILTED, text, error_deg)
    yield Finding(warning, seen.under_lights(mended), probability > CLEAR, cause=cause)


def strange_material(seen: Evidence) -> Iterator[Finding]:
    """Warn about a translucent material, which no method models."""
    if seen.shares.get(TRANSLUCENT, 0.0) < LIKELY:
        return
    text = (
        "The object looks translucent, like wax, marble or skin. Light that enters such a material"
        " softens the shading, so every method flattens the normals by several degrees."
    )
    yield Finding(CaptureWarning(codes.UNKNOWN_MATERIAL, text, _TRANSLUCENT_DEG))


def rough_lights(seen: Evidence) -> Iterator[Finding]:
    """Suggest refining the lights if they then fit much better."""
    if (
        seen.has_positions
        or (refined := would_refine(seen.observations, seen.factors, seen.directions)) is None
    ):
        return
    after = seen.under_lights(refined.directions).tilt
    # On gloss and fabric, refining also reduces the residual, but the normals then fit a surface
    # worse.
    if seen.tilt is not None and after is not None and after.curl > 0.98 * seen.tilt.curl:
        return
    moved_deg = angle_between_deg(refined.directions, seen.directions)
    text = (
        f"The light directions are probably inaccurate: moving them by {moved_deg.mean():.1f}"
        f" degrees on average reduces the residual to {100 * refined.fit_ratio:.0f} %. Try"
        " --refine-lights."
    )
    yield Finding(CaptureWarning(codes.ROUGH_LIGHTS, text))


def decisive_readings(seen: Evidence) -> Iterator[Finding]:
    """Warn about other readings that fit so much better that lights and images must belong
    together.
    """
    return other_readings(seen, DECISIVE, CLEAR)


def other_readings(
    seen: Evidence, largest_ratio: float = 1.0, least: float = LIKELY
) -> Iterator[Finding]:
    """Warn about other ways to read the images that fit much better; see explanations.py.

    Each reading is accepted before the others are compared again. Readings that leave more than
    `largest_ratio` of the residual, or are less probable than `least`, are not reported.
    """
    while (doubt := seen.doubt) is not None:
        reading = doubt.reading
        if reading.ratio > largest_ratio or doubt.probability < least:
            return
        after = seen.read_as(reading)
        error_deg = seen.explanations.error_deg(reading, seen.estimated)
        found = _words(seen, doubt)
        if found is not None:
            kind, cause, advice = found
            warning = CaptureWarning(kind, f"{cause} {advice}", error_deg)
            clear = doubt.is_clear and kind == codes.NONLINEARITY_SUSPECTED
            yield Finding(warning, after, clear, cause=cause)
        seen = after


def _words(seen: Evidence, doubt: Doubt) -> tuple[WarningKind, str, str] | None:
    """Return the kind, the cause and the advice of the warning about another reading; None if
    `infer` already reads the images that way.
    """
    reading = doubt.reading
    left = f"the residual falls to {100 * reading.ratio:.0f} %"
    if doubt.others:
        causes = " and ".join(_CAUSES[kind] for kind in doubt.others)
        left += f", although {causes} would explain the images nearly as well"
    if reading.kind == "curve":
        curve = "srgb" if reading.amount == SRGB_EXPONENT else f"srgb or gamma:{reading.amount:g}"
        cause = "The images look display-encoded but are read as linear: if their values are"
        return codes.NONLINEARITY_SUSPECTED, f"{cause} decoded, {left}.", f"Add --transfer {curve}."
    if reading.kind == "near":
        cause = (
            f"The lamps look near, about {reading.amount:.1f} widths of the object away, but are"
            f" treated as distant: at this distance, {left}."
        )
        advice = (
            "Measure the distance of the lamps and the width of the object, or try --light-distance"
            f" {reading.amount:.1f} --object-width 1."
        )
        return codes.NEAR_LIGHTS_SUSPECTED, cause, advice
    if reading.kind == "offset":
        cause = (
            "All images seem to contain ambient light, or a black level that was not subtracted, of"
            f" about {100 * reading.amount:.0f} % of a lamp's light: without it, {left}."
        )
        advice = "Photograph the object with all lamps off, and pass this image with --ambient."
        return codes.CONSTANT_LIGHT, cause, advice
    if reading.kind == "elevation":
        how = "low" if reading.amount > 1 else "high"
        cause = (
            f"The lights of {seen.origin.name} look too {how}: with their z multiplied by"
            f" {reading.amount:g}, {left}."
        )
        return (
            codes.ELEVATION_SUSPECTED,
            cause,
            f"Correct their elevations, as {WRITES_MENDED} does.",
        )
    observations = np.asarray(seen.observations, np.float32)
    if seen.intensities is not None:
        return codes.UNEQUAL_INTENSITIES, *_of_given_intensities(seen.intensities, reading, left)
    if estimate_light_intensities(observations, None, seen.directions) is not None:
        return None  # `infer` estimates them and says so
    cause = f"The lights seem to differ in intensity: with unequal intensities, {left}."
    advice = (
        "The images do not determine them, so equal ones are assumed. Measure them with calibrate"
        " --gray-card, or pass them with --intensities FILE."
    )
    return codes.UNEQUAL_INTENSITIES, cause, advice


_CAUSES = {
    TRANSLUCENT: "a translucent material",
    TILTED: "lights tilted together",
    "curve": "a transfer curve (--transfer)",
    "near": "near lamps (--light-distance)",
    "offset": "ambient light (--ambient)",
    "intensities": "unequal intensities (--intensities)",
    "elevation": "wrong elevations of the lights",
}


def _of_given_intensities(given: Float64Array, reading: Explanation, left: str) -> tuple[str, str]:
    """Return the reason why given intensities (F,) are wrong, and the remedy."""
    needed = np.log(given * reading.intensities)
    ways = {
        "if they are left out": np.zeros_like(given),
        "if they are inverted": -np.log(given),
        "in reversed order": np.log(given[::-1]),
    }
    errors = {words: float(np.std(needed - way)) for words, way in ways.items()}
    words = min(errors, key=lambda each: errors[each])
    # A simple reading of the file is named if it leaves less than this share of the spread.
    how = (
        f", for example {words}"
        if errors[words] < 0.4 * np.std(np.log(reading.intensities))
        else ""
    )
    cause = f"The given light intensities do not fit the images: with others{how}, {left}."
    advice = (
        "Check that their file is in the order of the images, or ignore it with --intensities"
        " estimate."
    )
    return cause, advice


def undecided_readings(seen: Evidence) -> list[CaptureWarning]:
    """Return a warning about other readings that are not probable enough to be reported as faults,
    but would together change the normals.
    """
    readings: dict[str, Explanation] = {
        kind: seen.explanations.readings[kind] for kind in seen.open_kinds
    }
    errors_deg = dict[str, float]()
    for kind, share in seen.shares.items():
        if share <= _NAMED_SHARE:
            continue
        if kind == TRANSLUCENT and share < LIKELY:  # otherwise it is named
            errors_deg[kind] = _TRANSLUCENT_DEG
        elif kind == TILTED and seen.tilt is not None and not seen.has_positions:
            lights = seen.directions @ seen.tilt.matrix.T
            errors_deg[kind] = median_turn_deg(seen.observations, seen.directions, lights)
        elif kind in readings:
            errors_deg[kind] = seen.explanations.error_deg(readings[kind], seen.estimated)
    shares = {kind: seen.shares[kind] for kind in errors_deg}
    error_deg = sum(share * errors_deg[kind] for kind, share in shares.items())
    if error_deg < _UNDECIDED_DEG or sum(shares.values()) < _LEAST_DOUBT:
        return []
    likeliest = sorted(shares, key=lambda kind: -shares[kind])[:3]
    named = " or ".join(
        f"{_CAUSES[kind].split(' (')[0]} ({100 * shares[kind]:.0f} %)" for kind in likeliest
    )
    most_deg = max(errors_deg[kind] for kind in likeliest)
    text = (
        f"The images may also be explained by {named}, which would rotate the normals by up to"
        f" {most_deg:.0f} degrees. The images do not rule this out, so the confidence is lowered."
        " Check how the capture was made, or add lights from other sides."
    )
    # No more normals can be accurate than with the probability that none of these readings is true.
    # Otherwise, with half of the error, the expected shares agree with the true ones.
    doubt = min(sum(shares[kind] for kind in shares if errors_deg[kind] > 5), 0.99)
    of_share = 5 * (doubt / (1 - doubt)) ** (1 / COMMON_SHAPE)
    error_deg = max(error_deg / 2, min(of_share, most_deg))
    return [CaptureWarning(codes.UNDECIDED, text, error_deg)]


def few_lights(seen: Evidence) -> list[Finding]:
    """Warn about fewer than eight lights, except for lights in channels, because one colour image
    has three.
    """
    count = len(seen.names)
    few = count < 8 and not seen.in_channels
    text = f"There are {count} lights; use 8 or more, well spread."
    return [Finding(CaptureWarning(codes.FEW_LIGHTS, text))] * few


def lights_near_axis(seen: Evidence) -> list[Finding]:
    """Warn about lights that are all close to the camera axis."""
    if np.degrees(np.arccos(seen.directions[:, 2].clip(-1, 1))).max() >= 25:
        return []
    text = "All lights are within 25 degrees of the camera axis; lower lights give better normals."
    return [Finding(CaptureWarning(codes.LIGHTS_NEAR_AXIS, text))]


def wrong_truth(seen: Evidence) -> Iterator[Finding]:
    """Warn about a ground truth that does not fit the images."""
    for warning in check_ground_truth(seen.evened, seen.directions, seen.truth):
        yield Finding(warning)


# Unless these faults are corrected, no check that depends on the lights is reliable.
DOUBTED = frozenset(
    {
        codes.REPEATED_IMAGES,
        codes.LIGHT_ORDER,
        codes.LIGHT_FRAME,
        codes.LIGHTS_ILL_CONDITIONED,
    }
)


@dataclass(frozen=True)
class Check:
    """A row of CHECKS."""

    find: Callable[[Evidence], Iterable[Finding]]
    needs_lights: bool = True  # whether it is skipped if the lights are unreliable


# The checks, in order. Each uses the evidence in which the faults found so far are corrected.
CHECKS = [
    Check(same_images, needs_lights=False),
    Check(missing_mask, needs_lights=False),
    Check(few_lights, needs_lights=False),
    Check(lights_near_axis),
    Check(crowded_lights),
    Check(decisive_readings),
    Check(shifted_images, needs_lights=False),
    Check(other_scale),
    Check(odd_image),
    Check(wrong_lights),
    Check(other_readings),
    Check(tilted_lights),
    Check(strange_material),
    Check(wrong_truth),
    Check(rough_lights),
]


@dataclass(frozen=True, eq=False)
class Remedy:
    """The changes that correct the clear faults of a capture."""

    faults: tuple[Finding, ...]
    lights: Float64Array | None = None  # (F, 3); None to keep the given ones
    light_error_deg: float | None = None  # of lights that were estimated from the images
    curve: float | None = None  # exponent of the transfer curve; None to keep the given one
    align: bool = False  # whether the images are aligned


class Judgement(NamedTuple):
    """The result of the checks."""

    warnings: tuple[CaptureWarning, ...]
    light_check: LightCheck | None  # None if the lights were estimated from the images
    # (F, 3), the lights with all faults corrected; None if none of them changes, or an image was
    # left out
    mended_lights: Float64Array | None = None
    remedy: Remedy | None = None  # for the clear faults; None if there are none


def check_capture(source: Source, capture: Capture, *, strict: bool = False) -> Judgement:
    """Return the warnings about a capture's lights and images, and the remedy for clear faults.

    The capture must have been prepared from this source. With `strict`, also warn of properties
    that the images leave undetermined.

    Examples:
        >>> from splinecli.capture import open_capture
        >>> from splinecli.judge.checks import check_capture
        >>> from splinecli.recipe import prepare_capture
        >>> source = open_capture("examples/medallion")
        >>> check_capture(source, prepare_capture(source)).warnings
        ()
    """
    seen = Evidence.of(source, capture, strict=strict)
    # leave out dark background
    (sample, background), (closeup, _) = (
        leave_out_background(seen.sample),
        leave_out_background(seen.closeup),
    )
    seen = replace(seen, sample=sample, closeup=closeup, background=background)
    given, warnings = seen, list[CaptureWarning]()
    light_check, remedy, relies = None, Remedy(()), not seen.found  # on the lights
    clear = True
    for check in CHECKS:
        if check.needs_lights and not relies:
            continue
        if check.find is wrong_lights:
            light_check = seen.light_check
        for finding in check.find(seen):
            warnings.append(finding.warning)
            # A fault found after an unclear one is not clear either, because it depends on that
            # one.
            clear &= finding.clear or finding.after is None
            seen = finding.after or seen
            if clear and finding.clear and finding.after is not None:
                remedy = _remedy(given, seen, (*remedy.faults, finding))
            doubted = finding.warning.kind in DOUBTED and not finding.harmless
            relies &= finding.after is not None or not doubted
    if relies and not any(warning.is_error for warning in warnings):
        warnings += undecided_readings(seen)
    if light_check is None and not seen.found:
        light_check = seen.light_check
    mended = _remedy(given, seen, ()).lights
    return Judgement(tuple(warnings), light_check, mended, remedy if remedy.faults else None)


def _remedy(given: Evidence, seen: Evidence, faults: tuple[Finding, ...]) -> Remedy:
    """Return the remedy that turns the given evidence into the evidence with corrected faults."""
    differ = given.indices == seen.indices and (given.directions != seen.directions).any()
    return Remedy(
        faults,
        seen.directions if differ else None,
        curve=seen.curve,
        align=bool(seen.moved - given.moved),
    )


def light_spread(light_directions: Float64Array) -> tuple[float, bool]:
    """Return how well lights (F, 3) determine a normal, and whether they form a cone rather than a
    plane.

    The first value is their smallest singular value over sqrt(F). The error of a normal is about
    the error of an observation divided by this value, which is 0 for coplanar lights and 0.58 for
    lights spread over the whole sphere.
    """
    values = np.linalg.svd(light_directions, compute_uv=False) / np.sqrt(len(light_directions))
    return float(values[-1]), bool(values[-2] < 2 * values[-1])


def repeated_images(observations: Floats) -> list[tuple[int, int]]:
    """Return pairs of images among observations (P, F) that are equal up to a scale. Uniform images
    are ignored. Each later image is paired with the first one that equals it.
    """
    values = observations.astype(np.float64)
    values = values / np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    varied = np.ptp(values, axis=0) > 0
    # Rounding changes the cosine between two equal images by less than this, noise by 1e-6 and
    # more.
    same = (1 - values.T @ values < 1e-12) & varied[:, None]
    pairs = zip(same.argmax(axis=0).tolist(), range(len(same)), strict=True)
    return [(first, second) for first, second in pairs if first < second and varied[second]]


def check_confidence(expected_under_5: float | None) -> list[CaptureWarning]:
    """Warn about a capture if the network predicts large errors for nearly all normals. The share
    is None for methods that do not predict errors.
    """
    if expected_under_5 is None or expected_under_5 >= LEAST_EXPECTED:
        return []
    text = (
        f"The network predicts errors below 5 degrees for only {100 * expected_under_5:.0f} % of"
        " the normals. The lights, the mask or the images are probably wrong; see"
        " docs/troubleshooting.md."
    )
    return [CaptureWarning(codes.LOW_CONFIDENCE, text)]


def refuse_if_strict(
    warnings: Iterable[CaptureWarning],
    name: str,
    *,
    strict: bool,
    mended: Collection[WarningKind] = (),
) -> None:
    """If `strict`, raise InputError for the first warning that an input is probably wrong. Without
    --strict, `infer` corrects the faults of the kinds `mended`, as the hint says.
    """
    wrong = next((warning for warning in warnings if warning.is_error), None)
    if strict and wrong is not None:
        corrected = "Without --strict, infer corrects this"
        hint = corrected if wrong.kind in mended else "Leave --strict out to continue anyway"
        raise InputError(f"{name}: {wrong.text.removesuffix('.')}", hint=hint)
