"""`splinecli evaluate`: methods compared over random draws of lights."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

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


def evaluate(
    datasets: Annotated[
        list[Path], typer.Argument(metavar="DATASET", help="Folders of captures with ground truth, or such captures.")
    ],
    method: Annotated[
        list[str] | None, typer.Option(metavar="M", help="Method to score; may be repeated. [default: spline-net]")
    ] = None,
    weights: WeightsOption = None,
    n_lights: Annotated[
        list[str] | None, typer.Option(metavar="K|all", help="Lights a draw; may be repeated. [default: 10]")
    ] = None,
    trials: Annotated[int, typer.Option(metavar="T", min=1, help="Random draws of the lights.")] = 20,
    seed: SeedOption = 0,
    draws: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Use these draws: a line of light indices, from 0, each.")
    ] = None,
    max_pixels: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Score a random part of each capture's pixels.")
    ] = None,
    rotations: RotationsOption = 1,
    batch_size: BatchSizeOption = None,
    device: DeviceOption = Device.auto,
    precision: PrecisionOption = Precision.auto,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results. [default: evaluation]")
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """Score methods on captures with ground truth: mean angular error over random draws of K lights.

    All methods see the same draws. Writes OUT/results.json, results.csv and table.md, and prints the table. A capture
    that cannot be scored is named and passed over; the exit code is then 3.
    """
