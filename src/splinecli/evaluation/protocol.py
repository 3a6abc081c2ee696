"""Methods scored side by side: the same captures, pixels, draws of lights and light noise for each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from splinecli.capture import Capture, CaptureSource, capture_name, open_capture
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.evaluation.draws import NOISE_STREAM, Draw, DrawsFile, draw_lights, read_draws
from splinecli.evaluation.light_noise import tilt_lights
from splinecli.evaluation.records import Evaluation, OnProgress, Progress, Protocol, Result, Skipped
from splinecli.evaluation.scored_pixels import keep_scored_pixels
from splinecli.inference import NormalEstimate, estimate_normals
from splinecli.methods import Estimator

__all__ = ["Evaluation", "Progress", "Protocol", "Result", "Skipped", "evaluate"]


def evaluate(
    captures: Sequence[Path],
    estimators: Sequence[Estimator],
    protocol: Protocol,
    *,
    on_progress: OnProgress | None = None,
) -> Evaluation:
    """Score every estimator on every capture.

    Captures are called by their names (capture_name), or where two are equal by their folders' paths, with so
    many parent folders as tell them apart; one given twice counts once. One that cannot be read, or has no
    ground truth or too few lights, is skipped with its reason.

    Args:
        captures: folders.
        estimators: methods with different names.

    Raises:
        UsageError: there are no captures or estimators, two estimators share a name, or n_lights is not what
            the draws file holds.
        InputError: the draws file is wrong, or no capture could be scored. A single capture's own error is
            raised as it is, be it a UsageError.
        SplinecliError: a method gave normals that are not unit vectors.
    """
    if not captures or not estimators:
        raise UsageError("nothing to score, expected at least one capture and one method")
    for method, count in Counter(estimator.name for estimator in estimators).items():
        if count > 1:
            raise UsageError(f"method {method} comes twice", hint="Name each method once")
    protocol, draws_file = _read_draws_file(protocol)
    folders = list({folder.resolve(): folder for folder in captures}.values())
    results: list[Result] = []
    failures: dict[str, SplinecliError] = {}
    for number, (folder, name) in enumerate(zip(folders, _distinct_names(folders), strict=True), start=1):
        report = partial(_report, on_progress, name, number, len(folders))
        try:
            results += _score_capture(folder, name, estimators, protocol, draws_file, report)
        except (InputError, UsageError) as error:
            failures[name] = error
    if not results:
        raise _nothing_scored(list(failures.values()))
    return Evaluation(
        protocol, tuple(results), tuple(Skipped(name, str(error)) for name, error in failures.items())
    )


_Report = Callable[[str | None, int, int], None]


def _report(
    on_progress: OnProgress | None,
    capture: str,
    number: int,
    n_captures: int,
    method: str | None,
    done: int,
    total: int,
) -> None:
    if on_progress is not None:
        on_progress(Progress(capture, number, n_captures, method, done, total))


def _score_capture(
    folder: Path,
    name: str,
    estimators: Sequence[Estimator],
    protocol: Protocol,
    draws_file: DrawsFile | None,
    report: _Report,
) -> list[Result]:
    source = open_capture(folder)
    draws = _draws_for(source, protocol, draws_file)
    capture = _read_lights(source, sorted(set().union(*draws)), report)
    capture = keep_scored_pixels(capture, max_pixels=protocol.max_pixels, seed=protocol.seed)
    return [_score_method(capture, name, estimator, draws, protocol, report) for estimator in estimators]


def _score_method(
    capture: Capture,
    name: str,
    estimator: Estimator,
    draws: Sequence[Draw],
    protocol: Protocol,
    report: _Report,
) -> Result:
    method = estimator.name
    maes_deg, seconds = [], []
    for trial, draw in enumerate(draws):
        estimate = estimate_normals(_see_trial(capture, draw, trial, protocol), estimator)
        maes_deg.append(_mae_deg(estimate))
        seconds.append(estimate.seconds)
        report(method, trial + 1, len(draws))
    return Result(method, name, len(draws[0]), tuple(maes_deg), math.fsum(seconds) / len(seconds))


def _see_trial(capture: Capture, draw: Draw, trial: int, protocol: Protocol) -> Capture:
    """The capture under the draw's lights, their directions as the trial's noise leaves them."""
    position = {light: place for place, light in enumerate(capture.light_indices)}
    seen = capture.choose_lights([position[light] for light in draw])
    if protocol.light_noise_deg == 0:
        return seen
    generator = np.random.default_rng([NOISE_STREAM, protocol.seed, trial])
    return replace(
        seen, light_directions=tilt_lights(seen.light_directions, protocol.light_noise_deg, generator)
    )


def _mae_deg(estimate: NormalEstimate) -> float:
    mask = estimate.capture.mask
    assert estimate.error_map_deg is not None  # keep_scored_pixels made sure of the ground truth
    return float(estimate.error_map_deg[mask].mean(dtype=np.float64))


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


def _draws_for(source: CaptureSource, protocol: Protocol, draws_file: DrawsFile | None) -> Sequence[Draw]:
    if source.files.ground_truth is None:  # known before the images are read
        raise InputError(
            "no ground truth, so nothing to score against",
            path=source.files.folder,
            hint="Put a normal map into the folder, such as normal_gt.png or Normal_gt.mat",
        )
    if draws_file is not None:
        draws_file.check_against(source.light_directions)
        return draws_file.draws
    draws = draw_lights(
        source.light_directions, protocol.n_lights, trials=protocol.trials, seed=protocol.seed
    )
    # All lights are one draw, but their noise differs from trial to trial.
    return draws * protocol.trials if len(draws) == 1 and protocol.light_noise_deg > 0 else draws


def _read_lights(source: CaptureSource, lights: Sequence[int], report: _Report) -> Capture:
    done = 0

    def progress() -> None:
        nonlocal done
        done += 1
        report(None, done, len(lights))

    return source.read(lights, progress)


def _distinct_names(folders: Sequence[Path]) -> list[str]:
    """The captures' names, or the last parts of the folders' paths, as many for all as tell them apart."""
    names = [capture_name(folder) for folder in folders]
    if len(set(names)) == len(names):
        return names
    # As capture_name has it: a link keeps its name.
    parts = [(f.resolve() if ".." in f.parts else f.absolute()).parts for f in folders]
    depth = 1
    while len({path[-depth:] for path in parts}) < len(parts):
        depth += 1
    return ["/".join(path[-depth:]) for path in parts]


def _nothing_scored(failures: list[SplinecliError]) -> SplinecliError:
    if len(failures) == 1:
        return failures[0]
    kind = UsageError if all(isinstance(failure, UsageError) for failure in failures) else InputError
    first = str(failures[0]).removesuffix(".")
    return kind(f"none of the {len(failures)} captures could be scored; the first: {first}")
