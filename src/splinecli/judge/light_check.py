"""Detect light directions in a wrong frame or order from the images and the normals.

The thresholds were chosen on captures rendered by splinecli (MERL's measured materials, CyclesPS's
material classes, 6 to 48 lights, with and without errors in their directions); see
docs/measurements.md for the figures.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.light_rows import BOTH_NEGATED, PLANE_FRAMES, LightFrame
from splinecli.judge.light_order import (
    FEWEST_TO_ORDER,
    HALF_LEFT,
    HALF_VECTORS,
    LARGEST_MENDED,
    UNKNOWN_ORDER,
    ZENITH,
    check_order,
)
from splinecli.judge.odd_images import OddImage, find_odd_image
from splinecli.lights.light_fit import Factors, find_factors
from splinecli.lights.rough_normals import RoughNormals, ShadowCheck, median_turn_deg, rough_normals
from splinecli.maths import Bools, Float64Array, Floats, Integers
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning, WarningKind

# The advantage of a frame, which is better from 1 on: the weight of a difference of rims, the
# smallest difference that distinguishes two frames, and the least advantage of a rotation, which is
# higher because its angle is fitted.
_RIM_WEIGHT, _TOLD_APART, _ROTATED = 1.0, 0.5, 4.0


# If explaining all images by three leaves more than the first residual, as for metals, the lights
# are reported but not corrected. Corrected orders leave at most the second share of the residual of
# random orders, and corrected frames have at least the third advantage.
_METALLIC, _FITS_WELL, _CLEARLY_BETTER = 0.25, 0.25, 2.0
_RING_DEG = 4.0  # spread of elevations below which lights form a single ring


@dataclass(frozen=True)
class Candidate:
    """One reading of the light file."""

    name: str  # in words, such as "y negated"
    # its frame relative to the given one; None for an order that is not equivalent to a frame
    frame: LightFrame | None
    # (3, 3) M, where lights @ M.T are the lights in this reading
    matrix: Float64Array = field(compare=False)
    curl: float  # of the normals; 0 for a surface
    # mean cosine between normals and the outward direction at the outline; NaN without a closed
    # outline
    rim: float
    is_order: bool = False  # whether it is another order of the lights
    steps: int = 0  # number of lights by which it shifts the order
    advantage: float = 0.0  # over the given lights; from 1 on, it is better


@dataclass(frozen=True)
class LightCheck:
    """The result of comparing the light directions with the images."""

    # readings of the light file: the given one, then the others from best to worst
    candidates: tuple[Candidate, ...]
    # an order that fits better, in words, or UNKNOWN_ORDER; None if the given order fits
    order: str | None
    # misfit of the given order, relative to random orders; NaN if there are too few lights
    given_misfit: float
    order_misfit: float  # the same for the better order
    # the reading that gives better normals, if any
    best: Candidate | None
    tried: tuple[tuple[str, float], ...]  # readings of the order in words, and their misfits
    outline_counts: float  # the weight of the normals at the mask's edge, from 0 to 1
    # (F, 3), lights in the best reading; None if this is the given one, or if it is not clear
    mended: Float64Array | None
    # median angle between the normals under the given and under the better lights
    error_deg: float | None = None
    shadows_tell: bool = False  # whether cast shadows exclude the given lights with x and y negated
    # whether cast shadows contradict the given lights without supporting others
    lacks_shadows: bool = False
    residual: float = 0.0  # of explaining all images by three, as a share of the brightness
    # an image that contradicts the others and was left out of the comparison
    odd_image: OddImage | None = None
    in_ring: bool = False  # whether all lights have the same elevation

    @property
    def given(self) -> Candidate:
        return self.candidates[0]

    @property
    def unchecked(self) -> list[str]:
        """The properties of the lights that the images leave undetermined, in words."""
        missing = []
        if np.isnan(self.given_misfit):
            missing.append(
                f"their order (fewer than {FEWEST_TO_ORDER} lights, too few lit pixels, or a flat"
                " object)"
            )
        if self.in_ring:
            missing.append(
                "their elevation (it is the same for all lights, so a wrong one fits equally well)"
            )
        if self.order == UNKNOWN_ORDER or self.best is not None:
            return missing
        if not np.isfinite(self.given.curl):
            missing.append("their frame (too few pixels)")
        elif not (self.outline_tells or self.shadows_tell):
            missing.append(
                "whether x and y are both negated (the mask's edge is not a clear outline of the"
                " object)"
            )
        return missing

    @property
    def is_clear(self) -> bool:
        """Whether the better reading is so much better that the lights are corrected by default."""
        if self.mended is None or self.residual > _METALLIC:
            return False
        better = self.order_misfit < min(0.5 * self.given_misfit, _FITS_WELL)
        return (self.order is None or better) and (
            self.best is None or self.best.advantage >= _CLEARLY_BETTER
        )

    @property
    def outline_tells(self) -> bool:
        """Whether the outline shows that x and y are not both negated."""
        return bool(2 * _RIM_WEIGHT * self.outline_counts * abs(np.nan_to_num(self.given.rim)) >= 1)


def check_lights(
    observations: Floats,
    mask: Bools,
    light_directions: Float64Array,
    indices: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    factors: Factors | None = None,
) -> LightCheck:
    """Return the result of comparing observations (P, F) in a mask (H, W) with their lights.

    The lights are the rows `indices` of light_directions (N, 3), all if None. `names` are the names
    of the F images, for messages, and `factors` is find_factors(observations).
    """
    chosen = np.arange(len(light_directions)) if indices is None else np.asarray(indices)
    names = [str(index + 1) for index in chosen] if names is None else names
    factors = find_factors(observations) if factors is None else factors
    check = _check_frame_and_order(observations, mask, light_directions, chosen, names, factors)
    odd = None if factors is None else find_odd_image(factors, light_directions[chosen])
    other_order = check.order not in (None, UNKNOWN_ORDER)
    if (
        factors is None
        or odd is None
        or (other_order and check.order_misfit <= odd.left * check.given_misfit)
    ):
        return check
    kept = np.delete(np.arange(len(chosen)), odd.place)
    others = observations[:, kept]
    factors = find_factors(others, intensities_known=factors.intensities_known)
    names = [names[int(place)] for place in kept]
    check = _check_frame_and_order(others, mask, light_directions, chosen[kept], names, factors)
    return replace(check, odd_image=odd)


def _check_frame_and_order(
    observations: Floats,
    mask: Bools,
    light_directions: Float64Array,
    chosen: Integers,
    names: Sequence[str],
    factors: Factors | None,
) -> LightCheck:
    """Return the result of check_lights for images that are consistent."""
    found = check_order(observations, factors, light_directions, chosen, names)
    observations = observations / found.intensities
    normals = rough_normals(observations, found.lights, mask)
    # The mask's edge is not an outline if less than 30 % of the pixels at the rim are steep, and
    # fully is one from 60 % on.
    weight = (
        float(np.clip((normals.rim_steepness - 0.3) / (0.6 - 0.3), 0, 1))
        if found.plausible
        else 0.0
    )

    def candidate(
        name: str, frame: LightFrame | None, matrix: Float64Array, **kind: Any
    ) -> Candidate:
        turned = normals.transformed(matrix)
        return Candidate(
            name, frame, matrix, turned.curl(), turned.rim() if weight > 0 else np.nan, **kind
        )

    given, *others = (
        candidate(frame.describe() or "as given", frame, frame.matrix) for frame in PLANE_FRAMES
    )
    others += [
        candidate(turn.words, None, turn.matrix, is_order=True, steps=turn.steps)
        for turn in found.turns
    ]
    others += [candidate(name, None, matrix) for name, matrix in _rotations(normals)]
    judged = [replace(other, advantage=_advantage(other, given, weight)) for other in others]
    # If no order fits, the normals provide no evidence.
    fits = found.order != UNKNOWN_ORDER and bool(np.isfinite(given.curl))
    shadows_tell = lacks_shadows = False
    if fits:
        shadows = ShadowCheck.of(observations, found.lights, normals)
        judged, shadows_tell, lacks_shadows = _by_shadows(judged, given, shadows)
    ranked = sorted(judged, key=lambda other: -other.advantage)
    # Rotations are listed only if they matter.
    ranked = [
        each
        for each in ranked
        if each.frame is not None or each.is_order or each.advantage >= _ROTATED
    ]
    order, mended, turn_deg = found.order, None, None
    best = None if order == UNKNOWN_ORDER else _best(ranked, in_order=order is not None)
    residual = 0.0 if factors is None else factors.residual
    if best is not None and residual > _METALLIC and best.advantage < _CLEARLY_BETTER:
        best = None
    if best is not None:
        mended = found.lights @ best.matrix.T
    elif order not in (None, UNKNOWN_ORDER):
        mended = found.lights
    lights = light_directions[chosen]
    if order == UNKNOWN_ORDER:
        rng = np.random.default_rng(0)
        # The normals under random orders are compared with the normals under the given one.
        orders = [rng.permutation(lights) for _ in range(3)]
        turn_deg = float(
            np.median([median_turn_deg(observations, lights, others) for others in orders])
        )
    elif mended is not None:
        turn_deg = median_turn_deg(observations, lights, mended)
    if order is not None and best is not None and best.is_order:
        order, best = best.name, None  # several orders fit, and the normals select one
    check = LightCheck(
        (given, *ranked), order, found.given_misfit, found.misfit, best, found.tried, weight, None
    )
    tie = best is not None and mirror_twin(check, best) is not None
    clear = not tie and not found.misfit > LARGEST_MENDED
    return replace(
        check,
        mended=mended if clear else None,
        error_deg=turn_deg,
        shadows_tell=shadows_tell,
        residual=residual,
        in_ring=bool(np.ptp(np.arcsin(lights[:, 2].clip(-1, 1))) < np.radians(_RING_DEG)),
        lacks_shadows=lacks_shadows and not (order or best or check.outline_tells),
    )


def _rotations(normals: RoughNormals) -> Iterator[tuple[str, Float64Array]]:
    """Yield the rotations of the lights about the view axis that minimise the curl of the normals,
    each in words and as a matrix (3, 3).
    """
    for mirrored in (False, True):
        least_deg = normals.least_curl_deg(mirrored=mirrored)
        # A smaller rotation from the nearest frame is a calibration error.
        if np.isnan(least_deg) or abs((least_deg + 45) % 90 - 45) < 10:
            continue
        for degrees in (least_deg, least_deg - np.copysign(180, least_deg)):
            cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
            matrix = np.array(((cos, -sin, 0), (sin, cos, 0), (0, 0, 1))) @ np.diag(
                (-1.0 if mirrored else 1.0, 1, 1)
            )
            negated = "x negated and " if mirrored else ""
            yield f"{negated}rotated by {degrees:.0f} degrees about the view axis", matrix


def _by_shadows(
    judged: list[Candidate], given: Candidate, check: ShadowCheck
) -> tuple[list[Candidate], bool, bool]:
    """Return the candidates with cast shadows included in the advantages of two of them: the given
    reading and the best other one, each with x and y also negated.

    Also return whether shadows exclude the given lights with x and y negated, and whether shadows
    are missing under the given lights.
    """
    best, told = max(judged, key=lambda other: other.advantage), {}
    shadows, of_negated = check.shadows(given.matrix)
    for one in (given, best):
        twin = _negated(judged, one)
        if twin is not None and (one is given or one.advantage >= 1):
            told[twin.name] = (shadows, of_negated) if one is given else check.shadows(one.matrix)
    judged = [
        replace(
            other, advantage=other.advantage + told[other.name][0].evidence(told[other.name][1])
        )
        if other.name in told
        else other
        for other in judged
    ]
    excluded = shadows.evidence(of_negated) < -_TOLD_APART
    return judged, excluded, shadows.leaves_open(of_negated)


def _negated(candidates: Iterable[Candidate], one: Candidate) -> Candidate | None:
    matrix = BOTH_NEGATED.matrix @ one.matrix
    return next(
        (other for other in candidates if np.allclose(other.matrix, matrix, atol=1e-6)), None
    )


def _best(ranked: list[Candidate], *, in_order: bool) -> Candidate | None:
    # Among near equals, prefer a frame or, with `in_order`, another order, because the order is
    # known to be wrong.
    better = [candidate for candidate in ranked if candidate.advantage >= 1]
    simple = [
        candidate for candidate in better if candidate.frame is not None or candidate.is_order
    ]
    if better and better[0].advantage > (simple[0].advantage if simple else 0) + _TOLD_APART:
        better = [candidate for candidate in better if candidate not in simple] or better
    else:
        better = simple
    # Candidates whose advantages differ by less are near equals.
    near = [candidate for candidate in better if candidate.advantage > better[0].advantage - 0.1]
    preferred = [candidate for candidate in near if candidate.is_order == in_order]
    return min(preferred or near, key=lambda candidate: candidate.steps, default=None)


def _advantage(other: Candidate, given: Candidate, weight: float) -> float:
    lowest = 0.1  # less curl is noise; other frames give little more on a spherical cap
    curls = np.log(max(given.curl, lowest) / max(other.curl, lowest))
    rims = weight * (other.rim - given.rim)
    return float(5.0 * np.nan_to_num(curls) + _RIM_WEIGHT * np.nan_to_num(rims))


def mirror_twin(check: LightCheck, best: Candidate) -> Candidate | None:
    """Return the reading with x and y also negated, if the evidence does not distinguish it from
    the best one.
    """
    twin = _negated(check.candidates, best)
    return (
        twin
        if twin not in (None, check.given) and twin.advantage > best.advantage - _TOLD_APART
        else None
    )


def candidate_rows(check: LightCheck) -> list[dict[str, Any]]:
    """Return the compared readings of a light file as JSON values, with null for unknown values.

    Frames come first, then orders, which are judged by their misfit alone.
    """
    readings = [
        (each.name, check.order_misfit, each.curl, each.rim, each.advantage)
        for each in check.candidates
    ]
    readings += [(words, misfit, np.nan, np.nan, np.nan) for words, misfit in check.tried]
    names = ("misfit", "curl", "rim", "advantage")
    rounded = (
        (words, [round(v, 3) if np.isfinite(v) else None for v in values])
        for words, *values in readings
    )
    return [
        {"reading": words, **dict(zip(names, values, strict=True))} for words, values in rounded
    ]


WRITES_MENDED = "`splinecli info CAPTURE --mended-lights FILE`"


def light_warnings(
    check: LightCheck, light_file: Path, frame: LightFrame, strict: bool
) -> list[tuple[CaptureWarning, str]]:
    """Return the warnings about the lights of a file, each with a sentence about its cause, or ""
    if `check.mended` does not correct it.

    `frame` is the frame in which the file was read, from which the advice follows. If `strict`,
    also warn of properties that the images leave undetermined, as most reliefs without an outline
    do. Each warning includes the error of the normals.
    """
    found = []

    def add(kind: WarningKind, cause: str, advice: str) -> None:
        warning = CaptureWarning(kind, f"{cause} {advice}", check.error_deg)
        found.append((warning, "" if check.mended is None else cause))

    if check.order is not None:
        kind = codes.LIGHT_FRAME if check.order in (ZENITH, HALF_VECTORS) else codes.LIGHT_ORDER
        add(kind, *_order_words(check, light_file))
    if check.best is not None:
        kind = codes.LIGHT_ORDER if check.best.is_order else codes.LIGHT_FRAME
        add(kind, *_frame_words(check, check.best, frame, light_file))
    if check.lacks_shadows:
        text = (
            f"Under the lights of {light_file.name}, the surface should cast shadows that are not"
            " in the images. With x and y of the lights negated, bumps become hollows, and fewer"
            " shadows are missing. The images do not determine which is right, so compare bumps and"
            " hollows with the object. If they are exchanged, negate x and y of the lights."
        )
        # A bump and a hollow look the same. With this error, less than half of the normals are
        # expected to be within 5 degrees.
        found.append((CaptureWarning(codes.LIGHTS_UNCHECKED, text, 6.0), ""))
    if strict and check.unchecked:
        text = (
            f"The lights of {light_file.name} could not be fully verified. Unchecked:"
            f" {'; '.join(check.unchecked)}."
        )
        found.append((CaptureWarning(codes.LIGHTS_UNCHECKED, text), ""))
    return found


def _order_words(check: LightCheck, light_file: Path) -> tuple[str, str]:
    """Return the reason why the order of the lights is wrong, and the remedy."""
    given = 100 * check.given_misfit
    if check.order == UNKNOWN_ORDER:
        cause = (
            f"The images fit {light_file.name} no better than lights in a random order (misfit"
            f" relative to random orders: {given:.0f} %)."
        )
        advice = "Check that it belongs to this capture and lists the lights in the images' order."
        return cause, advice
    advice = "Check that its lines are in the order of the images."
    if check.order == ZENITH:
        advice = "Replace each elevation with 90 degrees minus its value."
    elif check.order == HALF_VECTORS:
        advice = (
            f"Double the angle between each light and the camera axis, as {WRITES_MENDED} does."
        )
        if check.order_misfit > HALF_LEFT * check.given_misfit:  # a ring, recognised by the albedo
            cause = (
                f"{light_file.name} probably contains half vectors, half-way between the lights"
                " and the camera axis, because they make the albedo of steep slopes too bright."
            )
            return cause, advice
    cause = (
        f"The images fit the lights of {light_file.name} much better {check.order} (misfit relative"
        f" to random orders: {100 * check.order_misfit:.0f} % instead of {given:.0f} %)."
    )
    return cause, advice


def _frame_words(
    check: LightCheck, best: Candidate, frame: LightFrame, light_file: Path
) -> tuple[str, str]:
    """Return the reason why the frame of the lights is wrong, and the remedy."""
    pairs = (
        ("curl", best.curl, check.given.curl, ".2f"),
        ("outline", best.rim, check.given.rim, "+.2f"),
    )
    figures = [
        f"{name} {one:{form}} instead of {other:{form}}"
        for name, one, other, form in pairs
        if f"{one:{form}}" != f"{other:{form}}"
    ]
    twin = mirror_twin(check, best)
    names = [
        each.name if each.frame is None else f"with {each.name}"
        for each in (best, twin)
        if each is not None
    ]
    cause = f"The lights give normals that fit a surface much better {' or '.join(names)}"
    cause += f" ({', '.join(figures)})." if figures else "."
    if best.is_order:
        return cause, f"Check that the lines of {light_file.name} are in the order of the images."
    which = (
        "They differ in bumps and hollows; without a closed outline, only the object itself shows"
        " which is right."
    )
    if best.frame is None:
        rotates = f"Rotate the light directions, as {WRITES_MENDED} does."
        return cause, rotates if twin is None else which
    advice = f"Run again with --light-frame {best.frame.after(frame)}"
    if twin is not None and twin.frame is not None:
        return cause, f"{advice} or {twin.frame.after(frame)}. {which}"
    if best.frame.signs == (-1, -1, 1) and not best.frame.exchanged:
        advice += (
            ". If the object is hollow up to its outline, like the inside of a bowl, the lights"
            " are right"
        )
    return cause, f"{advice}."
