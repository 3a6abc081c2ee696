"""Methods scored side by side: the same captures, pixels, draws of lights and light noise for each."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Lock

from splinecli.errors import InputError, UsageError
from splinecli.evaluation.draws_elsewhere import DrawScores, DrawTask
from splinecli.evaluation.outcome import Evaluation
from splinecli.evaluation.plan import CaptureJob, ProtocolTrials, check_skip_first, distinct_names, read_draws_file
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.trial_capture import SharedDraw
from splinecli.evaluation.trials import Trial, TrialStore
from splinecli.methods import Estimator

Elsewhere = Callable[[Sequence[DrawTask]], Iterator[tuple[DrawTask, DrawScores]]]
"""Scores draws in other processes, and yields each with its scores as it ends."""

OnProgress = Callable[[float, int, str], object]
"""Called with the trials done, the total, and a short text. A running trial counts by the share of its pixels."""


def evaluate(captures: Sequence[Path], estimators: Sequence[Estimator], protocol: Protocol) -> Evaluation:
    """Score every estimator on every capture under one protocol; see evaluate_all."""
    return evaluate_all(captures, estimators, [protocol])[0]


def evaluate_all(
    captures: Sequence[Path],
    estimators: Sequence[Estimator],
    protocols: Sequence[Protocol],
    *,
    store: TrialStore | None = None,
    jobs: int = 1,
    elsewhere: Elsewhere | None = None,
    on_progress: OnProgress | None = None,
) -> list[Evaluation]:
    """Score every estimator on every capture under every protocol.

    A capture is called by its name (capture_name). Where two names are equal, the captures are called by the last
    parts of their paths. A folder that is given twice counts once. A capture that cannot be read, or has no ground
    truth or too few lights, is skipped, and the outcome says why.

    Args:
        captures: folders.
        estimators: methods with different names.
        protocols: at least one.
        store: where finished trials are stored; those that it has are not computed again.
        jobs: number of trials at a time, each on its share of the cores.
        elsewhere: scores the draws in other processes, in place of `jobs`.
        on_progress: see OnProgress. It is called by one thread at a time.

    Raises:
        UsageError: there are no captures or estimators, two estimators have the same name, n_lights is not the number
            of lights in the draws file, or skip_first names a capture that does not exist.
        InputError: the draws file is wrong, or no capture could be scored. The error of a single capture is raised
            as it is, also a UsageError.
        SplinecliError: a method returned normals that are not unit vectors.
        OutputError: the store cannot be written.
    """
    if not captures or not estimators:
        raise UsageError("there is nothing to score: give at least one capture and one method")
    for method, count in Counter(estimator.name for estimator in estimators).items():
        if count > 1:
            raise UsageError(f"method {method} comes twice", hint="Name each method once")
    tasks = [ProtocolTrials(*read_draws_file(protocol)) for protocol in protocols]
    names_by_folder = distinct_names(captures)
    names = list(names_by_folder.values())
    for protocol in protocols:
        check_skip_first(protocol, names)
    store = TrialStore() if store is None else store
    planned = [CaptureJob.plan(folder, name, estimators, tasks) for folder, name in names_by_folder.items()]
    run = _Run([job for job in planned if job is not None], store, on_progress)
    if elsewhere is None:
        run.run(jobs)
    else:
        run.run_elsewhere(elsewhere)
    names_of_settings = ("weights", "device", "precision", "fingerprint")
    settings = {e.name: {name: getattr(e, name) for name in names_of_settings} for e in estimators}
    return [replace(task.evaluation(names, store), settings=settings) for task in tasks]


class _Run:
    """Scores the trials that the store does not have."""

    def __init__(
        self, jobs_by_capture: Sequence[CaptureJob], store: TrialStore, on_progress: OnProgress | None
    ) -> None:
        self._captures = [(job, job.missing(store)) for job in jobs_by_capture]
        self._store = store
        total = sum(len(draw) for _, draws in self._captures for draw in draws)
        self._progress = _Progress(total, on_progress)

    def run(self, jobs: int) -> None:
        """Score `jobs` trials at a time. Raises what a trial raises."""
        with _share_cores(jobs), ThreadPoolExecutor(jobs) as workers:
            try:
                self._submit_all(workers, jobs)
            except BaseException:
                workers.shutdown(cancel_futures=True)
                raise

    def run_elsewhere(self, elsewhere: Elsewhere) -> None:
        """Let other processes score the trials. Raises what a trial raises."""
        jobs = {job.name: job for job, _ in self._captures}
        tasks = [
            DrawTask(reading, tuple(trial for trial, _ in draw))
            for reading, draws in ((job.reading(draws), draws) for job, draws in self._captures)
            for draw in draws or [[]]
        ]
        for task, result in elsewhere(tasks):
            job = jobs[task.reading.name]
            if result.error is not None:
                job.fail(result.error)
            else:
                job.note(result.notes)
                for trial, score in zip(task.trials, result.scores, strict=True):
                    self._store.add(trial, score)
            self._progress.skip(len(task.trials))

    def _submit_all(self, workers: ThreadPoolExecutor, jobs: int) -> None:
        running: set[Future[None]] = set()
        for job, draws in self._captures:

            def show_image(n_read: int, n_images: int, name: str = job.name) -> None:
                self._progress.note(f"reading {name}, image {n_read} of {n_images}")

            try:
                source, notes = job.reading(draws).read(job.source, show_image)
            except (InputError, UsageError) as error:
                job.fail(error)
                self._progress.skip(sum(map(len, draws)))
                continue
            job.note(notes)
            for draw in draws:
                shared = SharedDraw(source, draw[0][0])
                for trial, estimator in draw:
                    running.add(workers.submit(self._score, shared, trial, estimator))
                    running = _wait(running, jobs)  # one trial waits, so that no core does
                del shared
            del source  # before the next capture is read
        _wait(running, 0)

    def _score(self, shared: SharedDraw, trial: Trial, estimator: Estimator) -> None:
        self._store.add(trial, shared.score(estimator, self._progress.begin))


class _Progress:
    """Counts trials over all threads."""

    def __init__(self, total: int, on_progress: OnProgress | None) -> None:
        self._total, self._on_progress = total, on_progress
        self._lock = Lock()
        self._finished = 0
        self._running: dict[int, float] = {}
        self._begun = 0

    def note(self, text: str) -> None:
        with self._lock:
            self._show(text)

    def skip(self, count: int) -> None:
        with self._lock:
            self._finished += count
            self._show("")

    def begin(self, n_pixels: int) -> Callable[[int], None]:
        """Begin a trial. Returns the function that counts its pixels."""
        with self._lock:
            number, done = self._begun, 0
            self._begun += 1
            self._running[number] = 0.0

        def advance(pixels: int) -> None:
            nonlocal done
            with self._lock:
                done += pixels
                if done < n_pixels:
                    self._running[number] = done / n_pixels
                else:
                    del self._running[number]
                    self._finished += 1
                self._show(f"trial {min(self._finished + 1, self._total)} of {self._total}")

        return advance

    def _show(self, text: str) -> None:
        if self._on_progress is not None:
            self._on_progress(self._finished + sum(self._running.values()), self._total, text)


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
