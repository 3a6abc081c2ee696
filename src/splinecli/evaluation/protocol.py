"""How an evaluation is done: the lights, trials, noise and pixels, and how captures are read; and its outcome."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.lights.draws import check_draw_settings
from splinecli.errors import UsageError

EVERY_CAPTURE = "*"  # key of `skip_first` for all captures that have no key of their own
LARGEST_SIGMA_DEG = 30.0  # largest standard deviation of the light noise that an evaluation accepts


@dataclass(frozen=True)
class Protocol:
    """Settings of an evaluation. Two methods are comparable only under the same protocol.

    Raises UsageError if a value is out of its range.
    """

    # in each draw. None means all lights of a capture. A draws file replaces it, and trials.
    n_lights: int | None = None
    trials: int = 1  # the number of random draws. Without light noise, all lights need one trial only.
    seed: int = 0  # of the draws, of the light noise and of the choice of pixels
    draws_file: Path | None = None  # file that gives the draws instead; see read_draws
    light_noise_deg: float = 0.0  # standard deviation of the angle by which each trial tilts the light directions
    # number of pixels to score in each capture, chosen at random. None scores all pixels that have ground truth.
    max_pixels: int | None = None
    # number of first images to leave out, by the name of the capture; EVERY_CAPTURE for all others
    skip_first: Mapping[str, int] = field(default_factory=dict)
    # score the stored values alone, as the published tables do. By default, saturated observations are restored and
    # unknown light intensities are estimated, as `infer` does.
    as_stored: bool = False
    white_level: float | None = None
    # usual error of light directions, with which each trial refines its directions (see refine_capture). None refines
    # none.
    light_error_deg: float | None = None
    finds_lights: bool = False  # whether each trial finds its lights from its images, as `infer --lights estimate` does

    def __post_init__(self) -> None:
        check_draw_settings(self.n_lights, self.trials, self.seed)
        if not 0 <= self.light_noise_deg <= LARGEST_SIGMA_DEG:
            raise UsageError(f"light noise of {self.light_noise_deg:g} degrees, expected 0 to {LARGEST_SIGMA_DEG:g}")

    def skipped_lights(self, capture: str) -> int:
        """Return how many first lights of a capture are left out."""
        return self.skip_first.get(capture, self.skip_first.get(EVERY_CAPTURE, 0))


def lights_value(protocol: Protocol) -> int | str:
    """Return the number of lights in each draw, or "all"."""
    return "all" if protocol.n_lights is None else protocol.n_lights


def lights_in_words(protocol: Protocol) -> str:
    """Return the lights of a draw as text: "10 lights", "all lights"."""
    return f"{lights_value(protocol)} lights"


def heading(protocol: Protocol) -> str:
    """Return what differs between evaluations: "10 lights", "all lights, light noise of 2 degrees"."""
    noise = f", light noise of {protocol.light_noise_deg:g} degrees" if protocol.light_noise_deg else ""
    return lights_in_words(protocol) + noise


def protocol_in_words(protocol: Protocol) -> str:
    """Return the whole protocol as text: "10 lights, 20 random draws, seed 0, images restored"."""
    parts = [heading(protocol)]
    if protocol.draws_file is not None:
        parts.append(f"the {protocol.trials} draws of {protocol.draws_file.name}")
    elif protocol.n_lights is not None:
        parts.append(f"{protocol.trials} random {'draw' if protocol.trials == 1 else 'draws'}")
    elif protocol.light_noise_deg:  # without noise, all lights are one trial, whatever number was given
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
    maes_deg: tuple[float, ...]  # mean angular error (MAE) over the scored pixels, in degrees, of each trial
    seconds: float  # mean time to estimate the normals of a trial
    # mean error of the light directions that the trials estimated; None where they did not
    found_light_error_deg: float | None = None

    @property
    def trials(self) -> int:
        """Number of trials."""
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
class Skipped:
    """A capture that could not be scored, and the reason."""

    capture: str
    reason: str


@dataclass(frozen=True)
class Evaluation:
    """The outcome of one protocol."""

    protocol: Protocol  # the protocol; n_lights and trials are those of the draws file where there is one
    results: tuple[Result, ...]  # one for each capture and method, captures in the order given, then methods
    skipped: tuple[Skipped, ...] = ()  # the captures that could not be scored
    notes: tuple[str, ...] = ()  # sentences about the captures and how the evaluation treated them
    # {"weights", "device", "precision", "fingerprint"} of each method by name; see Estimator
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods, each once."""
        return tuple(dict.fromkeys(result.method for result in self.results))

    @property
    def captures(self) -> tuple[str, ...]:
        """Names of the scored captures, each once."""
        return tuple(dict.fromkeys(result.capture for result in self.results))

    @property
    def averages(self) -> dict[str, float]:
        """Mean of mae_deg over the captures, by method. Every method has a result for every capture."""
        return {
            method: math.fsum(r.mae_deg for r in self.results if r.method == method) / len(self.captures)
            for method in self.methods
        }


def all_captures(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return the names of the captures that any of the evaluations scored, each once."""
    return list(dict.fromkeys(capture for e in evaluations for capture in e.captures))


def all_skipped(evaluations: Sequence[Evaluation]) -> list[Skipped]:
    """Return the captures that any of the evaluations skipped; the same reason comes once."""
    return list(dict.fromkeys(skipped for e in evaluations for skipped in e.skipped))
