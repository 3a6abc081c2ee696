"""Options of the panels Method and Speed."""

from __future__ import annotations

from typer import Option

from splinecli.cli import choices
from splinecli.cli.options.values import Device, Precision, complete_weights

METHOD = Option("spline-net", metavar="METHOD", help="Method to use: {methods}.", autocompletion=choices.methods)
METHODS = Option(
    None,
    metavar="M",
    help="Method to score: all, {methods}. May be repeated. [default: spline-net]",
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
    help="Average the network's result over R views of each pixel: its lights rotated, for spline-net also mirrored."
    " [default: 1; cnn-ps: 10]",
)
DISTIL = Option(
    None,
    "--distil/--exact",
    help="Let a small network learn the method on a sample of the pixels and estimate the rest, or use the method"
    " on every pixel. [default: the faster one from 100,000 pixels, else --exact]",
)
STIFFNESS = Option(
    2.0,
    metavar="K",
    min=0,
    help="How easily the surface of integrate or --surface tears at edges. 0 never tears it.",
)
PRIOR_DETAIL = Option(
    None,
    metavar="PIXELS",
    min=1,
    help="With --prior: shapes narrower than this come from the normals. [default: 15 % of the object's size]",
)
LARGEST_STEP = Option(
    None,
    metavar="PIXELS",
    min=0,
    help="Leave out triangles whose corners differ by more than this height. [default: keep all]",
)

DEVICE = Option(Device.auto, help="Device to compute on. auto is a CUDA GPU if there is one, else the CPU.")
PRECISION = Option(Precision.auto, help="Number format. auto is bfloat16 if the hardware supports it, else float32.")
JOBS = Option(None, metavar="N", min=1, help="Number of trials at a time. [default: number of cores; 1 on a GPU]")
