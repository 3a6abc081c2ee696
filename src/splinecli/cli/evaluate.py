"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
)
from splinecli.cli.talk import Talk
from splinecli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splinecli.evaluation.records import Evaluation, Progress


def evaluate(
    datasets: Annotated[
        list[Path],
        typer.Argument(metavar="DATASET", help="Folders of captures with ground truth, or such captures."),
    ],
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="M", help="Method to score; may be repeated. [default: spline-net]"),
    ] = None,
    weights: WeightsOption = None,
    n_lights: Annotated[
        list[str] | None, typer.Option(metavar="K|all", help="Lights a draw; may be repeated. [default: 10]")
    ] = None,
    trials: Annotated[int, typer.Option(metavar="T", min=1, help="Random draws of the lights.")] = 20,
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
    rotations: RotationsOption = 1,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results.")
    ] = Path("evaluation"),
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Score methods on captures with ground truth: mean angular error over random draws of K lights.

    All methods see the same draws. Writes OUT/results.json, results.csv and table.md, and prints the table. A capture
    that cannot be scored is named and passed over; the exit code is then 3.
    """
    from splinecli.capture import find_captures
    from splinecli.evaluation.protocol import evaluate as score
    from splinecli.evaluation.records import Protocol
    from splinecli.evaluation.tables import markdown, results_csv, results_document
    from splinecli.files import check_writable, write_text
    from splinecli.methods import DEFAULT_METHOD, MethodOptions, check_method, make_estimator

    if draws is not None and n_lights:
        raise UsageError("--draws and --n-lights exclude each other", hint="The draws say how many lights")
    counts: list[int | None] = (
        [None] if draws is not None else [_light_count(text) for text in dict.fromkeys(n_lights or ["10"])]
    )
    protocols = [
        Protocol(count, trials, seed, draws, light_noise_deg=noise, max_pixels=max_pixels)
        for count in counts
        for noise in dict.fromkeys(light_noise_deg or [0.0])
    ]
    methods = list(dict.fromkeys(method or [DEFAULT_METHOD]))
    for name in methods:
        check_method(name)
    captures = [capture for dataset in datasets for capture in find_captures(dataset)]
    check_writable(output)
    _check_counts(captures, counts)
    options = MethodOptions(weights, rotations, batch_size, device.value, precision.value)
    estimators = [make_estimator(name, options) for name in methods]
    talk = Talk(quiet=quiet)
    evaluations = []
    with talk.progress("evaluating", len(protocols)) as advance:
        for protocol in protocols:
            evaluations.append(score(captures, estimators, protocol, on_progress=_follow(advance, methods)))
    document = results_document(evaluations)
    text = json.dumps(document, indent=2) + "\n"
    write_text(output / "results.csv", results_csv(evaluations))
    write_text(output / "table.md", markdown(evaluations))
    write_text(output / "results.json", text)
    for skipped in document["skipped"]:
        print(f"splinecli: {skipped['capture']} was passed over: {skipped['reason']}", file=sys.stderr)
    if as_json:
        print(text, end="")
    elif not quiet:
        for evaluation in evaluations:
            _print_table(evaluation, with_title=len(evaluations) > 1)
    return InputError.exit_code if document["skipped"] else 0


def _light_count(text: str) -> int | None:
    """A number of lights, None for "all". Raises UsageError."""
    if text == "all":
        return None
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--n-lights is {text!r}; expected a number of lights, or all") from None


def _follow(advance: Callable[[float], None], methods: list[str]) -> Callable[[Progress], None]:
    """A callback that advances a bar by 1 over all captures and methods; reading counts for nothing."""
    shown = 0.0

    def follow(progress: Progress) -> None:
        nonlocal shown
        if progress.method is None:
            return
        within = (methods.index(progress.method) + progress.done / progress.total) / len(methods)
        now = (progress.number - 1 + within) / progress.n_captures
        advance(now - shown)
        shown = now

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
    console.print(table, width=max(console.width, console.measure(table).maximum), crop=False)
