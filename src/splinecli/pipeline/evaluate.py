"""What `evaluate` does: score methods on captures, and write tables, plots and a report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from splinecli.capture import find_captures, open_capture
from splinecli.capture.lights.found_lights import ESTIMATE
from splinecli.capture.restore.light_refinement import LIGHT_ERROR_DEG, check_light_error
from splinecli.capture.restore.white_level import check_white_level
from splinecli.errors import InputError, UsageError
from splinecli.evaluation.capture_figures import CaptureFigure, capture_figures, file_stems, has_observation_maps
from splinecli.evaluation.document import TRIALS, make_plots, write_results
from splinecli.evaluation.outcome import Evaluation
from splinecli.evaluation.plan import check_skip_first, distinct_names, read_draws_file
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.run import Elsewhere, evaluate_all
from splinecli.evaluation.trials import TrialStore
from splinecli.methods import DEFAULT_METHOD, Estimator, MethodOptions, check_method, make_estimator
from splinecli.networks.weights import untrained_warning
from splinecli.pipeline.connection import ClusterOptions
from splinecli.pipeline.evaluate_on_workers import score_on_workers
from splinecli.pipeline.observer import SILENT, Observer
from splinecli.system.devices import count_available_cores
from splinecli.system.files import check_writable
from splinecli.system.publishing import held_folder

DEFAULT_TRIALS = 100
DEFAULT_LIGHTS = 10


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """The options of `evaluate`, as its help describes them.

    Args:
        methods: a name that comes twice counts once.
        n_lights: None in it stands for all lights; one evaluation for each. Empty for DEFAULT_LIGHTS, or for the
            number in the draws file.
        light_noise_deg: one evaluation for each.
        trials: None for DEFAULT_TRIALS. jobs: None for the cores, or for 1 on a GPU.
        pixels: (row, column) of each.
        cluster: the processes or machines that score trials; None for this process.

    Raises:
        UsageError: a value is out of its range, or two options contradict each other.
    """

    methods: tuple[str, ...] = (DEFAULT_METHOD,)
    method_options: MethodOptions = field(default_factory=MethodOptions)
    n_lights: tuple[int | None, ...] = ()
    light_noise_deg: tuple[float, ...] = (0.0,)
    trials: int | None = None
    seed: int = 0
    draws: str | None = None
    max_pixels: int | None = None
    skip_first: dict[str, int] = field(default_factory=dict)
    as_stored: bool = False
    lights: str | None = None
    refine_lights: bool = False
    light_error_deg: float | None = None
    white_level: float | None = None
    jobs: int | None = None
    figures: bool = False
    pixels: tuple[tuple[int, int], ...] = ()
    output: str = "evaluation"
    overwrite: bool = False
    cluster: ClusterOptions | None = None

    def __post_init__(self) -> None:
        check_white_level(self.white_level)
        if self.draws is not None and self.n_lights:
            raise UsageError(
                "--draws and --n-lights contradict each other",
                hint="Leave --n-lights out: the draws determine the number of lights",
            )
        if self.draws is not None and self.trials is not None:
            raise UsageError(
                "--draws and --trials contradict each other",
                hint="Leave --trials out: each line of the draws is a trial",
            )
        check_light_error(self.light_error_deg, refines=self.refine_lights)
        if self.lights not in (None, ESTIMATE):
            raise UsageError(
                f"--lights is {self.lights}; expected {ESTIMATE}", hint="Without it, the captures' light files count"
            )
        if self.lights is not None and (self.refine_lights or any(self.light_noise_deg)):
            raise UsageError(
                "--lights estimate uses no light file, so it contradicts --refine-lights and --light-noise-deg",
                hint="Leave these out",
            )
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"--jobs is {self.jobs}; expected at least 1")
        if self.cluster is not None and self.jobs is not None:
            raise UsageError(
                "--jobs contradicts --workers and --cluster", hint="Leave it out: a worker scores one trial at a time"
            )
        for name in self.methods:
            check_method(name)
        if self.pixels and not (self.figures and any(map(has_observation_maps, self.methods))):
            raise UsageError(
                "--pixel chooses the observation maps that --figures shows",
                hint="Add --figures and --method spline-net",
            )
        _ = self.protocols

    @property
    def protocols(self) -> list[Protocol]:
        """One protocol for each number of lights and each light noise. Raises UsageError."""
        counts = self.n_lights or ((DEFAULT_LIGHTS,) if self.draws is None else (None,))
        return [
            Protocol(
                count,
                DEFAULT_TRIALS if self.trials is None else self.trials,
                self.seed,
                None if self.draws is None else Path(self.draws),
                noise,
                self.max_pixels,
                self.skip_first,
                self.as_stored,
                self.white_level,
                (self.light_error_deg or LIGHT_ERROR_DEG) if self.refine_lights else None,
                self.lights is not None,
            )
            for count, noise in product(dict.fromkeys(counts), dict.fromkeys(self.light_noise_deg))
        ]


class EvaluateOutcome(NamedTuple):
    """One evaluation for each protocol, the content of results.json, warnings, and why figures could not be drawn."""

    evaluations: list[Evaluation]
    document: dict[str, Any]
    warnings: list[str]
    figure_problems: list[str]


def evaluate_captures(
    datasets: Sequence[Path], options: EvaluateOptions, observer: Observer = SILENT
) -> EvaluateOutcome:
    """Score the methods on the captures, and write the results to the output folder.

    All options are checked before the first image is read.

    Args:
        datasets: folders of captures with ground truth, or such captures.

    Raises:
        UsageError: an option does not fit the captures or the methods.
        InputError: no capture could be scored, or a folder or the draws file is wrong.
        ModelError: weights cannot be used.
        OutputError: the output folder cannot be written.
    """
    captures = [capture for dataset in datasets for capture in find_captures(dataset)]
    output, protocols = Path(options.output), options.protocols
    check_writable(output)
    check_skip_first(protocols[0], list(distinct_names(captures).values()))
    read_draws_file(protocols[0])
    _check_counts(captures, protocols)
    estimators = [make_estimator(name, options.method_options) for name in dict.fromkeys(options.methods)]
    if options.method_options.weights is not None and not any(estimator.weights for estimator in estimators):
        names = ", ".join(estimator.name for estimator in estimators)
        raise UsageError(f"no weights are used by {names}", hint="Leave --weights out")
    jobs = 1 if any(estimator.device.startswith("cuda") for estimator in estimators) else count_available_cores()
    elsewhere: Elsewhere | None = None
    if (cluster := options.cluster and options.cluster.on_cores()) is not None:
        elsewhere = partial(score_on_workers, estimators, options.method_options, cluster, output, observer)
    with held_folder(output, observer.warn):
        with observer.progress("evaluating", 1.0) as advance:
            shown = 0.0

            def follow(done: float, total: int, note: str) -> None:
                nonlocal shown
                share = done / total if total else 1.0
                advance(share - shown, note)
                shown = share

            evaluations = evaluate_all(
                captures,
                estimators,
                protocols,
                store=TrialStore(output / TRIALS, fresh=options.overwrite),
                jobs=options.jobs or jobs,
                elsewhere=elsewhere,
                on_progress=follow,
            )
        plots = make_plots(evaluations)
        figures: list[CaptureFigure] | None = None
        problems: list[str] = []
        if options.figures:
            figures, problems = _draw_figures(captures, estimators, evaluations[0], options.pixels, observer)
        document = write_results(output, evaluations, plots, figures)
    return EvaluateOutcome(evaluations, document, _untrained(evaluations), problems)


def _check_counts(captures: Sequence[Path], protocols: Sequence[Protocol]) -> None:
    """Raise UsageError if more lights are requested than any capture has."""
    most = 0
    for capture in captures:
        with suppress(InputError, OSError):  # the evaluation skips the capture and says why
            most = max(most, open_capture(capture).n_lights)
    for protocol in protocols:
        if most and protocol.n_lights is not None and protocol.n_lights > most:
            raise UsageError(f"{protocol.n_lights} lights were requested, but the captures have at most {most}")


def _draw_figures(
    captures: Sequence[Path],
    estimators: Sequence[Estimator],
    evaluation: Evaluation,
    pixels: Sequence[tuple[int, int]],
    observer: Observer,
) -> tuple[list[CaptureFigure], list[str]]:
    folders = {name: folder for folder, name in distinct_names(captures).items()}
    names = [name for name in folders if name in evaluation.captures]
    figures: list[CaptureFigure] = []
    problems: list[str] = []
    with observer.progress("drawing", len(names)) as advance:
        for name, stem in zip(names, file_stems(names), strict=True):
            try:
                figures += capture_figures(folders[name], name, stem, estimators, evaluation.protocol, pixels, advance)
            except (InputError, UsageError) as error:
                problems.append(str(error))
    return figures, problems


def _untrained(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return warnings about shipped weights that were used with numbers of lights they were not trained for."""
    used = [weights for settings in evaluations[0].settings.values() if (weights := settings["weights"])]
    counts = sorted({result.n_lights for evaluation in evaluations for result in evaluation.results})
    return [warning for weights in used for k in counts for warning in untrained_warning(weights["sha256"], k)]
