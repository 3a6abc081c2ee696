"""Methods scored side by side: the same captures, pixels, draws of lights and light noise for each."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splinecli.capture import Capture, CaptureSource, capture_name, open_capture
from splinecli.capture.lights.draws import (
    NOISE_STREAM,
    Draw,
    DrawsFile,
    draw_lights,
    in_one_plane,
    read_draws,
)
from splinecli.capture.record import MIN_LIGHTS
from splinecli.capture.stamp import stamp_capture
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.light_noise import tilt_lights
from splinecli.evaluation.quirks import describe_quirks
from splinecli.evaluation.records import Evaluation, Protocol, Result, Skipped
from splinecli.evaluation.scored_pixels import keep_scored_pixels
from splinecli.evaluation.statistics import AVERAGE
from splinecli.evaluation.trials import Score, Trial, TrialStore, plan_trials
from splinecli.inference import estimate_normals
from splinecli.methods import Estimator

__all__ = ["Evaluation", "Protocol", "Result", "Skipped", "TrialStore", "evaluate", "evaluate_all"]

_RETILTS = 100

OnProgress = Callable[[int, int], object]
"""Told the trials that are done and those there are, after each."""


def evaluate(captures: Sequence[Path], estimators: Sequence[Estimator], protocol: Protocol) -> Evaluation:
    """evaluate_all for one protocol."""
    return evaluate_all(captures, estimators, [protocol])[0]


def evaluate_all(
    captures: Sequence[Path],
    estimators: Sequence[Estimator],
    protocols: Sequence[Protocol],
    *,
    store: TrialStore | None = None,
    jobs: int = 1,
    on_progress: OnProgress | None = None,
) -> list[Evaluation]:
    """Score every estimator on every capture under every protocol.

    Captures are called by their names (capture_name), or where two are equal by their folders' paths, with so
    many parent folders as tell them apart; one given twice counts once. One that cannot be read, or has no
    ground truth or too few lights, is skipped with its reason.

    Args:
        captures: folders.
        estimators: methods with different names.
        protocols: at least one.
        store: where finished trials are found and kept.
        jobs: trials at a time, each on its share of the cores.

    Raises:
        UsageError: there are no captures or estimators, two estimators share a name, n_lights is not what
            the draws file holds, or skip_first names a capture that is not there.
        InputError: the draws file is wrong, or no capture could be scored. A single capture's own error is
            raised as it is, be it a UsageError.
        SplinecliError: a method gave normals that are not unit vectors.
        OutputError: the store cannot be written.
    """
    if not captures or not estimators:
        raise UsageError("nothing to score, expected at least one capture and one method")
    for method, count in Counter(estimator.name for estimator in estimators).items():
        if count > 1:
            raise UsageError(f"method {method} comes twice", hint="Name each method once")
    tasks = [_Task(*_read_draws_file(protocol)) for protocol in protocols]
    names_by_folder = distinct_names(captures)
    names = list(names_by_folder.values())
    for protocol in protocols:
        for name in set(protocol.skip_first) - {"*", *names}:
            raise UsageError(f"no capture named {name!r} to skip images of; there are {', '.join(names)}")
    store = TrialStore() if store is None else store
    jobs_by_capture = [
        _CaptureJob.plan(folder, name, estimators, tasks) for folder, name in names_by_folder.items()
    ]
    _run([job for job in jobs_by_capture if job is not None], store, jobs, on_progress)
    settings = {
        e.name: {
            "weights": e.weights,
            "device": e.device,
            "precision": e.precision,
            "fingerprint": e.fingerprint,
        }
        for e in estimators
    }
    return [replace(task.evaluation(names, store), settings=settings) for task in tasks]


@dataclass
class _Task:
    """A protocol and what becomes of it: the trials of each capture and method, and the captures that failed."""

    protocol: Protocol
    draws_file: DrawsFile | None
    trials: dict[tuple[str, str], list[Trial]] = field(default_factory=dict)
    failures: dict[str, SplinecliError] = field(default_factory=dict)
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def fail(self, capture: str, error: SplinecliError) -> None:
        self.failures[capture] = error
        self.trials = {key: trials for key, trials in self.trials.items() if key[0] != capture}

    def evaluation(self, captures: Sequence[str], store: TrialStore) -> Evaluation:
        """In the captures' order. Raises the failures' error where all of them failed."""
        results = []
        for (capture, method), trials in self.trials.items():
            scores = [score for trial in trials if (score := store.find(trial)) is not None]
            seconds = math.fsum(score.seconds for score in scores) / len(scores)
            maes_deg = tuple(score.mae_deg for score in scores)
            results.append(Result(method, capture, len(trials[0].lights), maes_deg, seconds))
        if not results:
            raise _nothing_scored([self.failures[name] for name in captures])
        skipped = (Skipped(name, str(self.failures[name])) for name in captures if name in self.failures)
        notes = [note for name in captures for note in self.notes.get(name, ())]
        return Evaluation(self.protocol, tuple(results), tuple(skipped), tuple(notes))


@dataclass
class _CaptureJob:
    """One capture and the trials wanted of it, under all protocols."""

    name: str
    source: CaptureSource
    tasks: list[_Task]
    units: list[tuple[Trial, Estimator]]

    @classmethod
    def plan(
        cls, folder: Path, name: str, estimators: Sequence[Estimator], tasks: Sequence[_Task]
    ) -> _CaptureJob | None:
        """None where no protocol can score the capture; its reasons are with the tasks."""
        try:
            source = open_capture(folder)
            stamp = stamp_capture(source)
        except (InputError, UsageError) as error:
            for task in tasks:
                task.fail(name, error)
            return None
        job = cls(name, source, [], [])
        for task in tasks:
            try:
                draws = _draws_for(source, name, task.protocol, task.draws_file)
            except (InputError, UsageError) as error:
                task.fail(name, error)
                continue
            job.tasks.append(task)
            by_method = [plan_trials(name, stamp, e, draws, task.protocol) for e in estimators]
            for estimator, trials in zip(estimators, by_method, strict=True):
                task.trials[name, estimator.name] = trials
            # Trial by trial, not method by method: the time left can then be told from the time gone.
            job.units += [
                (trial, estimator)
                for same_draw in zip(*by_method, strict=True)
                for trial, estimator in zip(same_draw, estimators, strict=True)
            ]
        return job if job.tasks else None

    def read(self, units: Sequence[tuple[Trial, Estimator]]) -> Capture:
        """The capture under the lights of these trials, without the pixels that are not scored."""
        lights = sorted(set().union(*(trial.lights for trial, _ in units)))
        capture = self.source.read(lights, as_stored=True)
        for task in self.tasks:
            task.notes[self.name] = describe_quirks(capture, self.name, task.protocol)
        # All protocols of an evaluation score the same pixels.
        protocol = self.tasks[0].protocol
        return keep_scored_pixels(capture, max_pixels=protocol.max_pixels, seed=protocol.seed)


def _run(
    jobs_by_capture: Sequence[_CaptureJob], store: TrialStore, jobs: int, on_progress: OnProgress | None
) -> None:
    """Score the trials that the store does not have."""
    missing = [[unit for unit in job.units if store.find(unit[0]) is None] for job in jobs_by_capture]
    total, done = sum(map(len, missing)), 0

    def finish(running: set[Future[None]], at_most: int) -> set[Future[None]]:
        """Wait until no more than so many run; what they raised comes to light here."""
        nonlocal done
        while len(running) > at_most:
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                future.result()
            done += len(finished)
            if on_progress is not None:
                on_progress(done, total)
        return running

    with _share_cores(jobs), ThreadPoolExecutor(jobs) as workers:
        running: set[Future[None]] = set()
        try:
            for job, units in zip(jobs_by_capture, missing, strict=True):
                try:
                    # Also where nothing is missing: what is particular about a capture shows when it is read.
                    capture = job.read(units or job.units[:1])
                except (InputError, UsageError) as error:
                    for task in job.tasks:
                        task.fail(job.name, error)
                    done += len(units)
                    continue
                for trial, estimator in units:
                    running.add(workers.submit(_score, capture, trial, estimator, store))
                    running = finish(running, jobs)  # one waits, so that no core does
                del capture
            finish(running, 0)
        except BaseException:
            workers.shutdown(cancel_futures=True)
            raise


@contextmanager
def _share_cores(jobs: int) -> Iterator[None]:
    """Let PyTorch, where a method has loaded it, compute each of `jobs` trials at a time on a share of the cores."""
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


def _score(capture: Capture, trial: Trial, estimator: Estimator, store: TrialStore) -> None:
    estimate = estimate_normals(see_trial(capture, trial), estimator)
    assert estimate.errors is not None  # keep_scored_pixels made sure of the ground truth
    store.add(trial, Score(estimate.errors.mean, estimate.seconds))


def see_trial(capture: Capture, trial: Trial) -> Capture:
    """The capture under the trial's lights, their directions as its noise leaves them."""
    position = {light: place for place, light in enumerate(capture.light_indices)}
    seen = capture.choose_lights([position[light] for light in trial.lights])
    if trial.light_noise_deg == 0:
        return seen
    generator = np.random.default_rng([NOISE_STREAM, trial.seed, trial.number])
    tilted = seen.light_directions
    # Lights that the noise has laid into one plane, which takes few of them and much noise, are tilted again.
    for _ in range(_RETILTS):
        tilted = tilt_lights(seen.light_directions, trial.light_noise_deg, generator)
        if not in_one_plane(tilted):
            break
    return replace(seen, light_directions=tilted)


def first_trial(source: CaptureSource, name: str, protocol: Protocol) -> Trial:
    """The first trial of a capture, whatever the method. Raises as evaluate_all does."""
    protocol, draws_file = _read_draws_file(protocol)
    draw = _draws_for(source, name, protocol, draws_file)[0]
    return Trial(name, "", 0, draw, protocol.light_noise_deg, protocol.seed, protocol.max_pixels, "")


def _read_draws_file(protocol: Protocol) -> tuple[Protocol, DrawsFile | None]:
    if protocol.draws_file is None:
        return protocol, None
    draws_file = read_draws(protocol.draws_file)
    if protocol.n_lights not in (None, draws_file.n_lights):
        raise UsageError(
            f"{protocol.n_lights} lights a draw wanted,"
            f" the draws in {draws_file.path} have {draws_file.n_lights}"
        )
    return replace(protocol, n_lights=draws_file.n_lights, trials=len(draws_file.draws)), draws_file


def _draws_for(
    source: CaptureSource, name: str, protocol: Protocol, draws_file: DrawsFile | None
) -> list[Draw]:
    if source.files.ground_truth is None:  # known before the images are read
        raise InputError(
            "no ground truth, so nothing to score against",
            path=source.files.folder,
            hint="Put a normal map into the folder, such as normal_gt.png or Normal_gt.mat",
        )
    skipped = protocol.skipped_lights(name)
    left = source.n_lights - skipped
    if skipped and left < max(MIN_LIGHTS, protocol.n_lights or 0):
        raise UsageError(
            f"{name}: {max(left, 0)} of {source.n_lights} images stay when the first {skipped} are left out,"
            f" expected at least {max(MIN_LIGHTS, protocol.n_lights or 0)}"
        )
    if draws_file is not None:
        draws_file.check_against(source.light_directions, skipped=skipped)
        return list(draws_file.draws)
    draws = draw_lights(
        source.light_directions[skipped:], protocol.n_lights, trials=protocol.trials, seed=protocol.seed
    )
    draws = [tuple(light + skipped for light in draw) for draw in draws]
    # All lights are one draw, but their noise differs from trial to trial.
    return draws * protocol.trials if len(draws) == 1 and protocol.light_noise_deg > 0 else draws


def distinct_names(captures: Sequence[Path]) -> dict[Path, str]:
    """Folders, each once, with the captures' names, or where two are equal with the last parts of all paths.

    None is called like the tables' average.
    """
    folders = list({folder.resolve(): folder for folder in captures}.values())
    names = [capture_name(folder) for folder in folders]
    if len({*names, AVERAGE}) <= len(names):
        # As capture_name has it: a link keeps its name.
        parts = [(f.resolve() if ".." in f.parts else f.absolute()).parts for f in folders]
        depth = 1 + (AVERAGE in names)
        while len({path[-depth:] for path in parts}) < len(parts):
            depth += 1
        names = ["/".join(path[-depth:]) for path in parts]
    return dict(zip(folders, names, strict=True))


def _nothing_scored(failures: list[SplinecliError]) -> SplinecliError:
    if len(failures) == 1:
        return failures[0]
    kind = UsageError if all(isinstance(failure, UsageError) for failure in failures) else InputError
    first = str(failures[0]).removesuffix(".")
    return kind(f"none of the {len(failures)} captures could be scored; the first: {first}")
