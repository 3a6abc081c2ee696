"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import (
    AsStoredOption,
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
    WhiteLevelOption,
    complete_methods,
    parse_indices,
)
from splinecli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splinecli.evaluation.outcome import Evaluation
    from splinecli.pipeline.evaluate import EvaluateOutcome


def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATASET", help="Folders of captures with ground truth, or the captures themselves."
        ),
    ],
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="M",
            help="Method to score, or all. May be repeated. [default: spline-net]",
            autocompletion=lambda: [*complete_methods(), "all"],
        ),
    ] = None,
    weights: WeightsOption = None,
    n_lights: Annotated[
        list[str] | None,
        typer.Option(metavar="K|all", help="Number of lights in each draw. May be repeated. [default: 10]"),
    ] = None,
    trials: Annotated[
        int | None, typer.Option(metavar="T", min=1, help="Number of random draws. [default: 100]")
    ] = None,
    seed: SeedOption = 0,
    draws: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draws of lights: each line has light indices, counted from 0."),
    ] = None,
    light_noise_deg: Annotated[
        list[float] | None,
        typer.Option(
            metavar="SIGMA",
            min=0,
            help="Tilt the lights at random, with this standard deviation. May be repeated. [default: 0]",
        ),
    ] = None,
    as_stored: AsStoredOption = False,
    white_level: WhiteLevelOption = None,
    max_pixels: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Score N random pixels of each capture.")
    ] = None,
    skip_first: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CAPTURE=]N",
            help="Leave out the first N images of one capture, or of all. May be repeated.",
        ),
    ] = None,
    rotations: RotationsOption = None,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    jobs: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, help="Number of trials at a time. [default: number of cores; 1 on a GPU]"
        ),
    ] = None,
    figures: Annotated[
        bool, typer.Option("--figures", help="Draw every method's maps for the first draw of each capture.")
    ] = False,
    pixel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROW,COLUMN",
            help="With --figures: show the observation maps of this pixel. May be repeated.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results.")
    ] = Path("evaluation"),
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Compute trials again that OUT already has.")
    ] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Compare methods by their mean angular error over random draws of K lights.

    All methods see the same draws. Captures are read as infer reads them; --as-stored reproduces published tables.

    Prints a table. Writes results.json, results.csv, table.md, table.tex and report.html to OUT, and a plot where
    several K or SIGMA are given. OUT/trials.jsonl stores finished trials: run the command again to go on, or with more
    trials, methods or lights. A capture that cannot be scored is skipped with a message, and the exit code is then 3.
    """
    from splinecli.methods import DEFAULT_METHOD, MethodOptions, method_names
    from splinecli.pipeline.evaluate import EvaluateOptions, evaluate_captures

    options = EvaluateOptions(
        methods=tuple(
            name
            for text in method or [DEFAULT_METHOD]
            for name in (method_names() if text == "all" else [text])
        ),
        method_options=MethodOptions(weights, rotations, batch_size, device.value, precision.value),
        n_lights=tuple(_light_count(text) for text in n_lights or []),
        light_noise_deg=tuple(light_noise_deg or [0.0]),
        trials=trials,
        seed=seed,
        draws=None if draws is None else str(draws),
        max_pixels=max_pixels,
        skip_first=dict(_skip(text) for text in skip_first or []),
        as_stored=as_stored,
        white_level=white_level,
        jobs=jobs,
        figures=figures,
        pixels=tuple(_pixel(text) for text in pixel or []),
        output=str(output),
        overwrite=overwrite,
    )
    talk = Messages(quiet=quiet)
    outcome = evaluate_captures(datasets, options, talk)
    _report(outcome, talk)
    if as_json:
        print(json.dumps(outcome.document, indent=2))
    elif not quiet:
        for evaluation in outcome.evaluations:
            _print_table(evaluation)
    return InputError.exit_code if outcome.document["skipped"] or outcome.figure_problems else 0


def _report(outcome: EvaluateOutcome, talk: Messages) -> None:
    """Print what went wrong, warnings and notes on stderr."""
    for entry in outcome.document["skipped"]:
        print(f"splinecli: {entry['capture']} was skipped: {entry['reason']}", file=sys.stderr)
    for problem in outcome.figure_problems:
        print(f"splinecli: no figure: {problem}", file=sys.stderr)
    for warning in outcome.warnings:
        talk.warn(warning)
    for note in outcome.document["notes"]:
        talk.say(f"splinecli: note: {note}")


def _skip(text: str) -> tuple[str, int]:
    """Return ("bearPNG", 20) for "bearPNG=20" and ("*", 20) for "20". Raises UsageError."""
    from splinecli.evaluation.protocol import EVERY_CAPTURE

    name, equals, count = text.rpartition("=")
    if not count.isdecimal() or bool(name) != bool(equals):
        raise UsageError(
            f"--skip-first is {text!r}; expected a number, or one for a capture as in bearPNG=20"
        )
    return name or EVERY_CAPTURE, int(count)


def _pixel(text: str) -> tuple[int, int]:
    indices = parse_indices(text, "--pixel")
    if len(indices) != 2 or min(indices) < 0:
        raise UsageError(f"--pixel is {text!r}; expected a row and a column such as 120,85")
    return indices[0], indices[1]


def _light_count(text: str) -> int | None:
    """Return a number of lights, or None for "all". Raises UsageError."""
    if text == "all":
        return None
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--n-lights is {text!r}; expected a number of lights, or all") from None


def _print_table(evaluation: Evaluation) -> None:
    """Print methods by captures, or captures by methods where that is too wide for the terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from splinecli.evaluation.tables import best_cells, caption, table_rows

    rows = table_rows(evaluation)
    best = best_cells(rows)
    cells = [
        [Text(cell, "bold" if (r, c) in best else "") for c, cell in enumerate(row)]
        for r, row in enumerate(rows)
    ]
    console = Console(highlight=False)
    if sum(max(len(row[column]) for row in rows) + 3 for column in range(len(rows[0]))) > console.width:
        cells = [list(column) for column in zip(*cells, strict=True)]
    table = Table(box=box.SIMPLE_HEAD)
    for column, name in enumerate(cells[0]):
        table.add_column(name, justify="right" if column else "left", no_wrap=True)
    for row in cells[1:]:
        table.add_row(*row)
    print(caption(evaluation))
    # A table that is too wide can still be read; one that is cut cannot.
    widest = console.measure(table, options=console.options.update(max_width=10_000)).maximum
    Console(highlight=False, width=max(console.width, widest)).print(table, crop=False)
