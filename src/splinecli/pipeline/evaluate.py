"""Score methods on captures, and write tables, plots and a report."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, lru_cache, partial
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from splinecli.capture import find_captures, open_capture
from splinecli.errors import InputError, ModelError, UsageError
from splinecli.estimate.methods import Estimator, MethodOptions, make_estimator
from splinecli.evaluation.document import TRIALS, write_results
from splinecli.evaluation.figures import (
    CaptureFigure,
    capture_figures,
    file_stems,
    relight_first_draw,
)
from splinecli.evaluation.protocol import Evaluation, Protocol
from splinecli.evaluation.run import DrawTask, Elsewhere, Scored, distinct_names, evaluate_all
from splinecli.evaluation.trials import (
    CaptureReading,
    Notes,
    SharedDraw,
    TrialSource,
    TrialStore,
    open_to_score,
)
from splinecli.pipeline.distribution import LostError, WorkItem, distributor
from splinecli.pipeline.infer import source_bytes
from splinecli.pipeline.infer_options import ClusterOptions
from splinecli.pipeline.options import EvaluateOptions
from splinecli.records.documents import RelightingReport
from splinecli.system.files import check_writable
from splinecli.system.machine import count_available_cores
from splinecli.system.progress import SILENT, Advance, Observer
from splinecli.system.publishing import held_folder

Found = TypeVar("Found")


class EvaluateOutcome(NamedTuple):
    """The evaluations by protocol, results.json, warnings, and failed figures or relightings."""

    evaluations: list[Evaluation]
    document: dict[str, Any]
    warnings: list[str]
    figure_problems: list[str]


def evaluate_captures(options: EvaluateOptions, observer: Observer = SILENT) -> EvaluateOutcome:
    """Score the methods on the captures, write the results to the output folder and return them.

    All options are checked before the first image is read. Raises UsageError, ModelError,
    OutputError, or InputError if no capture could be scored, or if a folder or the draws file is
    invalid.
    """
    captures = [capture for dataset in options.datasets for capture in find_captures(dataset)]
    output, protocols = Path(options.output), options.protocols
    check_writable(output)
    _check_counts(captures, protocols)
    estimators = [make_estimator(name, options.method_options) for name in options.names]
    if options.weights is not None and not any(each.weights for each in estimators):
        names = ", ".join(options.names)
        raise UsageError(f"--weights does not apply to {names}", hint="Leave --weights out")
    on_gpu = any(estimator.device.startswith("cuda") for estimator in estimators)
    elsewhere: Elsewhere | None = None
    if cluster := options.cluster.on_cores():
        elsewhere = partial(
            _score_on_workers, estimators, options.method_options, cluster, output, observer
        )
    with held_folder(output, observer.warn):
        with observer.progress("evaluating", 1.0) as advance:
            evaluations = evaluate_all(
                captures,
                estimators,
                protocols,
                store=TrialStore(output / TRIALS, fresh=options.overwrite),
                jobs=options.jobs or (1 if on_gpu else count_available_cores()),
                elsewhere=elsewhere,
                on_progress=advance,
            )
        protocol, scored = evaluations[0].protocol, evaluations[0].captures
        folders = {name: path for path, name in distinct_names(captures).items() if name in scored}
        figures: list[CaptureFigure] | None = None
        relit: list[RelightingReport] | None = None
        problems: list[str] = []
        if options.figures:
            stems = file_stems(list(folders))
            draws = [
                partial(capture_figures, folder, name, stem, estimators, protocol, options.pixels)
                for (name, folder), stem in zip(folders.items(), stems, strict=True)
            ]
            drawn, problems = _try_each("drawing", draws, observer)
            figures = list(chain.from_iterable(drawn))
        if options.relight:
            tasks = [
                partial(relight_first_draw, folder, name, estimator, protocol)
                for name, folder in folders.items()
                for estimator in estimators
            ]
            relit, failed = _try_each("relighting", tasks, observer)
            problems += failed
        document = write_results(output, evaluations, figures, relit)
    counts = sorted({result.n_lights for each in evaluations for result in each.results})
    pairs = product(estimators, counts)
    untrained = [text for estimator, k in pairs for text in estimator.warn_of_lights(k)]
    return EvaluateOutcome(evaluations, document, untrained, problems)


def _check_counts(captures: Sequence[Path], protocols: Sequence[Protocol]) -> None:
    """Raise UsageError if the number of lights exceeds the lights of every capture."""
    most = 0
    for capture in captures:
        # For other captures, the evaluation reports the reason.
        with suppress(InputError, OSError):
            most = max(most, open_capture(capture).n_lights)
    for protocol in protocols:
        if most and protocol.n_lights is not None and protocol.n_lights > most:
            raise UsageError(
                f"the captures have at most {most} lights, but --n-lights is {protocol.n_lights}",
                hint=f"Use --n-lights {most}, or fewer",
            )


def _try_each(
    label: str, tasks: Sequence[Callable[[Advance], Found]], observer: Observer
) -> tuple[list[Found], list[str]]:
    """Return the results of the tasks that succeed, and the reasons why the others fail.

    Each task is given a function that counts its progress.
    """
    found: list[Found] = []
    problems: list[str] = []
    with observer.progress(label, len(tasks)) as advance:
        for task in tasks:
            try:
                found.append(task(advance))
            except (InputError, UsageError) as error:
                problems.append(str(error))
    return found, problems


def _score_on_workers(
    estimators: Sequence[Estimator],
    method_options: MethodOptions,
    cluster: ClusterOptions,
    output: Path,
    observer: Observer,
    draws: Sequence[DrawTask],
) -> Iterator[tuple[DrawTask, Scored]]:
    """Yield the draws with their scores as they finish, one item per draw.

    Only this process writes to the store. After all other draws were scored, raises LostError if
    the workers of a draw were lost. Other errors are as in Distributor.run.
    """
    fingerprints = tuple((estimator.name, estimator.fingerprint) for estimator in estimators)
    score = partial(_score, uuid.uuid4().hex, fingerprints, method_options)
    memory = cache(lambda folder: source_bytes(lambda: open_capture(folder)))
    items = (WorkItem((draw,), draw.reading.name, memory(draw.reading.folder)) for draw in draws)
    lost: LostError | None = None
    with distributor(score, output, cluster, observer) as workers:
        for item, result in workers.run(items):
            if isinstance(result, LostError):
                lost = result
            else:
                yield item.args[0], result
    if lost is not None:
        raise lost


def _score(
    command: str, fingerprints: tuple[tuple[str, str], ...], options: MethodOptions, draw: DrawTask
) -> Scored:
    return _scorer(command, fingerprints, options)(draw)


@lru_cache(maxsize=1)
def _scorer(
    _command: str, fingerprints: tuple[tuple[str, str], ...], options: MethodOptions
) -> Callable[[DrawTask], Scored]:
    """Return a function that scores draws on the worker, for one command.

    The function keeps the last capture in memory. Each command has its own, because files may
    change in between.
    """
    estimators = {name: make_estimator(name, options) for name, _ in fingerprints}
    for name, expected in fingerprints:
        if (found := estimators[name].fingerprint) != expected:
            raise ModelError(
                f"{name} is {found} here, expected {expected} as on the command's machine",
                hint="Use the same weight file and the same --precision on all machines",
            )
    last: tuple[CaptureReading, TrialSource, Notes] | None = None

    def score(task: DrawTask) -> Scored:
        nonlocal last
        if last is None or last[0] != task.reading:
            last = None  # frees the memory
            reading = task.reading
            try:
                last = reading, *reading.read(open_to_score(reading.folder, reading.protocols[0]))
            except (InputError, UsageError) as error:
                return error
        _, source, notes = last
        shared = SharedDraw(source)
        return [shared.score(trial, estimators[trial.method]) for trial in task.trials], notes

    return score
