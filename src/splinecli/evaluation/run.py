"""Plan the trials of an evaluation before any image is read, and score them in parallel."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

from splinecli._version import __version__
from splinecli.capture import Capture, CaptureOptions, CaptureSource, capture_name, open_capture
from splinecli.capture.files import digest
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.estimate.methods import Estimator
from splinecli.evaluation.protocol import (
    EVERY_CAPTURE,
    DrawsFile,
    Evaluation,
    Protocol,
    Result,
    read_draws,
)
from splinecli.evaluation.tables import AVERAGE
from splinecli.evaluation.trials import (
    CaptureReading,
    Notes,
    Score,
    SharedDraw,
    Trial,
    TrialSource,
    TrialStore,
    open_to_score,
)
from splinecli.lights.draws import Draw, draw_lights
from splinecli.lights.light_fit import check_distant
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.recipe.steps import begin, follow
from splinecli.recipe.work import RecipeOptions, Work
from splinecli.records.documents import SkippedCapture


@dataclass
class ProtocolTrials:
    """A protocol with the trials of each capture and method, and the captures that failed."""

    protocol: Protocol
    draws_file: DrawsFile | None
    trials: dict[tuple[str, str], list[Trial]] = field(default_factory=dict)
    failures: dict[str, SplinecliError] = field(default_factory=dict)
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def fail(self, capture: str, error: SplinecliError) -> None:
        """Record why a capture cannot be scored, and remove its trials."""
        self.failures.setdefault(capture, error)
        self.trials = {key: trials for key, trials in self.trials.items() if key[0] != capture}

    def evaluation(
        self, captures: Sequence[str], store: TrialStore, settings: Mapping[str, Mapping[str, Any]]
    ) -> Evaluation:
        """Return the outcome, in the order of the captures. Raises an error if all captures
        failed.
        """
        results, n_estimated, light_errors_deg = [], {}, {}
        for (capture, method), trials in self.trials.items():
            scores = [score for trial in trials if (score := store.find(trial)) is not None]
            seconds = math.fsum(score.seconds for score in scores) / len(scores)
            maes_deg = tuple(score.mae_deg for score in scores)
            found = [s.found_light_error_deg for s in scores if s.found_light_error_deg is not None]
            light_errors_deg[capture] = math.fsum(found) / len(found) if found else None
            result = Result(
                method, capture, len(trials[0].lights), maes_deg, seconds, light_errors_deg[capture]
            )
            results.append(result)
            n_estimated[capture] = (
                sum(score.estimated_intensities for score in scores),
                len(scores),
            )
        if not results:
            failures = [self.failures[name] for name in captures]
            if len(failures) == 1:
                raise failures[0]
            kind = (
                UsageError
                if all(isinstance(failure, UsageError) for failure in failures)
                else InputError
            )
            first = str(failures[0]).removesuffix(".")
            raise kind(
                f"none of the {len(failures)} captures could be scored; the first error is: {first}"
            )
        skipped = (
            SkippedCapture(capture=name, reason=str(self.failures[name]))
            for name in captures
            if name in self.failures
        )
        notes = [note for name in captures for note in self.notes.get(name, ())]
        notes += [
            f"{name}: the light intensities were estimated in {count} of {of} trials, because no"
            " file contains them."
            for name, (count, of) in n_estimated.items()
            if count
        ]
        notes += [
            f"{name}: the mean error of the estimated light directions is {error_deg:.2f} degrees."
            for name, error_deg in light_errors_deg.items()
            if error_deg is not None
        ]
        return Evaluation(self.protocol, tuple(results), tuple(skipped), tuple(notes), settings)


@dataclass
class CaptureJob:
    """An open capture with the protocols that can score it and the missing trials of each draw."""

    source: CaptureSource
    reading: CaptureReading
    tasks: list[ProtocolTrials]
    draws: list[list[Trial]]

    def fail(self, error: SplinecliError) -> None:
        for task in self.tasks:
            task.fail(self.reading.name, error)

    def note(self, notes: Notes) -> None:
        for task, of_protocol in zip(self.tasks, notes, strict=True):
            task.notes[self.reading.name] = of_protocol


def plan_capture(
    folder: Path,
    name: str,
    estimators: Sequence[Estimator],
    tasks: Sequence[ProtocolTrials],
    store: TrialStore,
) -> CaptureJob | None:
    """Return a job with the trials of a capture that are not in the store, and add all its trials
    to the tasks.

    If no protocol can score the capture, return None and record the reasons in the tasks.
    """
    try:
        source = open_to_score(folder, tasks[0].protocol)
    except (InputError, UsageError) as error:
        for task in tasks:
            task.fail(name, error)
        return None
    made_of = [
        digest([__version__, estimator.fingerprint, *source.stamp]) for estimator in estimators
    ]
    able: list[ProtocolTrials] = []
    # The methods of a draw are grouped, because they share its capture, and so that the remaining
    # time can be estimated.
    draws: list[list[Trial]] = []
    for task in tasks:
        try:
            lights = draws_for(source, name, task.protocol, task.draws_file)
        except (InputError, UsageError) as error:
            task.fail(name, error)
            continue
        able.append(task)
        for number, draw in enumerate(lights):
            draws.append([])
            for estimator, made in zip(estimators, made_of, strict=True):
                trial = Trial(name, estimator.name, number, draw, task.protocol, made)
                task.trials.setdefault((name, estimator.name), []).append(trial)
                draws[-1].append(trial)
    if not able:
        return None
    missing = [
        left for draw in draws if (left := [trial for trial in draw if store.find(trial) is None])
    ]
    needed = missing or draws[:1]  # the notes need the capture's mask and its ground truth
    protocols = tuple(task.protocol for task in able)
    methods = {trial.method for draw in needed for trial in draw}
    whole = any(
        protocol.light_error_deg is not None or protocol.finds_lights for protocol in protocols
    )
    whole = whole or any(
        estimator.needs_capture for estimator in estimators if estimator.name in methods
    )
    used = tuple(sorted({light for draw in needed for light in draw[0].lights}))
    return CaptureJob(source, CaptureReading(folder, name, protocols, used, whole), able, missing)


def read_draws_file(protocol: Protocol) -> tuple[Protocol, DrawsFile | None]:
    """Return the protocol, with n_lights and trials from its draws file, and the draws.

    Raises InputError.
    """
    if protocol.draws_file is None:
        return protocol, None
    draws_file = read_draws(protocol.draws_file)
    return replace(protocol, n_lights=draws_file.n_lights, trials=len(draws_file.draws)), draws_file


def draws_for(
    source: CaptureSource, name: str, protocol: Protocol, draws_file: DrawsFile | None
) -> list[Draw]:
    """Return the draws of a capture, one for each trial.

    Raises InputError or UsageError if the protocol does not fit the capture.
    """
    if source.files.ground_truth is None:  # known before the images are read
        hint = "Add a normal map to the folder, such as normal_gt.png or Normal_gt.mat"
        raise InputError("the capture has no ground truth", path=source.files.folder, hint=hint)
    near = source.lamps is not None and source.lamps.used
    if protocol.light_error_deg is not None:
        check_distant("--refine-lights", "refines", near=near)
    if protocol.finds_lights:
        check_distant("--lights estimate", "finds", near=near)
    skipped = protocol.skipped_lights(name)
    left = source.n_lights - skipped
    fewest = max(MIN_LIGHTS, protocol.n_lights or 0)
    if skipped and left < fewest:
        found = (
            f"{name}: {max(left, 0)} of {source.n_lights} images remain after the first {skipped}"
        )
        raise UsageError(f"{found}, expected at least {fewest}")
    if draws_file is not None:
        draws_file.check_against(source.light_directions, skipped=skipped)
        return list(draws_file.draws)
    directions, trials = source.light_directions[skipped:], protocol.trials
    draws = draw_lights(directions, protocol.n_lights, trials=trials, seed=protocol.seed)
    draws = [tuple(light + skipped for light in draw) for draw in draws]
    # All lights form one draw, but their noise differs from trial to trial.
    return draws * trials if len(draws) == 1 and protocol.light_noise_deg > 0 else draws


def read_first_draw(
    folder: Path,
    name: str,
    protocol: Protocol,
    progress: Callable[[float], object] = lambda share: None,
) -> tuple[Work, Capture]:
    """Return a capture under all lights that are not skipped, and under the protocol's first draw.

    `progress` is called with the fraction of the images just read. Raises InputError or UsageError
    if the capture cannot be read or scored.
    """
    source = open_capture(folder, CaptureOptions(white_level=protocol.white_level))
    protocol, draws_file = read_draws_file(protocol)
    trial = Trial(name, "", 0, draws_for(source, name, protocol, draws_file)[0], protocol, "")
    lights = range(protocol.skipped_lights(name), source.n_lights)
    stored = follow(
        begin(source, lights, RecipeOptions(as_stored=protocol.as_stored)),
        until="lights",
        advance=lambda *_: progress(1 / len(lights)),
    )
    return stored, TrialSource(stored).see(trial)


def distinct_names(captures: Sequence[Path]) -> dict[Path, str]:
    """Return the folders, without duplicates, with the names of the captures.

    If two names are equal, or one is used for the average in the tables, all names are extended to
    the last parts of their paths.
    """
    folders = list({folder.resolve(): folder for folder in captures}.values())
    names = [capture_name(folder) for folder in folders]
    if len({*names, AVERAGE}) <= len(names):
        # Like capture_name, this keeps the name of a link.
        parts = [(f.resolve() if ".." in f.parts else f.absolute()).parts for f in folders]
        depth = 1 + (AVERAGE in names)
        while len({path[-depth:] for path in parts}) < len(parts):
            depth += 1
        names = ["/".join(path[-depth:]) for path in parts]
    return dict(zip(folders, names, strict=True))


class DrawTask(NamedTuple):
    """One draw of a capture: its trials, and the data for all draws of the capture.

    Without trials, only notes are returned.
    """

    reading: CaptureReading
    trials: Sequence[Trial]


# The scores of the trials of a draw and the notes on its capture, or the reason why the capture
# cannot be scored
Scored = tuple[Sequence[Score], Notes] | SplinecliError
# Scores draws in other processes, and yields each draw with its scores as it finishes
Elsewhere = Callable[[Sequence[DrawTask]], Iterator[tuple[DrawTask, Scored]]]
# Called with the fraction of all trials just completed, weighted by their pixels, and a short text
OnProgress = Callable[[float, str], object]


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
    """Score every estimator on every capture under every protocol, and return the evaluations.

    There must be at least one of each, with unique names. A capture that cannot be read, or has no
    ground truth or too few lights, is skipped, and the evaluation contains the reason. For the
    names of captures, see distinct_names.

    Args:
        store: where finished trials are stored; trials in the store are not computed again.
        jobs: number of trials to run in parallel, each on its share of the cores.
        elsewhere: scores the draws in other processes, instead of using `jobs`.
        on_progress: see OnProgress. It is called by one thread at a time.

    Raises:
        UsageError: skip_first names a capture that does not exist.
        InputError: the draws file is invalid, or no capture could be scored; for a single capture,
            its own error is raised.
        SplinecliError: a method returned normals that are not unit vectors.
        OutputError: the store cannot be written.
    """
    tasks = [ProtocolTrials(*read_draws_file(protocol)) for protocol in protocols]
    names_by_folder = distinct_names(captures)
    names = list(names_by_folder.values())
    for protocol in protocols:
        for name in set(protocol.skip_first) - {EVERY_CAPTURE, *names}:
            raise UsageError(
                f"--skip-first names the capture {name!r}, expected one of {', '.join(names)}"
            )
    store = TrialStore() if store is None else store
    planned = [
        plan_capture(folder, name, estimators, tasks, store)
        for folder, name in names_by_folder.items()
    ]
    captures_to_score = [job for job in planned if job is not None]
    progress = _Progress(
        sum(len(draw) for job in captures_to_score for draw in job.draws), on_progress
    )
    if elsewhere is None:
        with _share_cores(jobs), ThreadPoolExecutor(jobs) as workers:
            try:
                _score_here(
                    captures_to_score,
                    {e.name: e for e in estimators},
                    store,
                    progress,
                    workers,
                    jobs,
                )
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
    """Score `jobs` trials at a time in threads. Errors of trials are raised."""

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
                running = _wait(running, jobs)  # one further trial waits, so that no core is idle
            del shared
        del source  # before the next capture is read
    _wait(running, 0)


def _score_elsewhere(
    captures: Sequence[CaptureJob], elsewhere: Elsewhere, store: TrialStore, progress: _Progress
) -> None:
    """Score the trials in other processes. Errors of trials are raised."""
    jobs = {job.reading.name: job for job in captures}
    for task, scored in elsewhere(
        [DrawTask(job.reading, draw) for job in captures for draw in job.draws or [[]]]
    ):
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
    """Counts trials across all threads."""

    def __init__(self, total: int, advance: OnProgress) -> None:
        self._total, self._advance, self._lock, self._finished = total, advance, Lock(), 0

    def read_image(self, capture: str, n_read: int, n_images: int) -> None:
        with self._lock:
            self._advance(0, f"reading {capture}, image {n_read} of {n_images}")

    def skip(self, count: int) -> None:
        with self._lock:
            self._finished += count
            self._advance(count / max(1, self._total), "")

    def begin(self, n_pixels: int) -> Callable[[int], None]:
        """Start a trial and return the function that counts its pixels."""
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
    """Wait until at most this many trials are running, and return them. Errors of trials are
    raised.
    """
    while len(running) > at_most:
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
    return running


@contextmanager
def _share_cores(jobs: int) -> Iterator[None]:
    """Limit PyTorch to a share of the cores for each of `jobs` parallel trials, without importing
    it.
    """
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
