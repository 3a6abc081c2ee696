"""Draws of lights that other processes score. Each process reads the captures itself, and only scores come back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.capture_reading import CaptureReading, open_to_score
from splinecli.evaluation.trial_capture import SharedDraw, TrialSource
from splinecli.evaluation.trials import Score, Trial
from splinecli.methods import Estimator


@dataclass(frozen=True)
class DrawTask:
    """One draw of a capture: what is read for all its draws, and the trials of this one; none for the notes alone."""

    reading: CaptureReading
    trials: tuple[Trial, ...] = ()


@dataclass(frozen=True)
class DrawScores:
    """The scores of a draw, one for each of its trials, and the notes on the capture, by protocol.

    `error` says why the capture cannot be scored.
    """

    scores: tuple[Score, ...] = ()
    notes: Sequence[tuple[str, ...]] = ()
    error: SplinecliError | None = None


class DrawScorer:
    """Scores draws in another process than that of the evaluation. It keeps the last capture in memory."""

    def __init__(self, estimators: Sequence[Estimator]) -> None:
        self._estimators = {estimator.name: estimator for estimator in estimators}
        self._last: tuple[CaptureReading, TrialSource, list[tuple[str, ...]]] | None = None

    def score(self, task: DrawTask) -> DrawScores:
        """Return the scores of a draw. Raises what a trial raises."""
        if self._last is None or self._last[0] != task.reading:
            self._last = None  # frees the memory
            reading = task.reading
            try:
                self._last = reading, *reading.read(open_to_score(reading.folder, reading.protocols[0]))
            except (InputError, UsageError) as error:
                return DrawScores(error=error)
        _, source, notes = self._last
        if not task.trials:
            return DrawScores(notes=notes)
        shared = SharedDraw(source, task.trials[0])
        return DrawScores(tuple(shared.score(self._estimators[trial.method]) for trial in task.trials), notes)
