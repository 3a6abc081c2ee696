"""Options of the panels Method and Speed."""

from __future__ import annotations

from typer import Option

from splinecli.cli import choices
from splinecli.cli.options.values import Device, Precision, complete_weights

METHOD = Option("spline-net", metavar="METHOD", help="{methods}.", autocompletion=choices.methods)
METHODS = Option(
    None,
    metavar="M",
    help="Method to score, or all. May be repeated. [default: spline-net]",
    autocompletion=lambda: [*choices.methods(), "all"],
)
WEIGHTS = Option(
    None,
    metavar="NAME|FILE",
    help="Weights: a shipped name or a file. [default: those of the method]",
    autocompletion=complete_weights,
)
ROTATIONS = Option(
    None,
    metavar="R",
    min=1,
    help="Rotated copies of each pixel that a network averages over. [default: 1; cnn-ps: 10]",
)
STIFFNESS = Option(2.0, metavar="K", min=0, help="How easily the surface tears at edges. 0 never tears it.")
LARGEST_STEP = Option(
    None,
    metavar="PIXELS",
    min=0,
    help="Leave out triangles whose corners differ more in height. [default: keep all]",
)

DEVICE = Option(Device.auto, help="Device to compute on. auto takes a CUDA GPU if there is one.")
PRECISION = Option(Precision.auto, help="Number format. auto takes bfloat16 where the hardware supports it.")
BATCH_SIZE = Option(None, metavar="N", min=1, help="Pixels that the method computes at a time.")
JOBS = Option(
    None, metavar="N", min=1, help="Number of trials at a time. [default: number of cores; 1 on a GPU]"
)
