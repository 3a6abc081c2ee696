"""Detect lights in a wrong order, including shifted rings of a dome, by how well they fit the
images.

In the light file of a dome, single rings may be shifted or mirrored relative to the others, because
they start at another lamp or run the other way round.

Intensities are free even if they are known, because highlights brighten some images of a metal more
than others, as a brighter lamp would. For metals, this separates correct lights from wrong ones far
better than known intensities do. On flat objects, however, free intensities explain any order. The
thresholds were chosen as in light_check.py.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splinecli.capture.light_rows import lights_of_half_vectors, zenith_as_elevation
from splinecli.lights.light_fit import (
    LIT_SHARE,
    Factors,
    fit_residual,
    random_misfits,
    sample_pixels,
    shifted_orders,
    swapped_orders,
)
from splinecli.maths import Bools, Float64Array, Floats, Integers
from splinecli.maths.normals import unit
from splinecli.maths.robust import absolute_weights, fit_robustly, lit_values, shadow_weights

FEWEST_TO_ORDER = 6  # with fewer lights, too few equations determine the order
HALF_LEFT = 0.6  # for half vectors, doubled angles leave at most this share of the misfit
LARGEST_MENDED = 0.35  # misfit of a better order; correct lights of most metals have less
# Misfits are relative to the median misfit of random orders.
_FOR_CHANCE = 8  # with fewer lights, too many random orders fit, so use known intensities
_RANDOM = 0.05  # of random orders; below it, free intensities do not determine the order
_FEWEST_IN_RING = 4
_MATTE = 0.2  # residual of the factors, as a share of the brightness; metals have more
_EQUAL = 1e-3  # share of the misfit by which equal readings may differ
_FITTED_PIXELS, _FITS = 800, 5
UNKNOWN_ORDER = "unknown"  # neither the given order of the lights nor a simple other one fits
# Readings of the light file in words: its elevations are zenith angles, or its lights are half-way
# to the camera axis.
ZENITH = "if their elevations are measured from the camera axis"
HALF_VECTORS = "if they are half vectors, as the normals of a mirror ball at its highlights"

# The step through the lamps of a ring, and the signs of x and y
_WAYS = {
    "": (1, 1, 1),
    "x negated": (1, -1, 1),
    "y negated": (1, 1, -1),
    "x and y negated": (1, -1, -1),
    "reversed": (-1, 1, 1),
}


def mend_rings(factors: Factors, lights: Float64Array) -> tuple[str, Float64Array, float]:
    """Return the corrections of rings of lights (F, 3) in words ("" if all rings fit), the
    corrected lights and their misfit.

    Rings are corrected one at a time, always the one that helps most, as long as the images fit
    clearly better. The search starts from the given file and, because many wrong rings hide each
    other, from the readings that each ring alone predicts for all others. The images determine only
    how the rings are oriented relative to each other; most of them are assumed to be correct.
    """
    found = [_Mended(lights, float(factors.misfits(lights[None])[0]), [])]
    for rings in find_rings(lights):
        trials = [list(_readings(lights[ring])) for ring in rings]
        anchored = [
            _seen_from(anchor, factors.matrix, rings, trials) for anchor in range(len(rings))
        ]
        starts = [[0] * len(rings), *anchored]
        found += [
            _descend(factors, lights, rings, trials, start)
            for start in dict.fromkeys(map(tuple, starts))
        ]
    least = min(each.misfit for each in found)
    near_least = (each for each in found if each.misfit <= least * (1 + _EQUAL) + _EQUAL)
    best = min(
        near_least, key=lambda each: (len(each.rings), sum(len(words) for _, words in each.rings))
    )
    parts: dict[str, list[str]] = {}  # lights by correction: "with lights 9 to 16 shifted by +1"
    for lamps, words in best.rings:
        whole = len(lamps) == lamps[-1] - lamps[0] + 1
        numbers = f"{lamps[0] + 1} to {lamps[-1] + 1}" if whole else ", ".join(map(str, lamps + 1))
        parts.setdefault(words, []).append(numbers)
    named = "; ".join(f"lights {', '.join(numbers)} {words}" for words, numbers in parts.items())
    return f"with {named}" if named else "", best.lights, best.misfit


class _Mended(NamedTuple):
    lights: Float64Array  # (F, 3)
    misfit: float
    rings: list[tuple[Integers, str]]  # lights of each corrected ring, and its reading in words


_Trials = list[list[tuple[str, Float64Array]]]  # readings of each ring; the first is the given one


def _seen_from(
    anchor: int, matrix: Float64Array, rings: list[Integers], trials: _Trials
) -> list[int]:
    """Return the number of each ring's reading that fits the factors' matrix (3, F) best, assuming
    that the ring `anchor` is correct.
    """
    # One ring determines the 3 x 3 matrix between lights and factors. Intensities are ignored.
    to_factors = matrix[:, rings[anchor]] @ np.linalg.pinv(trials[anchor][0][1].T)
    chosen = []
    for ring, readings in zip(rings, trials, strict=True):
        shown = unit(matrix[:, ring].T)
        distances = np.array(
            [((unit(lights @ to_factors.T) - shown) ** 2).sum() for _, lights in readings]
        )
        # the first reading that is nearly as close as the closest one
        chosen.append(int(np.flatnonzero(distances <= distances.min() * (1 + 0.1) + 1e-9)[0]))
    return chosen


def _descend(
    factors: Factors,
    lights: Float64Array,
    rings: list[Integers],
    trials: _Trials,
    start: Sequence[int],
) -> _Mended:
    """Return the lights after improving the readings of rings one at a time from a start."""
    mended, chosen = lights.copy(), list(start)
    for lamps, readings, reading in zip(rings, trials, chosen, strict=True):
        mended[lamps] = readings[reading][1]
    misfit = float(factors.misfits(mended[None])[0])
    places = [
        (ring, reading) for ring, readings in enumerate(trials) for reading in range(len(readings))
    ]
    for _ in range(2 * len(rings)):
        stack = np.repeat(mended[None], len(places), axis=0)
        for row, (ring, reading) in enumerate(places):
            stack[row, rings[ring]] = trials[ring][reading][1]
        misfits = factors.misfits(stack)
        if misfits.min() > 0.95 * misfit:  # correcting one more ring must help this much
            break
        # On a regular ring, several readings are equal. The first one is the simplest.
        best = int(np.flatnonzero(misfits <= misfits.min() + _EQUAL * misfit)[0])
        ring, chosen[ring] = places[best]
        mended, misfit = stack[best], float(misfits[best])
    words = [
        (lamps, readings[reading][0])
        for lamps, readings, reading in zip(rings, trials, chosen, strict=True)
    ]
    return _Mended(mended, misfit, [(lamps, how) for lamps, how in words if how])


def find_rings(lights: Float64Array) -> Iterator[list[Integers]]:
    """Yield divisions of lights (F, 3) into rings, as the indices of the lights in each ring that
    has enough of them.
    """
    elevation = np.degrees(np.arcsin(lights[:, 2].clip(-1, 1)))
    order = elevation.argsort(kind="stable")
    # A larger step between successive elevations separates two rings.
    by_elevation = np.split(order, np.flatnonzero(np.diff(elevation[order]) > 3.0) + 1)
    for division in (by_elevation, _rounds(lights)):
        rings = [np.sort(ring) for ring in division if len(ring) >= _FEWEST_IN_RING]
        if len(division) > 1 and rings:
            yield rings


def _rounds(lights: Float64Array) -> list[Integers]:
    """Return the indices of the lights (F, 3) of each ring, if the azimuth in the file goes round
    each ring once.

    This separates rings at nearly the same elevation. The list is empty for other files.
    """
    steps = np.diff(np.arctan2(lights[:, 1], lights[:, 0]), append=0)
    steps = (steps + np.pi) % (2 * np.pi) - np.pi
    rings, first = list[Integers](), 0
    for last in range(1, len(lights)):
        gone, count = float(steps[first:last].sum()), last - first
        if count >= _FEWEST_IN_RING - 1 and abs(gone) > 2 * np.pi * count / (count + 1.5):
            rings.append(np.arange(first, last + 1))
            first = last + 1
    inner = [steps[ring[:-1]] for ring in rings]
    in_order = bool(inner) and all((ring > 0).all() or (ring < 0).all() for ring in inner)
    # Most of the lights must be in such rings.
    return rings if in_order and sum(map(len, rings)) > 0.8 * len(lights) else []


def _readings(given: Float64Array) -> Iterator[tuple[str, Float64Array]]:
    """Yield the readings of a ring (n, 3) in words and as directions (n, 3), the simplest first."""
    for steps in sorted(range(len(given)), key=lambda steps: min(steps, len(given) - steps)):
        shift = "" if steps == 0 else f"shifted by {min(steps, steps - len(given), key=abs):+d}"
        for way, (step, *signs) in _WAYS.items():
            directions = np.roll(given[::step], -steps, axis=0) * (*signs, 1)
            yield " and ".join(filter(None, (way, shift))), directions


class FittingShift(NamedTuple):
    """A shift of the lights that fits equally well: in words, its steps, and the matrix (3, 3) that
    maps the lights.
    """

    words: str
    steps: int
    matrix: Float64Array


@dataclass(frozen=True, eq=False)
class LightOrder:
    """The order of lights that fits best."""

    # in words; None for the given order, UNKNOWN_ORDER if neither it nor another one fits
    order: str | None
    lights: Float64Array  # (F, 3), in this order
    # (F,), the best-fitting intensities; ones if known intensities were used
    intensities: Float64Array
    given_misfit: float = np.nan  # relative to random orders; NaN if there are too few lights
    misfit: float = np.nan  # the same for this order
    plausible: bool = True  # whether the lights fit well enough for the normals to show an outline
    # readings in words, and their misfits relative to random orders
    tried: tuple[tuple[str, float], ...] = ()
    # shifts that fit equally well, because they rotate a regular ring of lights
    turns: tuple[FittingShift, ...] = ()


class _Reading(NamedTuple):
    """An order of the lights: in words (None for the given one), its lights (F, 3) and their
    misfit.
    """

    words: str | None
    lights: Float64Array
    misfit: float


def check_order(
    observations: Floats,
    factors: Factors | None,
    light_directions: Float64Array,
    chosen: Integers,
    names: Sequence[str],
) -> LightOrder:
    """Return the order of the `chosen` lights (F,) of light_directions (N, 3) that fits
    observations (P, F) best.

    `factors` is find_factors(observations), or None if too few pixels are lit. The orders tried
    shift or reverse all N lights together, exchange two, or correct rings.
    """
    lights, n_all = light_directions[chosen], len(light_directions)
    unknown = LightOrder(None, lights, np.ones(len(lights)))
    if factors is None or len(lights) < FEWEST_TO_ORDER:
        return unknown
    compared, random = _free_if_possible(factors, lights)
    usual = max(float(np.median(random)), 1e-9)
    if usual < _RANDOM and not factors.intensities_known:
        return unknown

    def reading(words: str | None, directions: Float64Array) -> _Reading:
        return _Reading(words, directions, float(compared.misfits(directions[None])[0]))

    given = reading(None, lights)
    shifted = light_directions[shifted_orders(n_all)[:, chosen]]
    misfits = compared.misfits(shifted)
    rows = 1 + int(misfits[1:n_all].argmin()), n_all + int(misfits[n_all:].argmin())
    shifts = [_Reading(_shift_words(row, n_all), shifted[row], float(misfits[row])) for row in rows]
    exchanged, of_angles = (
        _best_exchange(compared, lights, names),
        reading(ZENITH, zenith_as_elevation(lights)),
    )
    tried, share = [*shifts, exchanged, of_angles], given.misfit / usual
    doubled = lights_of_half_vectors(lights)
    # Half vectors of lights above the horizon are within 45 degrees of the camera axis.
    if doubled[:, 2].min() > 0.0:
        tried.append(reading(HALF_VECTORS, doubled))
    if tried[-1].words == HALF_VECTORS and _are_half_vectors(
        observations, factors, lights, doubled
    ):
        found = tried[-1]
    else:
        # Tilted lights and metals fit zenith angles better than elevations, but not well.
        are_zenith = factors.residual < _MATTE and of_angles.misfit < 0.25 * usual
        found = _better(given, [*shifts, *[of_angles] * are_zenith], exchanged, usual)
        if found.misfit > 0.1 * usual and np.array_equal(chosen, np.arange(n_all)):
            rings = _Reading(*mend_rings(compared, lights))
            tried += [rings] if rings.words else []
            if rings.words and rings.misfit < min(found.misfit * 0.6, LARGEST_MENDED * usual):
                found = rings
    # On glossy plates, free intensities hide an order that fits well with the known ones.
    fits_known = factors.intensities_known and _is_plausible(factors, given, usual)
    if found is given and not fits_known and _is_wrong(observations, compared, given, random):
        found = given._replace(words=UNKNOWN_ORDER)
    turns: tuple[FittingShift, ...] = ()
    if any(found is shift for shift in shifts) or (found is given and share < 0.25):
        turns = _turns(found.lights, shifted, misfits <= max(1.3 * found.misfit, 0.05 * usual))
    return LightOrder(
        found.words,
        found.lights,
        compared.intensities(found.lights[None])[0],
        share,
        found.misfit / usual,
        _is_plausible(factors, found, usual),
        tuple((str(reading.words), reading.misfit / usual) for reading in tried),
        turns,
    )


def _better(
    given: _Reading, others: Sequence[_Reading], exchanged: _Reading, usual: float
) -> _Reading:
    """Return the reading that fits clearly better than the given one, or the given one."""
    share = given.misfit / usual
    # A better order leaves less than this share of the given misfit; the share is smaller for few
    # lights.
    limit = min(given.misfit * (0.4 if len(given.lights) <= 8 else 0.6), LARGEST_MENDED * usual)
    best = min(others, key=lambda reading: reading.misfit)
    if share > 0.25 and best.misfit < limit:  # wrong orders have a larger misfit
        return best
    # exchanging two lights gives a smaller misfit
    if share > 0.08 and exchanged.misfit < min(0.4 * given.misfit, limit):
        return exchanged
    return given


def _are_half_vectors(
    observations: Floats, factors: Factors, lights: Float64Array, doubled: Float64Array
) -> bool:
    """Return whether lights (F, 3) with doubled angles from the camera axis fit clearly better."""
    better = False
    if factors.residual > _MATTE:
        return False
    for known in (True, False):
        compared = replace(factors, intensities_known=known)
        usual = float(np.median(random_misfits(compared, lights)))
        given, other = compared.misfits(np.stack((lights, doubled))) / max(usual, 1e-9)
        if other > given + 0.05:  # they may be worse by at most this in either case
            return False
        better |= bool(given > 0.04 and other < HALF_LEFT * given)
    return better or _brighten_as_half_vectors(observations, lights, doubled)


def _brighten_as_half_vectors(
    observations: Floats, lights: Float64Array, doubled: Float64Array
) -> bool:
    """Return whether the albedo under lights (F, 3) changes with the slope as it does under half
    vectors.
    """
    chosen, values = lit_values(observations, LIT_SHARE, _FITTED_PIXELS)
    lit = shadow_weights(values)
    scaled = [fit_robustly(values, lit, reading, _FITS)[0] for reading in (lights, doubled)]
    albedo, other = (np.log(np.linalg.norm(each, axis=1).clip(min=1e-9)) for each in scaled)
    change = albedo - other
    albedo += np.log(observations[chosen].max(axis=1))
    terms, weights = np.stack((np.ones_like(change), change), axis=1), np.ones_like(change)
    for _ in range(_FITS):
        solution = np.linalg.lstsq(weights[:, None] * terms, weights * albedo, rcond=None)[0]
        weights = np.sqrt(absolute_weights(albedo - terms @ solution))
    # A single ring fits equally well at any elevation, but half vectors brighten the albedo of
    # steep slopes. Lights are half vectors if more than this share of the expected change of the
    # albedo is found, and the logarithm of that change has more than this standard deviation.
    # Synthetic objects, matte or glossy, plain or textured, have shares of 0.4 to 1.3 with half
    # vectors, below 0.4 with correct lights and below 0.5 with near lamps.
    return bool(solution[1] > 0.65 and change.std() > 0.1)


def _best_exchange(factors: Factors, lights: Float64Array, names: Sequence[str]) -> _Reading:
    swaps = swapped_orders(len(lights))
    misfits = factors.misfits(lights[swaps])
    best = int(misfits.argmin())
    one, other = (names[int(i)] for i in np.flatnonzero(swaps[best] != np.arange(len(lights))))
    return _Reading(
        f"with the lights of {one} and {other} exchanged", lights[swaps[best]], float(misfits[best])
    )


def _is_wrong(
    observations: Floats, factors: Factors, given: _Reading, random: Float64Array
) -> bool:
    """Return whether lights fit no better than in random orders, whose misfits are given."""
    n_lights = len(given.lights)
    # An order is wrong if more than this share of random orders fits as well.
    by_chance = n_lights >= _FOR_CHANCE and (random <= given.misfit).mean() > 0.02
    # It is also wrong if its misfit is above this share of random orders, and above this multiple
    # of the residual that highlights and shadows leave under any lights.
    unfit = given.misfit > 0.5 * np.median(random) and given.misfit > 6.0 * factors.residual
    # With few lights and a larger residual of the factors, metals fit like a random order.
    judged = factors.residual < 0.2 or n_lights >= 12
    return (
        judged
        and bool(by_chance or unfit)
        and _fits_like_random(observations, factors, given.lights)
    )


def _is_plausible(fitted: Factors, found: _Reading, usual: float) -> bool:
    """Return whether lights fit well enough for the normals to show an outline."""
    if not fitted.intensities_known:
        return found.misfit <= 0.35 * usual
    random, misfit = random_misfits(fitted, found.lights), fitted.misfits(found.lights[None])[0]
    # Above these misfits, with free and with known intensities, normals are not plausible.
    return bool(misfit <= 0.5 * max(float(np.median(random)), 1e-9))


def _free_if_possible(factors: Factors, lights: Float64Array) -> tuple[Factors, Float64Array]:
    """Return the factors to compare lights with, and the misfits of random orders. Intensities are
    free if they then determine the order.
    """
    free = factors.with_free_intensities()
    random = random_misfits(free, lights)
    few = factors.intensities_known and len(lights) < _FOR_CHANCE
    if few or np.median(random) < _RANDOM:
        return factors, random_misfits(factors, lights) if factors.intensities_known else random
    return free, random


def _fits_like_random(observations: Floats, factors: Factors, lights: Float64Array) -> bool:
    """Return whether lights fit the pixels little better than in random orders."""
    # The factors may be wrong if each pixel is in shadow under most lights; this fit is not.
    values = sample_pixels(observations)
    values = values[:: max(1, len(values) // _FITTED_PIXELS)]
    rng = np.random.default_rng(1)
    orders = np.stack((lights, *(rng.permutation(lights) for _ in range(9))))
    intensities = factors.intensities(orders)
    given, *random = (fit_residual(values / e, k) for e, k in zip(intensities, orders, strict=True))
    # Lights are not reported as wrong if their residual is below this share of the residual in
    # random orders.
    return given > 0.7 * float(np.median(random))


def _turns(lights: Float64Array, shifted: Float64Array, fitting: Bools) -> tuple[FittingShift, ...]:
    """Return the shifted orders (2 N, F, 3) that fit, except those that leave the lights (F, 3) in
    place.
    """
    inverse, n_all = np.linalg.pinv(lights), len(shifted) // 2
    turns = []
    for row in np.flatnonzero(fitting).tolist():
        matrix = (inverse @ shifted[row]).T
        if not np.allclose(matrix, np.eye(3), atol=1e-6):
            turns.append(
                FittingShift(_shift_words(row, n_all), min(row % n_all, -row % n_all), matrix)
            )
    return tuple(turns)


def _shift_words(order: int, n_lights: int) -> str:
    steps = order % n_lights
    if order < n_lights:
        return f"if image 1 belongs to light {steps + 1}, image 2 to the next, and so on"
    return f"in reversed order, beginning with light {(n_lights - 1 + steps) % n_lights + 1}"
