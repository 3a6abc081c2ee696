"""Methods scored side by side: the same captures, pixels, draws of lights and light noise for each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.plan import CaptureJob, ProtocolTrials, distinct_names, plan_capture, read_draws_file
from splinecli.evaluation.protocol import EVERY_CAPTURE, Evaluation, Protocol
from splinecli.evaluation.trial_capture import CaptureReading, Notes, SharedDraw
from splinecli.evaluation.trials import Score, Trial, TrialStore
from splinecli.methods import Estimator


class DrawTask(NamedTuple):
    """One draw of a capture: what is read for all its draws, and the trials of this one; none for the notes alone."""

    reading: CaptureReading
    trials: Sequence[Trial]


Scored = tuple[Sequence[Score], Notes] | SplinecliError
"""The score of each trial of a draw and the notes on its capture, or why the capture cannot be scored."""

Elsewhere = Callable[[Sequence[DrawTask]], Iterator[tuple[DrawTask, Scored]]]
"""Scores draws in other processes, and yields each with its scores as it ends."""

OnProgress = Callable[[float, str], object]
"""Called with the share of all trials that was just done, and a short text. A trial counts by its pixels."""


def evaluate_all(
    captures: Sequence[Path],
    estimators: Sequence[Estimator],
    protocols: Sequence[Protocol],
    *,
    store: TrialStore | None = None,
    jobs: int = 1,
    elsewhere: Elsewhere | None = None,
    on_progress: OnProgress = lambda share, note: None,
) -> list[Evaluation]:
    """Score every estimator on every capture under every protocol. There are some of each, with different names.

    A capture is called by its name (capture_name). Where two names are equal, the captures are called by the last
    parts of their paths. A folder that is given twice counts once. A capture that cannot be read, or has no ground
    truth or too few lights, is skipped, and the outcome says why.

    Args:
        store: where finished trials are stored; those that it has are not computed again.
        jobs: number of trials at a time, each on its share of the cores.
        elsewhere: scores the draws in other processes, in place of `jobs`.
        on_progress: see OnProgress. It is called by one thread at a time.

    Raises:
        UsageError: skip_first names a capture that does not exist.
        InputError: the draws file is wrong, or no capture could be scored. The error of a single capture is raised
            as it is, also a UsageError.
        SplinecliError: a method returned normals that are not unit vectors.
        OutputError: the store cannot be written.
    """
    tasks = [ProtocolTrials(*read_draws_file(protocol)) for protocol in protocols]
    names_by_folder = distinct_names(captures)
    names = list(names_by_folder.values())
    for protocol in protocols:
        for name in set(protocol.skip_first) - {EVERY_CAPTURE, *names}:
            raise UsageError(f"no capture named {name!r} to skip images of; there are {', '.join(names)}")
    store = TrialStore() if store is None else store
    planned = [plan_capture(folder, name, estimators, tasks, store) for folder, name in names_by_folder.items()]
    captures_to_score = [job for job in planned if job is not None]
    progress = _Progress(sum(len(draw) for job in captures_to_score for draw in job.draws), on_progress)
    if elsewhere is None:
        with _share_cores(jobs), ThreadPoolExecutor(jobs) as workers:
            try:
                _score_here(captures_to_score, {e.name: e for e in estimators}, store, progress, workers, jobs)
            except BaseException:
                workers.shutdown(cancel_futures=True)
                raise
    else:
        _score_elsewhere(captures_to_score, elsewhere, store, progress)
    names_of_settings = ("weights", "device", "precision", "fingerprint")
    settings = {e.name: {name: getattr(e, name) for name in names_of_settings} for e in estimators}
    return [task.evaluation(names, store, settings) for task in tasks]


def _score_here(
    captures: Sequence[CaptureJob],
    estimators: Mapping[str, Estimator],
    store: TrialStore,
    progress: _Progress,
    workers: ThreadPoolExecutor,
    jobs: int,
) -> None:
    """Score `jobs` trials at a time in threads. Raises what a trial raises."""

    def score(shared: SharedDraw, trial: Trial) -> None:
        store.add(trial, shared.score(trial, estimators[trial.method], progress.begin))

    running: set[Future[None]] = set()
    for job in captures:
        name = job.reading.name
        try:
            source, notes = job.reading.read(job.source, partial(progress.read_image, name))
        except (InputError, UsageError) as error:
            job.fail(error)
            progress.skip(sum(map(len, job.draws)))
            continue
        job.note(notes)
        for draw in job.draws:
            shared = SharedDraw(source)
            for trial in draw:
                running.add(workers.submit(score, shared, trial))
                running = _wait(running, jobs)  # one trial waits, so that no core does
            del shared
        del source  # before the next capture is read
    _wait(running, 0)


def _score_elsewhere(
    captures: Sequence[CaptureJob], elsewhere: Elsewhere, store: TrialStore, progress: _Progress
) -> None:
    """Let other processes score the trials. Raises what a trial raises."""
    jobs = {job.reading.name: job for job in captures}
    for task, scored in elsewhere([DrawTask(job.reading, draw) for job in captures for draw in job.draws or [[]]]):
        job = jobs[task.reading.name]
        if isinstance(scored, SplinecliError):
            job.fail(scored)
        else:
            scores, notes = scored
            job.note(notes)
            for trial, score in zip(task.trials, scores, strict=True):
                store.add(trial, score)
        progress.skip(len(task.trials))


class _Progress:
    """Counts trials over all threads."""

    def __init__(self, total: int, advance: OnProgress) -> None:
        self._total, self._advance = total, advance
        self._lock = Lock()
        self._finished = 0

    def read_image(self, capture: str, n_read: int, n_images: int) -> None:
        with self._lock:
            self._advance(0, f"reading {capture}, image {n_read} of {n_images}")

    def skip(self, count: int) -> None:
        with self._lock:
            self._finished += count
            self._advance(count / max(1, self._total), "")

    def begin(self, n_pixels: int) -> Callable[[int], None]:
        """Begin a trial. Returns the function that counts its pixels."""
        done = 0

        def count(pixels: int) -> None:
            nonlocal done
            with self._lock:
                done += pixels
                self._finished += done >= n_pixels
                note = f"trial {min(self._finished + 1, self._total)} of {self._total}"
                self._advance(pixels / n_pixels / self._total, note)

        return count


def _wait(running: set[Future[None]], at_most: int) -> set[Future[None]]:
    """Wait until at most so many trials run, and return them. Raises what a finished one raised."""
    while len(running) > at_most:
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
    return running


@contextmanager
def _share_cores(jobs: int) -> Iterator[None]:
    """Let PyTorch compute each of `jobs` trials at a time on a share of the cores. Does not import PyTorch."""
    torch = sys.modules.get("torch")
    if torch is None or jobs == 1:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, before // jobs))
    try:
        yield
    finally:
        torch.set_num_threads(before)
