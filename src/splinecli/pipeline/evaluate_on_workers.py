"""The trials of `evaluate` on several processes or machines: one item a draw of lights. Only scores come back."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path

from splinecli.capture import open_capture
from splinecli.errors import InputError, ModelError, UsageError
from splinecli.evaluation.capture_reading import CaptureReading, Notes, open_to_score
from splinecli.evaluation.run import DrawTask, Scored
from splinecli.evaluation.trial_capture import SharedDraw, TrialSource
from splinecli.methods import Estimator, MethodOptions, make_estimator
from splinecli.pipeline.capture_memory import source_bytes
from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.distribution import Item, LostError, distributor
from splinecli.pipeline.observer import Observer


def score_on_workers(
    estimators: Sequence[Estimator],
    method_options: MethodOptions,
    cluster: ClusterOptions,
    output: Path,
    observer: Observer,
    draws: Sequence[DrawTask],
) -> Iterator[tuple[DrawTask, Scored]]:
    """Yield the draws with their scores as they end. Only the process of the command writes the store of trials.

    `output` is a folder that all workers see.

    Raises:
        LostError: the workers of a draw were lost. All others are scored.
        SplinecliError: what a trial or Distributor.run raises.
    """
    fingerprints = tuple((estimator.name, estimator.fingerprint) for estimator in estimators)
    score = partial(_score, uuid.uuid4().hex, fingerprints, method_options)
    lost: LostError | None = None
    with distributor(score, output, cluster, observer) as workers:
        for item, result in workers.run(_items(draws)):
            if isinstance(result, LostError):
                lost = result
            else:
                yield item.args[0], result
    if lost is not None:
        raise lost


def _items(draws: Iterable[DrawTask]) -> Iterator[Item]:
    folder, memory = None, 0.0
    for draw in draws:
        if draw.reading.folder != folder:
            folder = draw.reading.folder
            memory = source_bytes(lambda: open_capture(folder))  # noqa: B023 - called here
        yield Item((draw,), draw.reading.name, memory)


def _score(command: str, fingerprints: tuple[tuple[str, str], ...], options: MethodOptions, draw: DrawTask) -> Scored:
    return _scorer(command, fingerprints, options).score(draw)


@lru_cache(maxsize=1)
def _scorer(_command: str, fingerprints: tuple[tuple[str, str], ...], options: MethodOptions) -> _Scorer:
    """Return the scorer of the command that this worker serves: files may change until the next command."""
    estimators = {name: make_estimator(name, options) for name, _ in fingerprints}
    for name, expected in fingerprints:
        if (found := estimators[name].fingerprint) != expected:
            raise ModelError(
                f"{name} is {found} here, expected {expected} as on the machine of the command",
                hint="Use the same weight file everywhere, and the same --precision",
            )
    return _Scorer(estimators)


class _Scorer:
    """Scores draws, and keeps the last capture in memory."""

    def __init__(self, estimators: dict[str, Estimator]) -> None:
        self._estimators = estimators
        self._last: tuple[CaptureReading, TrialSource, Notes] | None = None

    def score(self, task: DrawTask) -> Scored:
        if self._last is None or self._last[0] != task.reading:
            self._last = None  # frees the memory
            reading = task.reading
            try:
                self._last = reading, *reading.read(open_to_score(reading.folder, reading.protocols[0]))
            except (InputError, UsageError) as error:
                return error
        _, source, notes = self._last
        shared = SharedDraw(source)
        return [shared.score(trial, self._estimators[trial.method]) for trial in task.trials], notes
