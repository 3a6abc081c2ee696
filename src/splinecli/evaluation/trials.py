"""Trials and their scores. Scores are stored as they come, so that an interrupted evaluation can go on."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from threading import Lock
from typing import Any

from splinecli.capture.lights.draws import Draw
from splinecli.evaluation.protocol import Protocol
from splinecli.system.files import parse_json, refusals_as_output_errors, write_text
from splinecli.system.publishing import is_plain

_LONGEST_LINE = 1 << 16  # characters


@dataclass(frozen=True)
class Trial:
    """One method on one capture under one draw of lights, with everything that decides its score."""

    capture: str  # name of the capture in the tables
    method: str
    number: int  # of the trial, from 0
    lights: Draw
    protocol: Protocol
    made_of: str  # digest of the capture's files and of the method's settings

    @property
    def record(self) -> dict[str, Any]:
        """The trial as JSON values."""
        p = self.protocol
        return {
            "capture": self.capture,
            "method": self.method,
            "number": self.number,
            "lights": self.lights,
            "light_noise_deg": p.light_noise_deg,
            "seed": p.seed,
            "max_pixels": p.max_pixels,
            "as_stored": p.as_stored,
            "made_of": self.made_of,
            "light_error_deg": p.light_error_deg,
            "finds_lights": p.finds_lights,
        }

    @property
    def key(self) -> str:
        """SHA-256 of what decides the score. The noise depends on seed and number, the pixels on the seed."""
        values = self.record
        del values["capture"]  # only a name in the tables: made_of has the files themselves
        if self.protocol.light_error_deg is None:
            del values["light_error_deg"]  # so that earlier trials stay valid
        if not self.protocol.finds_lights:
            del values["finds_lights"]  # likewise
        if self.protocol.light_noise_deg == 0:
            del values["number"]
            if self.protocol.max_pixels is None:
                del values["seed"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Score:
    """The score of a trial."""

    mae_deg: float  # mean angular error over the scored pixels
    seconds: float  # time spent on estimating their normals
    estimated_intensities: bool  # whether the light intensities were estimated from the images
    # mean error of light directions that were estimated from the images; None where none were
    found_light_error_deg: float | None = None


class TrialStore:
    """Scores by trial, in memory and, where a path is given, in a file of JSON lines, which the first score creates.

    A line that cannot be read, such as one that was cut short, is dropped. A link is replaced, not followed. `fresh`
    deletes the scores of an earlier evaluation. Raises OutputError if the file cannot be read or written.
    """

    def __init__(self, path: Path | None = None, *, fresh: bool = False) -> None:
        self._path = path
        self._lock = Lock()
        self._scores: dict[str, Score] = {}
        if path is None:
            return
        with refusals_as_output_errors(path):
            kept = []
            if is_plain(path) and not fresh:
                with path.open(encoding="utf-8", errors="replace") as file:
                    while line := file.readline(_LONGEST_LINE):  # a longer one in parts
                        if (read := _read_line(line)) is not None:
                            kept.append(line.rstrip("\n") + "\n")
                            self._scores.update((read,))
            # Anew, because the next lines would reach every other name of this file.
            if os.path.lexists(path):
                write_text(path, "".join(kept))

    def find(self, trial: Trial) -> Score | None:
        """Return the score of a trial, or None where it is not stored."""
        return self._scores.get(trial.key)

    def add(self, trial: Trial, score: Score) -> None:
        """Store a score. Any thread may call this. Raises OutputError."""
        with self._lock:
            self._scores[trial.key] = score
            if self._path is None:
                return
            line = json.dumps({**trial.record, **asdict(score), "key": trial.key})
            with refusals_as_output_errors(self._path), self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")


def _read_line(line: str) -> tuple[str, Score] | None:
    """Return the key and the score of a trial."""
    try:
        record = parse_json(line)
        key, score = record["key"], Score(**{field.name: record.get(field.name) for field in fields(Score)})
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    usable = isinstance(key, str) and isinstance(score.mae_deg, float) and isinstance(score.seconds, float)
    usable = usable and isinstance(score.estimated_intensities, bool)
    return (key, score) if usable and isinstance(score.found_light_error_deg, float | None) else None
