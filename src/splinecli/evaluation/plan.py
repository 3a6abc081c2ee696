"""The trials of an evaluation, planned before any image is read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.capture import CaptureSource, capture_name
from splinecli.capture.files import digest
from splinecli.capture.lights.draws import Draw, DrawsFile, draw_lights, read_draws
from splinecli.capture.record import MIN_LIGHTS
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.protocol import Evaluation, Protocol, Result, Skipped
from splinecli.evaluation.statistics import AVERAGE
from splinecli.evaluation.trial_capture import CaptureReading, Notes, open_to_score
from splinecli.evaluation.trials import Trial, TrialStore
from splinecli.lights.light_fit import check_distant
from splinecli.methods import Estimator
from splinecli.methods.estimator import refiner_of


@dataclass
class ProtocolTrials:
    """A protocol with the trials of each capture and method, and the captures that failed."""

    protocol: Protocol
    draws_file: DrawsFile | None
    trials: dict[tuple[str, str], list[Trial]] = field(default_factory=dict)
    failures: dict[str, SplinecliError] = field(default_factory=dict)
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def fail(self, capture: str, error: SplinecliError) -> None:
        """Record why a capture cannot be scored, and drop its trials."""
        self.failures.setdefault(capture, error)
        self.trials = {key: trials for key, trials in self.trials.items() if key[0] != capture}

    def evaluation(
        self, captures: Sequence[str], store: TrialStore, settings: Mapping[str, Mapping[str, Any]]
    ) -> Evaluation:
        """Return the outcome, in the order of the captures. Raises an error where all captures failed."""
        results, n_estimated = [], {}
        for (capture, method), trials in self.trials.items():
            scores = [score for trial in trials if (score := store.find(trial)) is not None]
            seconds = math.fsum(score.seconds for score in scores) / len(scores)
            maes_deg = tuple(score.mae_deg for score in scores)
            found = [s.found_light_error_deg for s in scores if s.found_light_error_deg is not None]
            light_error_deg = math.fsum(found) / len(found) if found else None
            results.append(Result(method, capture, len(trials[0].lights), maes_deg, seconds, light_error_deg))
            n_estimated[capture] = (sum(score.estimated_intensities for score in scores), len(scores))
        if not results:
            raise _nothing_scored([self.failures[name] for name in captures])
        skipped = (Skipped(name, str(self.failures[name])) for name in captures if name in self.failures)
        notes = [note for name in captures for note in self.notes.get(name, ())]
        notes += [
            f"{name}: no file gives the light intensities; they were estimated in {count} of {of} trials."
            for name, (count, of) in n_estimated.items()
            if count
        ]
        notes += [
            f"{name}: the estimated light directions are wrong by {error_deg:.2f} degrees on average."
            for name, error_deg in {r.capture: r.found_light_error_deg for r in results}.items()
            if error_deg is not None
        ]
        return Evaluation(self.protocol, tuple(results), tuple(skipped), tuple(notes), settings)


@dataclass
class CaptureJob:
    """A capture, opened, with the protocols that can score it, and the missing trials of each draw."""

    source: CaptureSource
    reading: CaptureReading
    tasks: list[ProtocolTrials]
    draws: list[list[Trial]]

    def fail(self, error: SplinecliError) -> None:
        """Record why the capture cannot be scored."""
        for task in self.tasks:
            task.fail(self.reading.name, error)

    def note(self, notes: Notes) -> None:
        """Record the notes on the capture."""
        for task, of_protocol in zip(self.tasks, notes, strict=True):
            task.notes[self.reading.name] = of_protocol


def plan_capture(
    folder: Path, name: str, estimators: Sequence[Estimator], tasks: Sequence[ProtocolTrials], store: TrialStore
) -> CaptureJob | None:
    """Add the trials of a capture to the tasks, and return those that the store does not have as a job.

    Where no protocol can score the capture, this is None; the tasks then have the reasons.
    """
    try:
        source = open_to_score(folder, tasks[0].protocol)
    except (InputError, UsageError) as error:
        for task in tasks:
            task.fail(name, error)
        return None
    made_of = [digest([__version__, estimator.fingerprint, *source.stamp]) for estimator in estimators]
    able: list[ProtocolTrials] = []
    # All methods of a draw come together: they share its capture, and the remaining time can be estimated.
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
    missing = [left for draw in draws if (left := [trial for trial in draw if store.find(trial) is None])]
    needed = missing or draws[:1]  # the notes on the capture need its mask and its ground truth
    protocols = tuple(task.protocol for task in able)
    methods = {trial.method for draw in needed for trial in draw}
    whole = any(protocol.light_error_deg is not None or protocol.finds_lights for protocol in protocols)
    whole = whole or any(refiner_of(estimator) is not None for estimator in estimators if estimator.name in methods)
    seen = sorted({light for draw in needed for light in draw[0].lights})
    return CaptureJob(source, CaptureReading(folder, name, protocols, tuple(seen), whole), able, missing)


def read_draws_file(protocol: Protocol) -> tuple[Protocol, DrawsFile | None]:
    """Return the protocol with the numbers of lights and trials of its draws file, and its draws. Raises InputError."""
    if protocol.draws_file is None:
        return protocol, None
    draws_file = read_draws(protocol.draws_file)
    return replace(protocol, n_lights=draws_file.n_lights, trials=len(draws_file.draws)), draws_file


def draws_for(source: CaptureSource, name: str, protocol: Protocol, draws_file: DrawsFile | None) -> list[Draw]:
    """Return the draws of a capture, one for each trial.

    Raises InputError if the capture has no ground truth, or a draw of the file does not fit it, or UsageError if it has
    too few lights, or near lamps that are to be refined.
    """
    if source.files.ground_truth is None:  # known before the images are read
        raise InputError(
            "the capture has no ground truth",
            path=source.files.folder,
            hint="Put a normal map into the folder, such as normal_gt.png or Normal_gt.mat",
        )
    near = source.lamps is not None and source.lamps.used
    if protocol.light_error_deg is not None:
        check_distant("--refine-lights", "refines", near=near)
    if protocol.finds_lights:
        check_distant("--lights estimate", "finds", near=near)
    skipped = protocol.skipped_lights(name)
    left = source.n_lights - skipped
    fewest = max(MIN_LIGHTS, protocol.n_lights or 0)
    if skipped and left < fewest:
        raise UsageError(
            f"{name}: {max(left, 0)} of {source.n_lights} images remain without the first {skipped}, expected at least"
            f" {fewest}"
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
    """Return the folders, each once, with the names of the captures.

    Where two names are equal, all captures are named by the last parts of their paths. No capture gets the name of
    the tables' average.
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


def _nothing_scored(failures: list[SplinecliError]) -> SplinecliError:
    if len(failures) == 1:
        return failures[0]
    kind = UsageError if all(isinstance(failure, UsageError) for failure in failures) else InputError
    first = str(failures[0]).removesuffix(".")
    return kind(f"none of the {len(failures)} captures could be scored; the first: {first}")
