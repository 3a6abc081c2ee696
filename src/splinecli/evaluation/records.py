"""What an evaluation is asked and what it answers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.lights.draws import check_draw_settings
from splinecli.errors import UsageError
from splinecli.evaluation.light_noise import LARGEST_SIGMA_DEG


@dataclass(frozen=True)
class Protocol:
    """How an evaluation is done.

    Args:
        n_lights: K, the lights a draw; None for all of a capture's lights, or for what the draws file holds.
        trials: T, the random draws; all lights without light noise need one only.
        seed: of the draws, the light noise and the choice of pixels.
        draws_file: take the draws from there instead; see read_draws.
        light_noise_deg: the light directions are turned by angles from N(0, this) in each trial.
        max_pixels: score a random part of each capture's pixels; None for all that have ground truth.
        skip_first: the first images of captures to leave out, by the captures' names; "*" for all others. The
            first 20 of DiLiGenT's Bear are damaged.

    Raises:
        UsageError: a value is out of its range.
    """

    n_lights: int | None = None
    trials: int = 1
    seed: int = 0
    draws_file: Path | None = None
    light_noise_deg: float = 0.0
    max_pixels: int | None = None
    skip_first: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_draw_settings(self.n_lights, self.trials, self.seed)
        if not 0 <= self.light_noise_deg <= LARGEST_SIGMA_DEG:
            raise UsageError(
                f"light noise of {self.light_noise_deg:g} degrees, expected 0 to {LARGEST_SIGMA_DEG:g}"
            )
        if self.max_pixels is not None and self.max_pixels < 1:
            raise UsageError(f"at most {self.max_pixels} pixels to score, expected at least 1")
        for name, count in self.skip_first.items():
            if count < 0:
                raise UsageError(f"{count} images of {name} to skip, expected a number from 0")

    def skipped_lights(self, capture: str) -> int:
        """How many of a capture's first lights are left out."""
        return self.skip_first.get(capture, self.skip_first.get("*", 0))


@dataclass(frozen=True)
class Result:
    """One method on one capture. MAE: the mean angular error over the scored pixels, in degrees.

    maes_deg: the MAE of each trial; mae_deg and std_deg: their mean and population standard deviation.
    n_lights: lights in each draw. seconds: mean time to estimate a trial's normals.
    """

    method: str
    capture: str
    n_lights: int
    maes_deg: tuple[float, ...]
    seconds: float

    @property
    def trials(self) -> int:
        return len(self.maes_deg)

    @property
    def mae_deg(self) -> float:
        return math.fsum(self.maes_deg) / self.trials

    @property
    def std_deg(self) -> float:
        return float(np.std(self.maes_deg))


@dataclass(frozen=True)
class Skipped:
    """A capture that could not be scored, and why."""

    capture: str
    reason: str


@dataclass(frozen=True)
class Evaluation:
    """What evaluate found: a result for each capture and method, captures in the order given, then methods.

    protocol: as asked for; with a draws file, n_lights and trials are the file's.
    notes: sentences on what is particular about the captures and how it was dealt with.
    settings: of each method by name: {"weights", "device", "precision", "fingerprint"}, as in Estimator.
    """

    protocol: Protocol
    results: tuple[Result, ...]
    skipped: tuple[Skipped, ...] = ()
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(result.method for result in self.results))

    @property
    def captures(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(result.capture for result in self.results))

    @property
    def averages(self) -> dict[str, float]:
        """Each method's mean of the captures' mae_deg; every method has a result for every capture."""
        return {
            method: math.fsum(r.mae_deg for r in self.results if r.method == method) / len(self.captures)
            for method in self.methods
        }
