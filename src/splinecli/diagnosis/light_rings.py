"""Rings of a dome that are shifted or mirrored against the others in the light file.

A wrong order or frame of all lights is found by light_order.py and light_check.py. In a dome, single rings may also
begin at another lamp, or run the other way round.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from splinecli.capture.lights.light_fit import Factors
from splinecli.maths.arrays import Doubles, Integers

FEWEST_IN_RING = 4
_GAP_DEG = 3.0  # lights belong to one ring if their elevations follow each other at smaller steps
_MOST_LEFT = 0.95  # one more ring is mended if at most this share of the misfit is left
_EQUAL = 1e-3  # share of the misfit by which equal readings may differ

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

    Rings are mended one after the other, the best first, as long as the images fit clearly better. The images show how
    the rings stand to each other; most of them count as right.
    """
    rings = find_rings(lights)
    trials = [(ring, *reading) for ring, lamps in enumerate(rings) for reading in _readings(lights[lamps])]
    mended, found = lights, dict[int, str]()
    misfit = float(factors.misfits(lights[None])[0])
    for _ in range(2 * len(rings)):
        stack = np.repeat(mended[None], len(trials), axis=0)
        for row, (ring, _, directions) in enumerate(trials):
            stack[row, rings[ring]] = directions
        misfits = factors.misfits(stack)
        if misfits.min() > _MOST_LEFT * misfit:
            break
        # On a regular ring, several readings are the same. The first ones are the simplest.
        best = int(np.flatnonzero(misfits <= misfits.min() + _EQUAL * misfit)[0])
        ring, words, _ = trials[best]
        mended, misfit, found[ring] = stack[best], float(misfits[best]), words
    return _in_words([(rings[ring], found[ring]) for ring in sorted(found) if found[ring]]), mended, misfit


def find_rings(lights: Doubles) -> list[Integers]:
    """Return the indices of the lights (F, 3) of each ring that has enough of them."""
    elevation = np.degrees(np.arcsin(lights[:, 2].clip(-1, 1)))
    order = elevation.argsort(kind="stable")
    starts = np.flatnonzero(np.diff(elevation[order]) > _GAP_DEG) + 1
    rings = [np.sort(ring) for ring in np.split(order, starts)]
    return [ring for ring in rings if len(ring) >= FEWEST_IN_RING] if len(rings) > 1 else []


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
