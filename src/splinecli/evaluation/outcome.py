"""The outcome of an evaluation: a result for each method and capture, and the captures that have none."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splinecli.evaluation.protocol import Protocol


@dataclass(frozen=True)
class Result:
    """The errors of one method on one capture.

    Args:
        capture: name of the capture in the tables.
        n_lights: number of lights in each draw.
        maes_deg: mean angular error (MAE) over the scored pixels, in degrees, of each trial.
        seconds: mean time to estimate the normals of a trial.
        found_light_error_deg: mean error of the light directions that the trials estimated; None where they did not.
    """

    method: str
    capture: str
    n_lights: int
    maes_deg: tuple[float, ...]
    seconds: float
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
    """The outcome of one protocol.

    Args:
        protocol: the protocol; n_lights and trials are those of the draws file where there is one.
        results: one for each capture and method, captures in the order given, then methods.
        skipped: the captures that could not be scored.
        notes: sentences about the captures and how the evaluation treated them.
        settings: {"weights", "device", "precision", "fingerprint"} of each method by name; see Estimator.
    """

    protocol: Protocol
    results: tuple[Result, ...]
    skipped: tuple[Skipped, ...] = ()
    notes: tuple[str, ...] = ()
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
