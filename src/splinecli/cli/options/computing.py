"""Options of the panels Method and Speed."""

from __future__ import annotations

from typing import Annotated

from typer import Option

from splinecli.cli import choices
from splinecli.cli.options.values import Device as DeviceChoice
from splinecli.cli.options.values import Precision as PrecisionChoice
from splinecli.cli.options.values import complete_weights

Method = Annotated[str, Option(metavar="METHOD", help="{methods}.", autocompletion=choices.methods)]
Methods = Annotated[
    list[str] | None,
    Option(
        metavar="M",
        help="Method to score, or all. May be repeated. [default: spline-net]",
        autocompletion=lambda: [*choices.methods(), "all"],
    ),
]
Weights = Annotated[
    str | None,
    Option(
        metavar="NAME|FILE",
        help="Weights: a shipped name or a file. [default: those of the method]",
        autocompletion=complete_weights,
    ),
]
Rotations = Annotated[
    int | None,
    Option(
        metavar="R",
        min=1,
        help="Rotated copies of each pixel that a network averages over. [default: 1; cnn-ps: 10]",
    ),
]
Stiffness = Annotated[
    float, Option(metavar="K", min=0, help="How easily the surface tears at edges. 0 never tears it.")
]
LargestStep = Annotated[
    float | None,
    Option(
        metavar="PIXELS",
        min=0,
        help="Leave out triangles whose corners differ more in height. [default: keep all]",
    ),
]

Device = Annotated[DeviceChoice, Option(help="Device to compute on. auto takes a CUDA GPU if there is one.")]
Precision = Annotated[
    PrecisionChoice, Option(help="Number format. auto takes bfloat16 where the hardware supports it.")
]
BatchSize = Annotated[
    int | None, Option(metavar="N", min=1, help="Pixels that the method computes at a time.")
]
Jobs = Annotated[
    int | None,
    Option(metavar="N", min=1, help="Number of trials at a time. [default: number of cores; 1 on a GPU]"),
]
