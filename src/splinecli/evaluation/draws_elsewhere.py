"""Draws of lights that other processes score. Each process reads the captures itself, and only scores come back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.plan import CaptureJob, ProtocolTrials, Unit
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.trial_capture import SharedDraw, TrialSource
from splinecli.evaluation.trials import Score
from splinecli.methods import Estimator

Missing = tuple[tuple[int, tuple[int, ...]], ...]
"""What is to be scored of a capture: the number of each draw in CaptureJob.draws, and of its methods."""


@dataclass(frozen=True)
class DrawTask:
    """One draw of a capture, with what else is to be scored of it: a capture is read under all these lights.

    Args:
        folder, name: the capture.
        missing: all that is to be scored of it.
        draw: the position in `missing`; None to read the capture only, for the notes on it.
    """

    folder: Path
    name: str
    missing: Missing
    draw: int | None


@dataclass(frozen=True)
class DrawScores:
    """The scores of a draw, one for each of its methods, and the notes on the capture, by protocol.

    `error` says why the capture cannot be scored.
    """

    scores: tuple[Score, ...] = ()
    notes: tuple[tuple[str, ...], ...] = ()
    error: SplinecliError | None = None


class DrawScorer:
    """Scores draws in another process than that of the evaluation. It keeps the last capture in memory."""

    def __init__(self, estimators: Sequence[Estimator], protocols: Sequence[Protocol]) -> None:
        self._estimators, self._protocols = estimators, protocols
        self._of: tuple[Path, Missing] | None = None
        self._read: tuple[CaptureJob, list[list[Unit]], TrialSource]

    def score(self, task: DrawTask) -> DrawScores:
        """Return the scores of a draw. Raises what a trial raises."""
        try:
            job, draws, source = self._capture(task)
        except (InputError, UsageError) as error:
            return DrawScores(error=error)
        notes = tuple(planned.notes.get(task.name, ()) for planned in job.tasks)
        if task.draw is None:
            return DrawScores(notes=notes)
        draw = draws[task.draw]
        shared = SharedDraw(source, draw[0][0])
        return DrawScores(tuple(shared.score(estimator) for _, estimator in draw), notes)

    def _capture(self, task: DrawTask) -> tuple[CaptureJob, list[list[Unit]], TrialSource]:
        if self._of != (task.folder, task.missing):
            self._of = None
            tasks = [ProtocolTrials.of(protocol) for protocol in self._protocols]
            job = CaptureJob.plan(task.folder, task.name, self._estimators, tasks)
            if job is None:
                raise tasks[0].failures[task.name]
            draws = [[job.draws[number][unit] for unit in units] for number, units in task.missing]
            self._read = job, draws, job.read(draws or job.draws[:1])
            self._of = task.folder, task.missing
        return self._read
