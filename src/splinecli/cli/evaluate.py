"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from splinecli.cli.console import Messages
from splinecli.cli.options import computing, distribution, inputs, outputs
from splinecli.cli.options.values import (
    Device,
    Precision,
    parse_cluster,
    parse_light_count,
    parse_pixel,
    parse_skip,
)
from splinecli.cli.records import record_from
from splinecli.errors import InputError

if TYPE_CHECKING:
    from splinecli.evaluation.outcome import Evaluation
    from splinecli.pipeline.evaluate import EvaluateOutcome


def evaluate(
    datasets: list[Path] = inputs.DATASETS,
    method: list[str] | None = computing.METHODS,
    weights: str | None = computing.WEIGHTS,
    n_lights: list[str] | None = inputs.NUMBERS_OF_LIGHTS,
    trials: int | None = inputs.TRIALS,
    seed: int = inputs.SEED,
    draws: Path | None = inputs.DRAWS,
    light_noise_deg: list[float] | None = inputs.LIGHT_NOISE,
    lights: str | None = inputs.ESTIMATED_LIGHTS,
    refine_lights: bool = inputs.REFINE_LIGHTS,
    light_error_deg: float | None = inputs.LIGHT_ERROR,
    as_stored: bool = inputs.AS_STORED,
    white_level: float | None = inputs.WHITE_LEVEL,
    max_pixels: int | None = inputs.MAX_PIXELS,
    skip_first: list[str] | None = inputs.SKIP_FIRST,
    rotations: int | None = computing.ROTATIONS,
    device: Device = computing.DEVICE,
    precision: Precision = computing.PRECISION,
    jobs: int | None = computing.JOBS,
    workers: str = distribution.TRIAL_WORKERS,
    cluster: str | None = distribution.TRIAL_CLUSTER,
    figures: bool = outputs.FIGURES,
    pixel: list[str] | None = outputs.FIGURE_PIXELS,
    output: Path = outputs.EVALUATION_FOLDER,
    overwrite: bool = outputs.OVERWRITE_TRIALS,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> int:
    """Compare methods by their mean angular error over random draws of K lights.

    All methods see the same draws. Captures are read as infer reads them; --as-stored reproduces published tables.

    Prints a table. Writes results.json, results.csv, table.md, table.tex and report.html to OUT, and a plot if you
    give several K or SIGMA. OUT/trials.jsonl stores finished trials: run the command again to go on, or with more
    trials, methods or lights. A capture that cannot be scored is skipped with a message, and the exit code is then 3.
    """
    given = locals()

    from splinecli.methods import DEFAULT_METHOD, MethodOptions, method_names
    from splinecli.pipeline.evaluate import EvaluateOptions, evaluate_captures

    options = record_from(
        EvaluateOptions,
        given,
        methods=tuple(
            name for text in method or [DEFAULT_METHOD] for name in (method_names() if text == "all" else [text])
        ),
        method_options=MethodOptions(weights, rotations, device=device.value, precision=precision.value),
        n_lights=tuple(parse_light_count(text) for text in n_lights or []),
        light_noise_deg=tuple(light_noise_deg or [0.0]),
        skip_first=dict(parse_skip(text) for text in skip_first or []),
        pixels=tuple(parse_pixel(text) for text in pixel or []),
        cluster=parse_cluster(workers, cluster, gpu=device is Device.cuda),
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
        talk.error(f"{entry['capture']} was skipped: {entry['reason']}")
    for problem in outcome.figure_problems:
        talk.error(f"no figure: {problem}")
    for warning in outcome.warnings:
        talk.warn(warning)
    for note in outcome.document["notes"]:
        talk.say(f"splinecli: note: {note}")


def _print_table(evaluation: Evaluation) -> None:
    """Print methods by captures, or captures by methods where that is too wide for the terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from splinecli.evaluation.tables import best_cells, caption, table_rows

    rows = table_rows(evaluation)
    best = best_cells(rows)
    cells = [[Text(cell, "bold" if (r, c) in best else "") for c, cell in enumerate(row)] for r, row in enumerate(rows)]
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
