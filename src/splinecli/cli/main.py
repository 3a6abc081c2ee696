"""The Typer app and its commands, and the entry point, which turns every error into one message and an exit code.

Importing it must stay cheap: no torch, no OpenCV.
"""

import inspect
import io
import logging
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer
from typer.models import ParameterInfo

from splinecli import __version__
from splinecli.cli.calibrate import calibrate
from splinecli.cli.commands import Command, Group
from splinecli.cli.console import Messages, print_lines
from splinecli.cli.evaluate import evaluate
from splinecli.cli.failures import DEFECT, explain
from splinecli.cli.import_weights import import_weights
from splinecli.cli.infer import infer
from splinecli.cli.info import info
from splinecli.cli.integrate import integrate
from splinecli.cli.prepare import prepare
from splinecli.cli.signals import INTERRUPTED, TOLD
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


def main(args: Sequence[str] | None = None) -> int:
    """Run `splinecli ARGS` and return the exit code (the contract is in docs/files-and-frames.md)."""
    _repair_streams()
    # By default, PyTorch's threads spin while they wait for each other. On a machine that is busy with other work this
    # takes cores from the thread that computes. PyTorch reads the variable when it is first imported.
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    logging.lastResort = logging.NullHandler()  # logs of libraries are no messages for users
    out, err = UntilClosed(sys.stdout), UntilClosed(_apart(sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        code = _run_command(args)
        out.flush()
    return code


def _run_command(args: Sequence[str] | None) -> int:
    command, messages = typer.main.get_command(app), Messages(quiet=False)
    try:
        result = command.main(args=None if args is None else list(args), prog_name="splinecli", standalone_mode=False)
    except KeyboardInterrupt:
        result = INTERRUPTED
    except Exception as error:
        message, exit_code = explain(error)
        if message == DEFECT:
            print_lines(traceback.format_exc())
        messages.error(message)
        return exit_code
    if result == INTERRUPTED:
        TOLD.set()
        messages.error("interrupted.")
    return result if isinstance(result, int) else 0


class UntilClosed:
    """A text stream that drops all output once its pipe is closed. All other attributes are the stream's.

    With a plain stream, the next line that a command prints would raise an error and end the command's work.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text and return its length."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._mute()
            return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._mute()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _mute(self) -> None:
        """Send the stream to the null device, with what its buffer still has."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)


def _repair_streams() -> None:
    """Make streams usable that are closed (`>&-`) or cannot hold every character (an ASCII locale)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - for the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _apart(stream: TextIO) -> TextIO:
    """Return the stream stderr with a file descriptor of its own.

    Descriptor 2 is redirected while an image is decoded, because the C libraries print there (see native_stderr). Other
    threads can print meanwhile.
    """
    if not isinstance(stream, io.TextIOWrapper) or stream.fileno() != 2:
        return stream
    stream.flush()
    try:
        own = os.fdopen(os.dup(2), "wb", buffering=0)
    except OSError:  # a limit on open files; the command reports it
        return stream
    return io.TextIOWrapper(own, stream.encoding, stream.errors, line_buffering=True, write_through=True)
