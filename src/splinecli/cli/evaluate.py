"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    BatchSizeOption,
    Device,
    DeviceOption,
    JsonOption,
    Precision,
    PrecisionOption,
    QuietOption,
    RotationsOption,
    SeedOption,
    WeightsOption,
    complete_methods,
    parse_indices,
)
from splinecli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splinecli.evaluation.capture_figures import CaptureFigure
    from splinecli.evaluation.records import Evaluation
    from splinecli.methods import Estimator

DEFAULT_TRIALS = 100
TRIALS, REPORT = "trials.jsonl", "report.html"
LIGHTS_PLOT, LIGHT_NOISE_PLOT = "lights.png", "light_noise.png"


def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(metavar="DATASET", help="Folders of captures with ground truth, or such captures."),
    ],
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="M",
            help="Method to score, or all; may be repeated. [default: spline-net]",
            autocompletion=lambda: [*complete_methods(), "all"],
        ),
    ] = None,
    weights: WeightsOption = None,
    n_lights: Annotated[
        list[str] | None, typer.Option(metavar="K|all", help="Lights a draw; may be repeated. [default: 10]")
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(metavar="T", min=1, help=f"Random draws of the lights. [default: {DEFAULT_TRIALS}]"),
    ] = None,
    seed: SeedOption = 0,
    draws: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Use these draws: a line of light indices, from 0, each."),
    ] = None,
    light_noise_deg: Annotated[
        list[float] | None,
        typer.Option(
            metavar="SIGMA", min=0, help="Tilt the lights by Gaussian errors; may be repeated. [default: 0]"
        ),
    ] = None,
    max_pixels: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Score a random part of each capture's pixels.")
    ] = None,
    skip_first: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CAPTURE=]N",
            help="Leave out the first N images of a capture, or of every one; may be repeated.",
        ),
    ] = None,
    rotations: RotationsOption = None,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Trials at a time. [default: the cores; 1 on a GPU]"),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Also draw every method's maps of each capture's first draw.")
    ] = False,
    pixel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROW,COLUMN", help="With --figures: show this pixel's observation maps; may be repeated."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results.")
    ] = Path("evaluation"),
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Compute again what OUT already holds.")
    ] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Score methods on captures with ground truth: mean angular error over random draws of K lights.

    All methods see the same draws. Writes OUT/results.json, results.csv, table.md, table.tex and report.html, with
    plots where several K or SIGMA are given, and prints the table. Finished trials are kept in OUT/trials.jsonl as they
    come: the same command, or one that asks for more, goes on from there. A capture that cannot be scored is named and
    passed over; the exit code is then 3.
    """
    from splinecli.capture import find_captures
    from splinecli.evaluation.records import Protocol
    from splinecli.evaluation.report import html_report
    from splinecli.evaluation.run import TrialStore, evaluate_all
    from splinecli.files import check_writable, held_folder, write_text
    from splinecli.methods import DEFAULT_METHOD, MethodOptions, check_method, make_estimator, method_names

    if draws is not None and n_lights:
        raise UsageError("--draws and --n-lights exclude each other", hint="The draws say how many lights")
    if trials is not None and draws is not None:
        raise UsageError("--draws and --trials exclude each other", hint="Each line of the draws is a trial")
    pixels = [_pixel(text) for text in pixel or []]
    counts: list[int | None] = (
        [None] if draws is not None else list(dict.fromkeys(map(_light_count, n_lights or ["10"])))
    )
    settings: dict[str, Any] = {
        "trials": trials or DEFAULT_TRIALS,
        "seed": seed,
        "draws_file": draws,
        "max_pixels": max_pixels,
        "skip_first": dict(_skip(text) for text in skip_first or []),
    }
    protocols = [
        Protocol(count, light_noise_deg=noise, **settings)
        for count in counts
        for noise in dict.fromkeys(light_noise_deg or [0.0])
    ]
    asked = method or [DEFAULT_METHOD]
    methods = list(dict.fromkeys(name for text in asked for name in _names(text, method_names())))
    for name in methods:
        check_method(name)
    if pixel and not (figures and "spline-net" in methods):
        raise UsageError(
            "--pixel chooses whose observation maps --figures shows",
            hint="Add --figures and --method spline-net",
        )
    captures = [capture for dataset in datasets for capture in find_captures(dataset)]
    check_writable(output)
    _check_counts(captures, counts)
    options = MethodOptions(weights, rotations, batch_size, device.value, precision.value)
    estimators = [make_estimator(name, options) for name in methods]
    on_gpu = any(estimator.device.startswith("cuda") for estimator in estimators)
    talk = Messages(quiet=quiet)
    not_drawn: list[str] = []
    with held_folder(output):
        store = TrialStore(output / TRIALS, fresh=overwrite)
        with talk.progress("evaluating", 1.0) as advance:
            evaluations = evaluate_all(
                captures,
                estimators,
                protocols,
                store=store,
                jobs=jobs or (1 if on_gpu else _cores()),
                on_progress=_follow(advance),
            )
        document, plots = _write_results(output, evaluations)
        if figures:
            drawn, not_drawn = _draw_figures(captures, estimators, evaluations, pixels, talk)
            _write_figures(output, drawn)
            shown = [*plots, *((figure.caption, figure.png) for figure in drawn)]
            write_text(output / REPORT, html_report(evaluations, shown, document["notes"]))
    for entry in document["skipped"]:
        print(f"splinecli: {entry['capture']} was passed over: {entry['reason']}", file=sys.stderr)
    for warning in _untrained(evaluations):
        talk.warn(warning)
    for note in document["notes"]:
        talk.say(f"splinecli: note: {note}")
    if as_json:
        print(json.dumps(document, indent=2))
    elif not quiet:
        for evaluation in evaluations:
            _print_table(evaluation, with_title=len(evaluations) > 1)
    for problem in not_drawn:
        print(f"splinecli: no figure: {problem}", file=sys.stderr)
    return InputError.exit_code if document["skipped"] or not_drawn else 0


def _write_results(
    output: Path, evaluations: list[Evaluation]
) -> tuple[dict[str, Any], list[tuple[str, bytes]]]:
    """Write all but the figures, and remove plots of an earlier call.

    Returns results.json's content, and the plots with their captions.
    """
    from splinecli.evaluation.curves import light_noise_curves, lights_curves
    from splinecli.evaluation.report import html_report
    from splinecli.evaluation.tables import latex, markdown, results_csv, results_document
    from splinecli.files import refusals_as_output_errors, write_bytes, write_text

    plots: dict[str, tuple[str, bytes] | None] = {LIGHTS_PLOT: None, LIGHT_NOISE_PLOT: None}
    if len({evaluation.protocol.n_lights for evaluation in evaluations}) > 1:
        plots[LIGHTS_PLOT] = ("Error against the number of lights.", lights_curves(evaluations))
    if len({evaluation.protocol.light_noise_deg for evaluation in evaluations}) > 1:
        plots[LIGHT_NOISE_PLOT] = ("Error against the light noise.", light_noise_curves(evaluations))
    document = results_document(evaluations)
    drawn = [plot for plot in plots.values() if plot]
    write_text(output / "results.csv", results_csv(evaluations))
    write_text(output / "table.md", markdown(evaluations))
    write_text(output / "table.tex", latex(evaluations))
    for name, plot in plots.items():
        if plot:
            write_bytes(output / name, plot[1])
        else:
            with refusals_as_output_errors(output / name):
                (output / name).unlink(missing_ok=True)
    write_text(output / REPORT, html_report(evaluations, drawn, document["notes"]))
    write_text(output / "results.json", json.dumps(document, indent=2) + "\n")
    return document, drawn


def _draw_figures(
    captures: list[Path],
    estimators: list[Estimator],
    evaluations: list[Evaluation],
    pixels: list[tuple[int, int]],
    talk: Messages,
) -> tuple[list[CaptureFigure], list[str]]:
    """Of the captures that were scored under the first protocol; and what stood in the way of the others."""
    from splinecli.evaluation.capture_figures import capture_figures, file_stems
    from splinecli.evaluation.run import distinct_names

    first = evaluations[0]
    named = {name: folder for folder, name in distinct_names(captures).items() if name in first.captures}
    drawn, problems = [], []
    with talk.progress("drawing", len(named)) as advance:
        for (name, folder), stem in zip(named.items(), file_stems(list(named)), strict=True):
            try:
                drawn += capture_figures(folder, name, stem, estimators, first.protocol, pixels)
            except (InputError, UsageError) as error:
                problems.append(str(error))
            advance(1)
    return drawn, problems


def _write_figures(output: Path, drawn: list[CaptureFigure]) -> None:
    """Write the figures, and remove those of an earlier call."""
    from splinecli.files import refusals_as_output_errors, write_bytes

    folder = output / "figures"
    names = {f"{figure.stem}.png" for figure in drawn}
    with refusals_as_output_errors(folder):
        for path in folder.glob("*.png"):
            if path.name not in names:
                path.unlink()
    for figure in drawn:
        write_bytes(folder / f"{figure.stem}.png", figure.png)


def _untrained(evaluations: list[Evaluation]) -> list[str]:
    """Warnings of shipped weights that were scored with numbers of lights they were not trained for."""
    used = [weights for settings in evaluations[0].settings.values() if (weights := settings["weights"])]
    if not used:
        return []
    from splinecli.networks.weights import untrained_warning

    counts = sorted({result.n_lights for evaluation in evaluations for result in evaluation.results})
    return [
        warning for weights in used for k in counts for warning in untrained_warning(weights["sha256"], k)
    ]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _names(text: str, known: list[str]) -> list[str]:
    return known if text == "all" else [text]


def _skip(text: str) -> tuple[str, int]:
    """("bearPNG", 20) of "bearPNG=20", ("*", 20) of "20". Raises UsageError."""
    name, equals, count = text.rpartition("=")
    if not count.isdecimal() or bool(name) != bool(equals):
        raise UsageError(
            f"--skip-first is {text!r}; expected a number, or one for a capture as in bearPNG=20"
        )
    return name or "*", int(count)


def _pixel(text: str) -> tuple[int, int]:
    indices = parse_indices(text, "--pixel")
    if len(indices) != 2 or min(indices) < 0:
        raise UsageError(f"--pixel is {text!r}; expected a row and a column such as 120,85")
    return indices[0], indices[1]


def _light_count(text: str) -> int | None:
    """A number of lights, None for "all". Raises UsageError."""
    if text == "all":
        return None
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--n-lights is {text!r}; expected a number of lights, or all") from None


def _follow(advance: Callable[..., None]) -> Callable[[int, int], None]:
    """A callback that moves a bar of length 1 with the trials."""
    shown = 0.0

    def follow(done: int, total: int) -> None:
        nonlocal shown
        advance(done / total - shown, f"trial {done} of {total}")
        shown = done / total

    return follow


def _check_counts(captures: list[Path], counts: list[int | None]) -> None:
    """Raise UsageError for more lights than any capture has, before anything is scored."""
    from splinecli.capture import open_capture

    most = 0
    for capture in captures:
        with suppress(InputError):  # scoring passes it over and says why
            most = max(most, open_capture(capture).n_lights)
    for count in counts:
        if most and count is not None and count > most:
            raise UsageError(f"{count} lights wanted, the captures have at most {most}")


def _print_table(evaluation: Evaluation, *, with_title: bool) -> None:
    """Methods by captures; captures by methods where that is too wide for the terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from splinecli.evaluation.tables import best_cells, heading, table_rows

    rows = table_rows(evaluation)
    best = best_cells(rows)
    cells = [
        [Text(cell, "bold" if (r, c) in best else "") for c, cell in enumerate(row)]
        for r, row in enumerate(rows)
    ]
    console = Console(highlight=False)
    if sum(max(len(row[column]) for row in rows) + 3 for column in range(len(rows[0]))) > console.width:
        cells = [list(column) for column in zip(*cells, strict=True)]
    title = f"MAE in degrees, {heading(evaluation.protocol)}" if with_title else None
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for column, name in enumerate(cells[0]):
        table.add_column(name, justify="right" if column else "left", no_wrap=True)
    for row in cells[1:]:
        table.add_row(*row)
    # A table is for reading, also in a pipe: rather too wide than cut.
    widest = console.measure(table, options=console.options.update(max_width=10_000)).maximum
    Console(highlight=False, width=max(console.width, widest)).print(table, crop=False)
