"""The protocol of an evaluation (draws of lights, trials, noise, pixels, and how captures are read)
and its outcome.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splinecli.capture.formats.numbers import read_lines, split_words
from splinecli.capture.record import in_one_plane
from splinecli.errors import InputError, UsageError
from splinecli.lights.draws import Draw, check_draw_settings
from splinecli.maths import Float64Array
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.recipe.work import RecipeOptions
from splinecli.records.documents import SkippedCapture

# Streams of the seed. The noise and the choice of pixels are independent of each other and of the
# draws (DRAWS_STREAM).
NOISE_STREAM, PIXELS_STREAM = 2, 3


@dataclass(frozen=True)
class DrawsFile:
    """The draws in a file, which all have the same number of lights."""

    path: Path
    draws: tuple[Draw, ...]
    lines: tuple[int, ...]

    @property
    def n_lights(self) -> int:
        return len(self.draws[0])

    def check_against(self, light_directions: Float64Array, *, skipped: int = 0) -> None:
        """Raise InputError, with the line, for a draw that does not fit a capture with these lights
        (F, 3).

        Draws must not include the first `skipped` lights.
        """
        available = len(light_directions)
        for draw, line in zip(self.draws, self.lines, strict=True):
            if max(draw) >= available:
                problem = f"found light index {max(draw)}, expected 0 to {available - 1},"
                problem += f" because the capture has {available} lights"
            elif min(draw) < skipped:
                problem = (
                    f"found light index {min(draw)}, but the first {skipped} images are skipped"
                )
            elif in_one_plane(light_directions[list(draw)]):
                problem = (
                    "the lights of this draw are in one plane, so normals cannot be determined"
                )
            else:
                continue
            raise InputError(problem, path=self.path, line=line)


def read_draws(path: Path) -> DrawsFile:
    """Return the draws in a text file.

    Each line is one draw: zero-based light indices separated by spaces or commas. "#" comments and
    blank lines are skipped. Raises InputError with the line for a word that is not a light index, a
    repeated index, fewer than three lights, or another number of lights than in the first draw;
    also for a file without draws.
    """
    draws, lines = list[Draw](), list[int]()
    for line, text in enumerate(read_lines(path), start=1):
        words = split_words(text.partition("#")[0])
        if words:
            draws.append(_read_draw(words, len(draws[0]) if draws else len(words), path, line))
            lines.append(line)
    if not draws:
        raise InputError(
            "the file contains no draws, expected one line of light indices for each", path=path
        )
    return DrawsFile(path, tuple(draws), tuple(lines))


def _read_draw(words: list[str], n_lights: int, path: Path, line: int) -> Draw:
    for word in words:
        if re.fullmatch("[0-9]{1,9}", word) is None:
            raise InputError(
                f'found "{word[:40]}", expected a light index from 0', path=path, line=line
            )
    draw = tuple(map(int, words))
    seen = set[int]()
    for index in draw:
        if index in seen:
            raise InputError(
                f"light index {index} is listed twice",
                path=path,
                line=line,
                hint="List each light once",
            )
        seen.add(index)
    if len(draw) < MIN_LIGHTS:
        raise InputError(
            f"found {len(draw)} light indices, expected at least {MIN_LIGHTS}", path=path, line=line
        )
    if len(draw) != n_lights:
        raise InputError(
            f"found {len(draw)} light indices, expected {n_lights} as in the first draw",
            path=path,
            line=line,
        )
    return draw


EVERY_CAPTURE = "*"  # key in `skip_first` for all captures without a key of their own


@dataclass(frozen=True)
class Protocol:
    """The settings of an evaluation. Methods are only comparable under the same protocol.

    Raises UsageError if a value is out of range.
    """

    # number of lights in each draw; None for all. A draws file overrides this field and trials
    n_lights: int | None = None
    # number of random draws. Without light noise, a draw of all lights needs only one trial
    trials: int = 1
    seed: int = 0  # for the draws, the light noise and the choice of pixels
    draws_file: Path | None = None  # file that contains the draws; see read_draws
    # standard deviation of the angle by which each trial tilts the light directions
    light_noise_deg: float = 0.0
    # number of random pixels to score in each capture; None for all with ground truth
    max_pixels: int | None = None
    # number of images to skip, by the name of the capture or EVERY_CAPTURE
    skip_first: Mapping[str, int] = field(default_factory=dict)
    # whether stored values are used, as for published tables, or restored ones, as in `infer`
    as_stored: bool = False
    white_level: float | None = None
    # typical error with which trials refine the lights (see refine_capture)
    light_error_deg: float | None = None
    # whether trials estimate their lights from the images, as `infer --lights estimate`
    finds_lights: bool = False

    def __post_init__(self) -> None:
        check_draw_settings(self.n_lights, self.trials, self.seed)
        if not 0 <= self.light_noise_deg <= 30.0:
            raise UsageError(f"light noise of {self.light_noise_deg:g} degrees, expected 0 to 30")

    def skipped_lights(self, capture: str) -> int:
        """Return the number of lights that are skipped at the start of a capture."""
        return self.skip_first.get(capture, self.skip_first.get(EVERY_CAPTURE, 0))

    @property
    def recipe(self) -> RecipeOptions:
        """How the recipe prepares the capture of a trial. The lights need no checks."""
        return RecipeOptions(
            as_stored=self.as_stored,
            finds_lights=self.finds_lights,
            refuses_lights=False,
            judges=False,
            refine_lights=self.light_error_deg is not None,
            light_error_deg=self.light_error_deg,
        )


def lights_value(protocol: Protocol) -> int | Literal["all"]:
    return "all" if protocol.n_lights is None else protocol.n_lights


def heading(protocol: Protocol) -> str:
    """Return the settings that differ between evaluations, such as "10 lights".

    With noise, this is for example "all lights, light noise of 2 degrees".
    """
    noise = (
        f", light noise of {protocol.light_noise_deg:g} degrees" if protocol.light_noise_deg else ""
    )
    return f"{lights_value(protocol)} lights{noise}"


def protocol_in_words(protocol: Protocol) -> str:
    """Return the protocol as text, such as "10 lights, 20 random draws, seed 0, images
    restored".
    """
    parts = [heading(protocol)]
    if protocol.draws_file is not None:
        parts.append(f"the {protocol.trials} draws of {protocol.draws_file.name}")
    elif protocol.n_lights is not None:
        parts.append(f"{protocol.trials} random {'draw' if protocol.trials == 1 else 'draws'}")
    elif protocol.light_noise_deg:  # without noise, all lights need only one trial
        parts.append(f"{protocol.trials} {'trial' if protocol.trials == 1 else 'trials'}")
    parts.append(f"seed {protocol.seed}")
    if protocol.max_pixels is not None:
        parts.append(f"at most {protocol.max_pixels} pixels of each capture")
    if protocol.white_level is not None:
        parts.append(f"white level {protocol.white_level:g}")
    if protocol.light_error_deg is not None:
        parts.append("lights refined")
    if protocol.finds_lights:
        parts.append("lights estimated from the images")
    parts.append("images as stored" if protocol.as_stored else "images restored")
    return ", ".join(parts)


@dataclass(frozen=True)
class Result:
    """The errors of one method on one capture."""

    method: str
    capture: str  # name of the capture in the tables
    n_lights: int  # number of lights in each draw
    # mean angular error (MAE) of each trial over the scored pixels, in degrees
    maes_deg: tuple[float, ...]
    seconds: float  # mean time to estimate the normals in a trial
    # mean error of the light directions that were estimated in the trials
    found_light_error_deg: float | None = None

    @property
    def trials(self) -> int:
        return len(self.maes_deg)

    @property
    def mae_deg(self) -> float:
        """Mean of the trials' MAE."""
        return math.fsum(self.maes_deg) / self.trials

    @property
    def std_deg(self) -> float:
        """Population standard deviation of the trials' MAE."""
        return float(np.std(self.maes_deg))


@dataclass(frozen=True)
class Evaluation:
    """The outcome of one protocol."""

    protocol: Protocol  # with n_lights and trials from the draws file, if there is one
    # one for each capture and method, in the order of the captures, then of the methods
    results: tuple[Result, ...]
    skipped: tuple[SkippedCapture, ...] = ()  # the captures that could not be scored
    notes: tuple[str, ...] = ()  # sentences about the captures and how they were treated
    # "weights", "device", "precision" and "fingerprint" of each method by name; see Estimator
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(result.method for result in self.results))

    @property
    def captures(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(result.capture for result in self.results))

    @property
    def averages(self) -> dict[str, float]:
        """The mean of mae_deg over the captures, by method. Every method has a result for every
        capture.
        """
        return {
            method: math.fsum(r.mae_deg for r in self.results if r.method == method)
            / len(self.captures)
            for method in self.methods
        }


def all_skipped(evaluations: Sequence[Evaluation]) -> list[SkippedCapture]:
    """Return the captures skipped by any of the evaluations, each with a reason only once."""
    return list(
        {(each.capture, each.reason): each for e in evaluations for each in e.skipped}.values()
    )
