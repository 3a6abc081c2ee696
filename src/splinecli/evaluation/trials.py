"""Finished trials, kept as they come: an evaluation that was cut off, or is asked for more, goes on from them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from splinecli import __version__
from splinecli.capture.lights.draws import Draw
from splinecli.capture.stamp import digest
from splinecli.evaluation.records import Protocol
from splinecli.files import refusals_as_output_errors
from splinecli.methods import Estimator


@dataclass(frozen=True)
class Trial:
    """One method on one capture under one draw of lights, and all that decides its score.

    Args:
        capture: its name in the tables. method: its name.
        number: from 0. lights: the draw. light_noise_deg, seed, max_pixels: of the protocol.
        made_of: a digest of the capture's files and of the method's settings.
    """

    capture: str
    method: str
    number: int
    lights: Draw
    light_noise_deg: float
    seed: int
    max_pixels: int | None
    made_of: str

    @property
    def key(self) -> str:
        """SHA-256 of what decides the score: the noise depends on seed and number, the pixels on the seed."""
        values = asdict(self)
        del values["capture"]  # a name in the tables; the files themselves are in made_of
        if self.light_noise_deg == 0:
            del values["number"]
            if self.max_pixels is None:
                del values["seed"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Score:
    """mae_deg: over the scored pixels; seconds: spent estimating their normals."""

    mae_deg: float
    seconds: float


class TrialStore:
    """Scores by trial, in memory and in a file of JSON lines, where there is one.

    A line that cannot be read, such as one that was cut short, counts as not there.

    Args:
        path: the file, made at the first score; None for none.
        fresh: begin anew.

    Raises:
        OutputError: the file cannot be read or written.
    """

    def __init__(self, path: Path | None = None, *, fresh: bool = False) -> None:
        self._path = path
        self._lock = Lock()
        self._scores: dict[str, Score] = {}
        if path is None:
            return
        with refusals_as_output_errors(path):
            if fresh:
                path.unlink(missing_ok=True)
            content = path.read_text("utf-8", errors="replace") if path.exists() else ""
        for line in content.splitlines():
            record = _read_line(line)
            if record is not None:
                self._scores[record["key"]] = Score(record["mae_deg"], record["seconds"])
        # The next line must not be glued to one that was cut short.
        self._break_first = bool(content) and not content.endswith("\n")

    def find(self, trial: Trial) -> Score | None:
        return self._scores.get(trial.key)

    def add(self, trial: Trial, score: Score) -> None:
        """Keep a score; any thread may. Raises OutputError."""
        with self._lock:
            self._scores[trial.key] = score
            if self._path is None:
                return
            line = json.dumps({**asdict(trial), **asdict(score), "key": trial.key})
            with refusals_as_output_errors(self._path), self._path.open("a", encoding="utf-8") as file:
                file.write("\n" * self._break_first + line + "\n")
            self._break_first = False


def plan_trials(
    capture: str, stamp: list[Any], estimator: Estimator, draws: list[Draw], protocol: Protocol
) -> list[Trial]:
    """The trials of one method on one capture, whose files stamp_capture has stamped."""
    made_of = digest([__version__, estimator.fingerprint, *stamp])
    return [
        Trial(
            capture, estimator.name, number, draw, protocol.light_noise_deg, protocol.seed,
            protocol.max_pixels, made_of,
        )
        for number, draw in enumerate(draws)
    ]  # fmt: skip


def _read_line(line: str) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
        numbers = (record["mae_deg"], record["seconds"])
    except (ValueError, TypeError, KeyError):
        return None
    if not all(isinstance(number, float) for number in numbers) or not isinstance(record.get("key"), str):
        return None
    return dict(record)
