"""Draws of lights: the lights of a capture that a trial uses, drawn by a seed or read from a file."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splinecli.capture.formats.numbers import read_lines, split_words
from splinecli.capture.record import MIN_LIGHTS, in_one_plane
from splinecli.errors import InputError, UsageError
from splinecli.maths import Doubles

Draw = tuple[int, ...]  # zero-based indices of lights in the whole capture

DRAWS_STREAM, NOISE_STREAM, PIXELS_STREAM = 1, 2, 3
"""First numbers of the seeds, so that draws, light noise and the choice of pixels are independent."""

_REDRAWS = 1000
_INDEX = re.compile(r"[0-9]{1,9}")


def draw_lights(light_directions: Doubles, n_lights: int | None, *, trials: int = 1, seed: int = 0) -> list[Draw]:
    """Return random draws of lights without replacement, each in rising order.

    Trial t depends only on the seed, the number of lights, `n_lights` and t. So captures with equally many lights get
    the same draws, and more trials continue the same list. A draw is repeated only if its lights lie in one plane,
    because no method can solve it. All lights together are one draw, whatever the number of trials.

    Args:
        light_directions: (F, 3) unit.
        n_lights: the number of lights in a draw; None for all of them.

    Raises:
        UsageError: fewer than three lights, more than there are, no trials, or a negative seed.
        InputError: every draw had its lights in one plane.
    """
    available = len(light_directions)
    check_draw_settings(n_lights, trials, seed)
    if n_lights is not None and n_lights > available:
        problem = f"{n_lights} lights were requested, but the capture has {available}"
        raise UsageError(problem, hint=f"Ask for at most {available} lights")
    if n_lights is None or n_lights == available:
        return [tuple(range(available))]
    return [_draw(light_directions, n_lights, trial, seed) for trial in range(trials)]


def check_draw_settings(n_lights: int | None, trials: int, seed: int) -> None:
    """Raise UsageError for settings that fit no capture."""
    if n_lights is not None and n_lights < MIN_LIGHTS:
        raise UsageError(f"--n-lights is {n_lights}; expected at least {MIN_LIGHTS}")
    if trials < 1:
        raise UsageError(f"--trials is {trials}; expected at least 1")
    if seed < 0:
        raise UsageError(f"--seed is {seed}; expected a whole number from 0")


@dataclass(frozen=True)
class DrawsFile:
    """The draws of a file, all with the same number of lights."""

    path: Path
    draws: tuple[Draw, ...]
    lines: tuple[int, ...]

    @property
    def n_lights(self) -> int:
        return len(self.draws[0])

    def check_against(self, light_directions: Doubles, *, skipped: int = 0) -> None:
        """Raise InputError, with the line, for a draw that does not fit a capture under these lights (F, 3).

        No draw may name the first `skipped` lights.
        """
        available = len(light_directions)
        for draw, line in zip(self.draws, self.lines, strict=True):
            if max(draw) >= available:
                problem = f"found light index {max(draw)}, expected 0 to {available - 1}"
                problem += f": the capture has {available} lights"
            elif min(draw) < skipped:
                problem = f"found light index {min(draw)}; the first {skipped} images are to be skipped"
            elif in_one_plane(light_directions[list(draw)]):
                problem = "the lights of this draw lie in one plane, so no normal can be found"
            else:
                continue
            raise InputError(problem, path=self.path, line=line)


def read_draws(path: Path) -> DrawsFile:
    """Return the draws of a text file. Each line is one draw: light indices from 0, separated by spaces or commas.

    "#" comments and blank lines are skipped. Raises InputError with the line for a word that is no light index, a
    repeated index, fewer than three lights, or another number than in the first draw; also for a file without draws.
    """
    draws, lines = list[Draw](), list[int]()
    for line, text in enumerate(read_lines(path), start=1):
        words = split_words(text.partition("#")[0])
        if words:
            draws.append(_read_draw(words, len(draws[0]) if draws else len(words), path, line))
            lines.append(line)
    if not draws:
        raise InputError("the file contains no draws, expected a line of light indices for each", path=path)
    return DrawsFile(path, tuple(draws), tuple(lines))


def _draw(light_directions: Doubles, n_lights: int, trial: int, seed: int) -> Draw:
    generator = np.random.default_rng([DRAWS_STREAM, seed, len(light_directions), n_lights, trial])
    for _ in range(_REDRAWS):
        # Uniform numbers, not Generator.choice: NumPy is more likely to keep this stream in later versions.
        chosen = np.sort(np.argsort(generator.random(len(light_directions)))[:n_lights])
        if not in_one_plane(light_directions[chosen]):
            return tuple(chosen.tolist())
    problem = f"found no {n_lights} lights that do not lie in one plane in {_REDRAWS} draws"
    raise InputError(problem, hint="Choose more lights, or lights that surround the viewing direction")


def _read_draw(words: list[str], n_lights: int, path: Path, line: int) -> Draw:
    for word in words:
        if _INDEX.fullmatch(word) is None:
            raise InputError(f'found "{word[:40]}", expected a light index from 0', path=path, line=line)
    draw = tuple(map(int, words))
    for position, index in enumerate(draw):
        if index in draw[:position]:
            raise InputError(f"light index {index} comes twice", path=path, line=line, hint="Name each light once")
    if len(draw) < MIN_LIGHTS:
        raise InputError(f"found {len(draw)} light indices, expected at least {MIN_LIGHTS}", path=path, line=line)
    if len(draw) != n_lights:
        problem = f"found {len(draw)} light indices, expected {n_lights} as in the first draw"
        raise InputError(problem, path=path, line=line)
    return draw
