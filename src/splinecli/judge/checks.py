"""The checks of a capture's lights and images against each other, which `infer` and `info` make, in
their order.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.sample import leave_out_background
from splinecli.capture.source import Source
from splinecli.errors import InputError
from splinecli.images.lamps import estimate_light_intensities
from splinecli.judge.evidence import Evidence
from splinecli.judge.explanations import LIKELY, SRGB_EXPONENT, Explanation, Kind
from splinecli.judge.light_check import LightCheck, light_warnings
from splinecli.judge.odd_images import check_ground_truth
from splinecli.lights.light_fit import would_refine
from splinecli.lights.rough_normals import median_turn_deg
from splinecli.maths import Float64Array, Floats
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.robust import fit_robustly
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning, WarningKind

LEAST_EXPECTED = 0.1  # smallest expected share of normals within 5 degrees without a warning
# Largest ratio of residuals at which another reading shows that lights and images belong together:
# with wrong or moved ones, no reading reduces the residual as much. Intensities are an exception:
# on flat objects they explain any order.
DECISIVE = 0.35
_MOST_NAMED = 4  # shifted images in a sentence


def shifted_images(seen: Evidence) -> Iterator[CaptureWarning]:
    shifts, names = seen.shifts, seen.names
    if not shifts:
        return
    named = ", ".join(f"{names[shift.place]} {shift}" for shift in shifts[:_MOST_NAMED])
    more = f" and {len(shifts) - _MOST_NAMED} more" if len(shifts) > _MOST_NAMED else ""
    text = (
        f"{len(shifts)} of {len(names)} images {'is' if len(shifts) == 1 else 'are'} shifted"
        f" against the others, in pixels: {named}{more}. The camera or the object moved. Add"
        " --align, or photograph from a tripod."
    )
    yield CaptureWarning(codes.IMAGES_SHIFTED, text, seen.shift_error_deg)


def other_scale(seen: Evidence) -> Iterator[CaptureWarning]:
    """Warn of an image with the values of a camera of fewer bits than the files of the others."""
    values, lights = np.asarray(seen.observations, np.float64), seen.directions
    # one image may be much brighter
    values = values / np.maximum(np.median(values, axis=1, keepdims=True), 1e-12)
    predicted = fit_robustly(values, np.ones_like(values), lights, 6)[0] @ lights.T
    lit = predicted > 0.3  # of a pixel's median
    for place, name in enumerate(seen.names):
        if np.count_nonzero(lit[:, place]) < 30:
            continue
        factor = float(np.median(values[lit[:, place], place] / predicted[lit[:, place], place]))
        stops = abs(np.log2(max(factor, 1e-6)))
        # The bits that cameras of 12, 10 and 8 bits leave unused in 16-bit files, and by how many
        # bits the brightness of an image may differ from them.
        bits = min((4, 6, 8), key=lambda bits: abs(bits - stops))
        if abs(bits - stops) > 0.2:
            continue
        mended = seen.observations.copy()
        mended[:, place] /= factor
        how = f"{1 / factor:.0f} times darker" if factor < 1 else f"{factor:.0f} times brighter"
        text = (
            f"{name} is {how} than the other images predict, as if it had {16 - bits} bits and the"
            " others 16, or vice versa. Save all images with the same bit depth, or scale it by"
            f" 2^{bits}."
        )
        yield CaptureWarning(
            codes.IMAGE_SCALE, text, median_turn_deg(seen.observations, lights, lights, mended)
        )


def odd_image(seen: Evidence) -> list[CaptureWarning]:
    """Warn of an image that contradicts the others, and is not only shifted."""
    for name, largest in zip(seen.names, seen.sample.observations.max(axis=0), strict=True):
        if largest <= 0:
            text = (
                f"{name} is black: its lamp probably failed. Photograph it again, or leave it out."
            )
            return [
                CaptureWarning(
                    codes.IMAGE_INCONSISTENT, text, _turn_by_deg(seen, [seen.names.index(name)])
                )
            ]
    odd = seen.light_check.odd_image
    if odd is None or odd.place in [shift.place for shift in seen.shifts]:
        return []
    how = (
        ""
        if odd.brightness is None
        else f" and is {odd.brightness:.2f} times as bright as they predict"
    )
    text = (
        f"{seen.names[odd.place]} contradicts the other images{how}: leaving it out reduces the"
        f" residual to {100 * odd.left:.0f} %. Its lamp may have moved or failed, its exposure may"
        " differ, or a shadow may have fallen on the object. Photograph it again, or leave it"
        " out."
    )
    return [CaptureWarning(codes.IMAGE_INCONSISTENT, text, _turn_by_deg(seen, [odd.place]))]


def _turn_by_deg(seen: Evidence, places: list[int]) -> float | None:
    """Return by how many degrees images change the normals found from the others; None with too few
    others.
    """
    others = [place for place in range(len(seen.names)) if place not in places]
    if len(others) < 3:
        return None
    observations, lights = seen.observations, seen.directions
    return median_turn_deg(observations, lights, lights[others], observations[:, others])


def missing_mask(seen: Evidence) -> Iterator[CaptureWarning]:
    if seen.background > 0.5:  # the share of near black pixels
        text = (
            f"{100 * seen.background:.0f} % of the pixels are nearly black. If they are"
            " background, their normals"
        )
        text += " are meaningless: add --auto-mask, or give a mask."
        yield CaptureWarning(codes.NO_MASK, text)


def crowded_lights(seen: Evidence) -> Iterator[CaptureWarning]:
    spread, in_cone = light_spread(seen.directions)
    if spread < 0.1:  # see light_spread; such lights determine the normals poorly
        where = "in a narrow cone" if in_cone else "nearly in one plane with the object"
        text = (
            f"All lights are {where}, which amplifies noise and errors of their directions by a"
            " factor of about"
        )
        text += f" {1 / max(spread, 1e-3):.0f} in the normals. Add lights from other sides."
        yield CaptureWarning(codes.LIGHTS_ILL_CONDITIONED, text)


def same_images(seen: Evidence) -> Iterator[CaptureWarning]:
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
        text += " Remove one, or replace it by its own photograph."
        # Either image of a pair may be the wrong one.
        wrong = [sorted({pair[which] for pair in pairs}) for which in (0, 1)] if differ else []
        errors_deg = [
            error for places in wrong if (error := _turn_by_deg(seen, places)) is not None
        ]
        yield CaptureWarning(codes.REPEATED_IMAGES, text, max(errors_deg, default=None))


def rough_lights(seen: Evidence) -> list[CaptureWarning]:
    """Suggest refining the lights if this makes them fit much better."""
    if (
        seen.has_positions
        or (refined := would_refine(seen.observations, seen.factors, seen.directions)) is None
    ):
        return []
    moved_deg = angle_between_deg(refined.directions, seen.directions)
    text = (
        f"The light directions are probably inaccurate: moving them by {moved_deg.mean():.1f}"
        f" degrees on average reduces the residual to {100 * refined.fit_ratio:.0f} %. Try"
        " --refine-lights."
    )
    return [CaptureWarning(codes.ROUGH_LIGHTS, text)]


def other_readings(seen: Evidence, largest_ratio: float = 1.0) -> list[CaptureWarning]:
    """Warn of images that fit much better if they are read in another way; see explanations.py.

    Readings that leave more than the largest ratio of the residual are not named.
    """
    if seen.doubt is None or seen.doubt.probability < LIKELY:
        return []
    reading = seen.doubt.reading
    if reading.ratio > largest_ratio or (reading.kind == "intensities" and largest_ratio < 1):
        return []
    if reading.kind == "intensities" and seen.intensities is None:
        observations = np.asarray(seen.observations, np.float32)
        if estimate_light_intensities(observations, None, seen.directions) is not None:
            return []  # `infer` estimates them, and reports it
    error_deg = seen.explanations.error_deg(reading, seen.estimated)
    left = f"the residual falls to {100 * reading.ratio:.0f} %"
    if seen.doubt.others:
        causes = " and ".join(_CAUSES[kind] for kind in seen.doubt.others)
        left += f", although {causes} would explain the images nearly as well"
    if reading.kind == "curve":
        text = (
            "The images look display-encoded but are read as linear: if their values are decoded,"
            f" {left}. Add --transfer"
            f" srgb{'' if reading.amount == SRGB_EXPONENT else f' or gamma:{reading.amount:g}'}."
        )
        return [CaptureWarning(codes.NONLINEARITY_SUSPECTED, text, error_deg)]
    if reading.kind == "near":
        text = (
            f"The lamps look near, about {reading.amount:.1f} widths of the object away, but are"
            f" treated as distant: at this distance, {left}. Measure the distance and the width of"
            f" the object, or try --light-distance {reading.amount:.1f} --object-width 1."
        )
        return [CaptureWarning(codes.NEAR_LIGHTS_SUSPECTED, text, error_deg)]
    if reading.kind == "offset":
        text = (
            "All images look as if they contained ambient light, or a black level that was not"
            f" subtracted: {100 * reading.amount:.0f} % of the light of a lamp. Without it,"
            f" {left}. Photograph the object with all lamps off and give this image with"
            " --ambient."
        )
        return [CaptureWarning(codes.CONSTANT_LIGHT, text, error_deg)]
    return [
        CaptureWarning(codes.UNEQUAL_INTENSITIES, _intensities_text(seen, reading, left), error_deg)
    ]


_CAUSES: dict[Kind, str] = {
    "curve": "a transfer curve (--transfer)",
    "near": "near lamps (--light-distance)",
    "offset": "ambient light (--ambient)",
    "intensities": "unequal intensities (--intensities)",
}


def _intensities_text(seen: Evidence, reading: Explanation, left: str) -> str:
    given = seen.intensities
    if given is None:
        return (
            f"The lights seem to differ in intensity: with other intensities, {left}. The images"
            " do not determine them, so equal ones are assumed. Measure them with calibrate"
            " --gray-card, or give them with --intensities FILE."
        )
    needed = np.log(given * reading.intensities)
    ways = {
        "if they are left out": np.zeros_like(given),
        "if they are inverted": -np.log(given),
        "in reversed order": np.log(given[::-1]),
    }
    errors = {words: float(np.std(needed - way)) for words, way in ways.items()}
    words = min(errors, key=lambda each: errors[each])
    # A simple reading of the file leaves at most this share of the spread.
    how = (
        f", for example {words}"
        if errors[words] < 0.4 * np.std(np.log(reading.intensities))
        else ""
    )
    return (
        f"The given light intensities do not fit the images: with others{how}, {left}. Check that"
        " their file is in the order of the images, or leave them out with --intensities equal."
    )


def few_lights(seen: Evidence) -> list[CaptureWarning]:
    """Warn of fewer lights than eight, unless they are channels: one colour image has three."""
    count = len(seen.names)
    few = count < 8 and not seen.in_channels
    return [
        CaptureWarning(codes.FEW_LIGHTS, f"There are {count} lights; use 8 or more, well spread.")
    ] * few


def lights_near_axis(seen: Evidence) -> list[CaptureWarning]:
    """Warn of lights that all shine from near the camera."""
    if np.degrees(np.arccos(seen.directions[:, 2].clip(-1, 1))).max() >= 25:
        return []
    text = "All lights are within 25 degrees of the camera axis; lower lights give better normals."
    return [CaptureWarning(codes.LIGHTS_NEAR_AXIS, text)]


REPEATED = frozenset({codes.REPEATED_IMAGES})  # if the lights differ, these contradict all others
# After these warnings, no check that relies on the lights is reliable.
DOUBTED = REPEATED | {
    codes.IMAGES_SHIFTED,
    codes.IMAGE_INCONSISTENT,
    codes.LIGHT_ORDER,
    codes.LIGHT_FRAME,
    codes.LIGHTS_ILL_CONDITIONED,
}
# After these warnings, the normals do not determine the lights' frame, nor the images their order.
READ_OTHERWISE = frozenset(
    {codes.NONLINEARITY_SUSPECTED, codes.NEAR_LIGHTS_SUSPECTED, codes.CONSTANT_LIGHT}
)


@dataclass(frozen=True)
class Check:
    """A row of CHECKS."""

    find: Callable[[Evidence], Iterable[CaptureWarning]]
    unless: frozenset[WarningKind] = frozenset()  # earlier warnings after which it is skipped
    needs_lights: bool = True  # whether it is skipped if the lights were estimated from the images


# The checks of a capture's lights and images, in their order
CHECKS = [
    Check(same_images, needs_lights=False),
    Check(lambda seen: other_readings(seen, DECISIVE), REPEATED),
    Check(shifted_images, READ_OTHERWISE, needs_lights=False),
    Check(other_scale, REPEATED),
    Check(odd_image, REPEATED | {codes.IMAGE_SCALE}),
    Check(
        lambda s: light_warnings(s.light_check, s.origin, s.frame, s.strict),
        REPEATED | READ_OTHERWISE,
    ),
    Check(missing_mask, needs_lights=False),
    Check(few_lights, needs_lights=False),
    Check(lights_near_axis),
    Check(crowded_lights),
    Check(lambda seen: check_ground_truth(seen.evened, seen.directions, seen.truth), DOUBTED),
    Check(other_readings, DOUBTED | READ_OTHERWISE),
    Check(rough_lights, DOUBTED | READ_OTHERWISE),
]


class Judgement(NamedTuple):
    """What the checks found."""

    warnings: tuple[CaptureWarning, ...]
    light_check: LightCheck | None  # None if the lights were estimated from the images


def check_capture(source: Source, capture: Capture, *, strict: bool = False) -> Judgement:
    """Check the lights and images of a capture that was prepared from this source.

    With `strict`, properties that the images leave undetermined are warnings, too.

    Examples:
        >>> from splinecli.capture import open_capture
        >>> from splinecli.judge.checks import check_capture
        >>> from splinecli.recipe import prepare_capture
        >>> source = open_capture("examples/medallion")
        >>> check_capture(source, prepare_capture(source)).warnings
        ()
    """
    seen = Evidence.of(source, capture, strict=strict)
    # without dark background
    (sample, background), (closeup, _) = (
        leave_out_background(seen.sample),
        leave_out_background(seen.closeup),
    )
    seen = replace(seen, sample=sample, closeup=closeup, background=background)
    warnings: list[CaptureWarning] = []
    for check in CHECKS:
        if not (seen.found and check.needs_lights) and check.unless.isdisjoint(
            each.kind for each in warnings
        ):
            warnings += check.find(seen)
    return Judgement(tuple(warnings), None if seen.found else seen.light_check)


def light_spread(light_directions: Float64Array) -> tuple[float, bool]:
    """Return how well lights (F, 3) determine a normal, and whether they form a cone rather than a
    plane.

    The first is their smallest singular value over sqrt(F): the error of a normal is about the
    error of an observation over it. It is 0 for coplanar lights, 0.58 for lights that are spread
    over the whole sphere.
    """
    values = np.linalg.svd(light_directions, compute_uv=False) / np.sqrt(len(light_directions))
    return float(values[-1]), bool(values[-2] < 2 * values[-1])


def repeated_images(observations: Floats) -> list[tuple[int, int]]:
    """Return the first image and each later one among observations (P, F) that are equal up to a
    scale, and not uniform.
    """
    values = observations.astype(np.float64)
    values = values / np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    varied = np.ptp(values, axis=0) > 0
    # One minus the cosine between two images that are the same, up to rounding. Noise gives 1e-6
    # and more.
    same = (1 - values.T @ values < 1e-12) & varied[:, None]
    pairs = zip(same.argmax(axis=0).tolist(), range(len(same)), strict=True)
    return [(first, second) for first, second in pairs if first < second and varied[second]]


def check_confidence(expected_under_5: float | None) -> list[CaptureWarning]:
    """Warn of a capture of which the network expects hardly any normal to be right; None is a
    method without this.
    """
    if expected_under_5 is None or expected_under_5 >= LEAST_EXPECTED:
        return []
    text = (
        f"The network expects only {100 * expected_under_5:.0f} % of the normals to be within 5"
        " degrees. The lights, the mask or the images are probably wrong: see"
        " docs/troubleshooting.md."
    )
    return [CaptureWarning(codes.LOW_CONFIDENCE, text)]


def refuse_if_strict(warnings: Iterable[CaptureWarning], name: str, *, strict: bool) -> None:
    """Raise InputError for the first warning that says that an input is probably wrong, if
    `strict`.
    """
    wrong = next((warning for warning in warnings if warning.is_error), None)
    if strict and wrong is not None:
        raise InputError(
            f"{name}: {wrong.text.removesuffix('.')}",
            hint="Leave --strict out to go on nevertheless",
        )
