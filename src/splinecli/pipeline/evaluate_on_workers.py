"""The trials of `evaluate` on several processes or machines: one item a draw of lights."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from splinecli.capture import open_capture
from splinecli.errors import ModelError
from splinecli.evaluation.draws_elsewhere import DrawScorer, DrawScores, DrawTask
from splinecli.methods import Estimator, MethodOptions, make_estimator
from splinecli.pipeline.capture_memory import source_bytes
from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.distribution import Item, LostError, distributor
from splinecli.pipeline.observer import Observer


@dataclass(frozen=True)
class _Settings:
    command: str
    methods: tuple[str, ...]
    method_options: MethodOptions
    fingerprints: tuple[str, ...]


def score_on_workers(
    estimators: Sequence[Estimator],
    method_options: MethodOptions,
    cluster: ClusterOptions,
    output: Path,
    observer: Observer,
    draws: Sequence[DrawTask],
) -> Iterator[tuple[DrawTask, DrawScores]]:
    """Yield the draws with their scores as they end. Only the process of the command writes the store of trials.

    Args:
        estimators, method_options: the methods.
        cluster: where draws are scored.
        output: a folder that all workers see.
        observer: receives messages.
        draws: what is scored.

    Raises:
        LostError: the workers of a draw were lost. All others are scored.
        SplinecliError: what a trial or Distributor.run raises.
    """
    settings = _Settings(
        uuid.uuid4().hex,
        tuple(estimator.name for estimator in estimators),
        method_options,
        tuple(estimator.fingerprint for estimator in estimators),
    )
    lost: LostError | None = None
    with distributor(partial(_score, settings), output, cluster, observer) as workers:
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


def _score(settings: _Settings, draw: DrawTask) -> DrawScores:
    return _scorer(settings).score(draw)


@lru_cache(maxsize=1)
def _scorer(settings: _Settings) -> DrawScorer:
    """Return the scorer of the command that this worker serves."""
    estimators = [make_estimator(name, settings.method_options) for name in settings.methods]
    for estimator, expected in zip(estimators, settings.fingerprints, strict=True):
        if estimator.fingerprint != expected:
            raise ModelError(
                f"{estimator.name} is {estimator.fingerprint} here, expected {expected} as on the machine of the"
                " command",
                hint="Use the same weight file everywhere, and the same --precision",
            )
    return DrawScorer(estimators)
