"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from typer import Argument, Option

from splinecli.cli import shared
from splinecli.cli.console import Messages
from splinecli.errors import InputError
from splinecli.methods import DEFAULT_METHOD, MethodOptions, method_names

if TYPE_CHECKING:
    from splinecli.evaluation.protocol import Evaluation


def evaluate(
    datasets: list[Path] = Argument(
        ..., metavar="DATASET", help="Folders of captures with ground truth, or the captures themselves."
    ),
    method: list[str] | None = Option(
        None,
        metavar="M",
        help=f"Method to score: all, {shared.listed(method_names())}. May be repeated. [default: spline-net]",
        autocompletion=lambda: [*method_names(), "all"],
    ),
    weights: str | None = shared.WEIGHTS,
    n_lights: list[str] | None = Option(
        None, metavar="K|all", help="Number of lights in each draw. May be repeated. [default: 10]"
    ),
    trials: int | None = Option(
        None, metavar="T", min=1, help="Number of random draws. [default: 100; 10 of four methods or more]"
    ),
    seed: int = shared.SEED,
    draws: Path | None = Option(
        None, metavar="FILE", help="Draws of lights: each line has light indices, counted from 0."
    ),
    light_noise_deg: list[float] | None = Option(
        None,
        metavar="SIGMA",
        min=0,
        help="Tilt the lights at random, with this standard deviation in degrees. May be repeated. [default: 0]",
    ),
    lights: str | None = Option(
        None,
        metavar="estimate",
        help="Estimate the lights of each draw from its images, and score them, too."
        " [default: the captures' light files]",
    ),
    refine_lights: bool = shared.REFINE_LIGHTS,
    light_error_deg: float | None = Option(
        None, metavar="SIGMA", help="With --refine-lights: usual error of the directions in degrees. [default: 5]"
    ),
    as_stored: bool = shared.AS_STORED,
    white_level: float | None = shared.WHITE_LEVEL,
    max_pixels: int | None = Option(
        None, metavar="N", min=1, help="Score N random pixels of each capture. [default: all]"
    ),
    skip_first: list[str] | None = Option(
        None,
        metavar="[CAPTURE=]N",
        help="Leave out the first N images of one capture, or of all. May be repeated. [default: 0]",
    ),
    rotations: int | None = Option(
        None,
        metavar="R",
        min=1,
        help="Average the network's result over R views of each pixel: its lights rotated, for spline-net also"
        " mirrored. [default: 1; cnn-ps: 10]",
    ),
    device: shared.Device = shared.DEVICE,
    precision: shared.Precision = shared.PRECISION,
    jobs: int | None = Option(
        None, metavar="N", min=1, help="Number of trials at a time. [default: number of cores; 1 on a GPU]"
    ),
    workers: str = Option(
        "1",
        metavar="N|auto",
        help="Score trials in N processes of this machine, in place of --jobs threads (needs the extra 'cluster')."
        " auto is the number of cores.",
    ),
    cluster: str | None = Option(None, metavar="ADDRESS|FILE", help=shared.CLUSTER.format("Score trials")),
    figures: bool = Option(False, "--figures", help="Draw every method's maps for the first draw of each capture."),
    pixel: list[str] | None = Option(
        None, metavar="ROW,COLUMN", help="With --figures: show the observation maps of this pixel. May be repeated."
    ),
    output: Path = Option(Path("evaluation"), "--output", "-o", metavar="OUT", help="Folder of the results."),
    overwrite: bool = Option(False, "--overwrite", help="Compute all trials again, also those stored in OUT."),
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> int:
    """Compare methods by their mean angular error over random draws of K lights.

    All methods see the same draws. Captures are read as infer reads them; --as-stored reproduces published tables.

    Prints a table. Writes results.json, results.csv, table.md, table.tex and report.html to OUT, and a plot if you
    give several K or SIGMA. OUT/trials.jsonl stores finished trials: run the command again to go on, or with more
    trials, methods or lights. A capture that cannot be scored is skipped with a message, and the exit code is then 3.
    """
    given = locals()

    from splinecli.pipeline.evaluate import EvaluateOptions, evaluate_captures

    options = shared.record_from(
        EvaluateOptions,
        given,
        methods=tuple(
            name for text in method or [DEFAULT_METHOD] for name in (method_names() if text == "all" else [text])
        ),
        method_options=shared.record_from(MethodOptions, given),
        n_lights=tuple(shared.parse_light_count(text) for text in n_lights or []),
        light_noise_deg=tuple(light_noise_deg or [0.0]),
        skip_first=dict(shared.parse_skip(text) for text in skip_first or []),
        pixels=tuple(shared.parse_pixel(text) for text in pixel or []),
        cluster=shared.parse_cluster(workers, cluster, gpu=device is shared.Device.cuda),
    )
    talk = Messages(quiet=quiet)
    outcome = evaluate_captures(datasets, options, talk)
    for entry in outcome.document["skipped"]:
        talk.error(f"{entry['capture']} was skipped: {entry['reason']}")
    for problem in outcome.figure_problems:
        talk.error(f"no figure: {problem}")
    for warning in outcome.warnings:
        talk.warn(warning)
    for note in outcome.document["notes"]:
        talk.say(f"splinecli: note: {note}")
    if as_json:
        print(json.dumps(outcome.document, indent=2))
    elif not quiet:
        for evaluation in outcome.evaluations:
            _print_table(evaluation)
    return InputError.exit_code if outcome.document["skipped"] or outcome.figure_problems else 0


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
