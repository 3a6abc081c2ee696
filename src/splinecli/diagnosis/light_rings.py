"""Rings of a dome that are shifted or mirrored against the others in the light file.

A wrong order or frame of all lights is found by light_order.py and light_check.py. In a dome, single rings may also
begin at another lamp, or run the other way round.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from splinecli.capture.lights.light_fit import Factors
from splinecli.maths import Doubles, Integers
from splinecli.maths.normals import unit

FEWEST_IN_RING = 4
_GAP_DEG = 3.0  # lights belong to one ring if their elevations follow each other at smaller steps
_MOST_LEFT = 0.95  # one more ring is mended if at most this share of the misfit is left
_EQUAL = 1e-3  # share of the misfit by which equal readings may differ
_IN_ROUNDS = 0.8  # share of the lights that must be in rings which the azimuth goes round
_NEARLY = 0.1  # the same of a ring that is compared with one other ring

_WAYS = {
    "": (1, 1, 1),
    "x negated": (1, -1, 1),
    "y negated": (1, 1, -1),
    "x and y negated": (1, -1, -1),
    "reversed": (-1, 1, 1),
}
"""The step through the lamps of a ring, and the signs of x and y."""


def mend_rings(factors: Factors, lights: Doubles) -> tuple[str, Doubles, float]:
    """Return what mends the rings of lights (F, 3), in words (none if they fit), the mended lights and their misfit.

    Rings are mended one after the other, the best first, as long as the images fit clearly better: from the given file,
    and, because many wrong rings hide each other, from what each ring alone says of all others. The images show how the
    rings stand to each other; most of them count as right.
    """
    found = [_Mended(lights, float(factors.misfits(lights[None])[0]), [])]
    for rings in find_rings(lights):
        trials = [list(_readings(lights[ring])) for ring in rings]
        anchored = [_seen_from(anchor, factors.matrix, rings, trials) for anchor in range(len(rings))]
        starts = [[0] * len(rings), *anchored]
        found += [_descend(factors, lights, rings, trials, start) for start in dict.fromkeys(map(tuple, starts))]
    least = min(each.misfit for each in found)
    best = min((each for each in found if each.misfit <= least * (1 + _EQUAL) + _EQUAL), key=lambda each: each.changes)
    return _in_words(best.rings), best.lights, best.misfit


class _Mended(NamedTuple):
    lights: Doubles  # (F, 3)
    misfit: float
    rings: list[tuple[Integers, str]]  # the lights of each ring that is read otherwise, and how

    @property
    def changes(self) -> tuple[int, int]:
        return len(self.rings), sum(len(words) for _, words in self.rings)


_Trials = list[list[tuple[str, Doubles]]]  # of each ring, its readings; the first as given


def _seen_from(anchor: int, matrix: Doubles, rings: list[Integers], trials: _Trials) -> list[int]:
    """Return the reading of each ring that fits the factors' matrix (3, F) if one ring is right."""
    # One ring determines the 3 x 3 matrix between lights and factors. Intensities are left out.
    to_factors = matrix[:, rings[anchor]] @ np.linalg.pinv(trials[anchor][0][1].T)
    chosen = []
    for ring, readings in zip(rings, trials, strict=True):
        shown = unit(matrix[:, ring].T)
        distances = np.array([((unit(lights @ to_factors.T) - shown) ** 2).sum() for _, lights in readings])
        chosen.append(int(np.flatnonzero(distances <= distances.min() * (1 + _NEARLY) + 1e-9)[0]))
    return chosen


def _descend(
    factors: Factors, lights: Doubles, rings: list[Integers], trials: _Trials, start: Sequence[int]
) -> _Mended:
    """Return the best readings of rings from a start, changed one after the other."""
    mended, chosen = lights.copy(), list(start)
    for lamps, readings, reading in zip(rings, trials, chosen, strict=True):
        mended[lamps] = readings[reading][1]
    misfit = float(factors.misfits(mended[None])[0])
    places = [(ring, reading) for ring, readings in enumerate(trials) for reading in range(len(readings))]
    for _ in range(2 * len(rings)):
        stack = np.repeat(mended[None], len(places), axis=0)
        for row, (ring, reading) in enumerate(places):
            stack[row, rings[ring]] = trials[ring][reading][1]
        misfits = factors.misfits(stack)
        if misfits.min() > _MOST_LEFT * misfit:
            break
        # On a regular ring, several readings are the same. The first ones are the simplest.
        best = int(np.flatnonzero(misfits <= misfits.min() + _EQUAL * misfit)[0])
        ring, chosen[ring] = places[best]
        mended, misfit = stack[best], float(misfits[best])
    words = [(lamps, readings[reading][0]) for lamps, readings, reading in zip(rings, trials, chosen, strict=True)]
    return _Mended(mended, misfit, [(lamps, how) for lamps, how in words if how])


def find_rings(lights: Doubles) -> Iterator[list[Integers]]:
    """Yield divisions of the lights (F, 3) into rings, as the indices of the lights of each ring that has enough."""
    elevation = np.degrees(np.arcsin(lights[:, 2].clip(-1, 1)))
    order = elevation.argsort(kind="stable")
    by_elevation = np.split(order, np.flatnonzero(np.diff(elevation[order]) > _GAP_DEG) + 1)
    for division in (by_elevation, _rounds(lights)):
        rings = [np.sort(ring) for ring in division if len(ring) >= FEWEST_IN_RING]
        if len(division) > 1 and rings:
            yield rings


def _rounds(lights: Doubles) -> list[Integers]:
    """Return the indices of the lights (F, 3) of each ring, where the azimuth goes once round each ring in the file.

    Rings at nearly the same elevation are told in this way. The list is empty if the azimuth does anything else.
    """
    steps = np.diff(np.arctan2(lights[:, 1], lights[:, 0]), append=0)
    steps = (steps + np.pi) % (2 * np.pi) - np.pi
    rings, first = list[Integers](), 0
    for last in range(1, len(lights)):
        gone, count = float(steps[first:last].sum()), last - first
        if count >= FEWEST_IN_RING - 1 and abs(gone) > 2 * np.pi * count / (count + 1.5):
            rings.append(np.arange(first, last + 1))
            first = last + 1
    inner = [steps[ring[:-1]] for ring in rings]
    in_order = bool(inner) and all((ring > 0).all() or (ring < 0).all() for ring in inner)
    return rings if in_order and sum(map(len, rings)) > _IN_ROUNDS * len(lights) else []


def _readings(given: Doubles) -> Iterator[tuple[str, Doubles]]:
    """Yield the readings of a ring (n, 3), in words and directions (n, 3), the simplest first."""
    for steps in sorted(range(len(given)), key=lambda steps: min(steps, len(given) - steps)):
        shift = "" if steps == 0 else f"shifted by {min(steps, steps - len(given), key=abs):+d}"
        for way, (step, *signs) in _WAYS.items():
            directions = np.roll(given[::step], -steps, axis=0) * (*signs, 1)
            yield " and ".join(filter(None, (way, shift))), directions


def _in_words(mended: Sequence[tuple[Integers, str]]) -> str:
    """Return words for mended rings, from their lights and their words, such as "with lights 9 to 16 shifted by +1"."""
    parts: dict[str, list[str]] = {}
    for lamps, words in mended:
        parts.setdefault(words, []).append(_numbers(lamps + 1))
    named = "; ".join(f"lights {', '.join(lights)} {words}" for words, lights in parts.items())
    return f"with {named}" if named else ""


def _numbers(numbers: Integers) -> str:
    whole = len(numbers) == numbers[-1] - numbers[0] + 1
    return f"{numbers[0]} to {numbers[-1]}" if whole else ", ".join(map(str, numbers))
