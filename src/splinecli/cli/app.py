"""The Typer app and its commands. Importing it must stay cheap: no torch, no OpenCV."""

import inspect
from typing import Annotated

import typer
from typer.models import ParameterInfo

from splinecli import __version__
from splinecli.cli.calibrate import calibrate
from splinecli.cli.commands import Command, Group
from splinecli.cli.evaluate import evaluate
from splinecli.cli.import_weights import import_weights
from splinecli.cli.infer import infer
from splinecli.cli.info import info
from splinecli.cli.integrate import integrate
from splinecli.cli.prepare import prepare
from splinecli.cli.train import train
from splinecli.cli.watch import watch

app = typer.Typer(
    name="splinecli",
    cls=Group,
    help="Surface normals from a few photographs under known lights (photometric stereo with SPLINE-Net).",
    epilog="Exit codes: 0 done, 1 defect, 2 usage, 3 bad input, 4 weights or configuration, 5 output, 130 interrupted.",
    # Plain text reads the same on a terminal, in a pipe and in the documentation.
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"splinecli {__version__}")
        raise typer.Exit


@app.callback()
def _splinecli(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    pass


for _command in (infer, watch, info, calibrate, integrate, evaluate, prepare, train, import_weights):
    # By default, Typer refuses a path without permission. One such capture would then end a batch.
    for _parameter in inspect.signature(_command).parameters.values():
        if isinstance(_parameter.default, ParameterInfo):
            _parameter.default.readable = False
    app.command(cls=Command)(_command)
