"""The Typer app, the help of its commands in panels, and the entry point, which turns every error into an exit code.

Importing it must stay cheap: no torch, no OpenCV.
"""

import inspect
import io
import json
import logging
import os
import re
import sys
import textwrap
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import ParameterInfo

from splinecli import __version__
from splinecli.cli.calibrate import calibrate, integrate
from splinecli.cli.console import DEFECT, Messages, ParserError, error_document, explain, print_lines, printed_documents
from splinecli.cli.evaluate import evaluate
from splinecli.cli.infer import infer, info, watch
from splinecli.cli.prepare import prepare
from splinecli.cli.signals import INTERRUPTED, TOLD
from splinecli.cli.train import import_weights, train
from splinecli.system.machine import check_address_space, keep_freed_memory

TERM_WIDTH = 30  # columns of the names of options in the help; a longer name has a line of its own
HINT_WIDTH = 72  # columns of the help that a shell shows beside an option; Typer breaks it at 80
ARGUMENTS = "Arguments"

INFER = "infer"  # the command whose JSON is a list of documents
JSON, JSON_LINES = "--json", "--jsonl"

_RANGE = r"(?:[-\d.]+<=?)?x(?:[<>]=?[-\d.]+)?"

PANELS = {
    "infer": {
        "Input": "mask auto-mask crop scale ground-truth transfer ambient flat-field white-level as-stored",
        "Lights": "lights first-light light-frame lights-format intensities refine-lights light-positions"
        " light-distance pixel-size object-width camera-matrix n-lights seed light-indices",
        "Method": "method weights",
        "Output": "output format maps html surface stiffness convention strict update overwrite json jsonl quiet",
        "Speed": "distil device precision",
        "Processes and machines": "workers cluster shard",
    },
    "watch": {"Captures": "marker settle"},
    "info": {
        "Input": "mask auto-mask crop scale ground-truth transfer ambient flat-field white-level",
        "Lights": "lights first-light light-frame lights-format intensities light-positions light-distance pixel-size"
        " object-width camera-matrix check-lights mended-lights",
        "Output": "plot strict overwrite json quiet",
    },
    "calibrate": {
        "Input": "circle mask ball-diameter camera-matrix",
        "Light intensities": "gray-ball gray-card transfer",
        "Output": "output compare overwrite json quiet",
    },
    "integrate": {
        "Input": "mask camera-matrix pixel-size convention colours prior",
        "Method": "stiffness prior-detail largest-step",
        "Output": "output format decimate overwrite json quiet",
    },
    "evaluate": {
        "Input": "skip-first max-pixels as-stored white-level",
        "Lights": "lights n-lights trials seed draws light-noise-deg refine-lights light-error-deg",
        "Method": "method weights rotations",
        "Output": "output figures pixel overwrite json quiet",
        "Speed": "jobs device precision",
        "Processes and machines": "workers cluster",
    },
    "prepare": {
        "Input": "as-stored update white-level",
        "Scenes": "scenes mesh views relief size n-lights seed",
        "Output": "output json quiet",
        "Speed": "workers",
    },
    "train": {
        "Settings": "preset config param start-from seed",
        "Pixels": "generator-weight n-lights",
        "Length": "steps minutes resume",
        "Output": "output tensorboard quiet",
        "Speed": "device",
    },
    "import-weights": {"Output": "output overwrite quiet"},
}
"""Command -> title of a panel -> its options, in the order of the help."""

OTHERS = "Options"  # title of the options that no panel names, such as --help


class Command(TyperCommand):
    """A command whose help has panels, as plain text, and which expands `~` in its arguments.

    With --json, a command that fails prints a document on stdout as well: {"error", "exit_code"}.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments. An error of the parser gets the context, which names the command in the message."""
        wants_json, wants_lines = JSON in args, JSON_LINES in args  # the parser takes them out of the list
        try:
            return super().parse_args(ctx, args)
        except ParserError as error:
            if getattr(error, "ctx", self) is None:
                error.ctx = ctx  # type: ignore[attr-defined]
            if ctx.info_name == INFER:
                with printed_documents(as_list=wants_json, as_lines=wants_lines and not wants_json):
                    raise
            if wants_json and any(JSON in parameter.opts for parameter in self.params):
                print(json.dumps(error_document(error), indent=2))
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command. A shell expands `~` in `-o ~/x`, but not in `--output=~/x`."""
        ctx.params = {name: _expand(value) for name, value in ctx.params.items()}
        try:
            check_address_space()
            keep_freed_memory()
            try:
                return super().invoke(ctx)
            except EOFError as error:  # click takes it for an interruption by the user
                raise RuntimeError("unexpected end of a file") from error
        except Exception as error:
            # infer prints its list itself, with what it has done until then.
            if ctx.params.get("as_json") and ctx.info_name != INFER and not isinstance(error, typer.Exit | typer.Abort):
                print(json.dumps(error_document(error), indent=2))
            raise

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return what a word may become, each with a line of help: shells take a second line for another word."""
        items = super().shell_complete(ctx, incomplete)
        for item in items:
            item.help = textwrap.shorten(item.help or "", HINT_WIDTH, placeholder=" ...")
        return items

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line, without the braces that Typer sets about arguments."""
        return [piece.translate({ord(brace): None for brace in "{}"}) for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the arguments, then of the options, panel by panel."""
        panels = help_panels(self, ctx)
        longest = min(max(len(term) for rows in panels.values() for term, _ in rows), TERM_WIDTH)
        for title, rows in panels.items():
            with formatter.section(title):
                # All panels have their texts in one column.
                formatter.write_dl([(term.ljust(longest), meaning) for term, meaning in rows], TERM_WIDTH)


class Group(TyperGroup):
    """The commands, each with the whole first sentence of its help."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of the commands."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        rows = [(name, command.get_short_help_str(limit=1000)) for name, command in commands if command]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def help_panels(command: Any, context: Any) -> dict[str, list[tuple[str, str]]]:
    """Return the title of each panel of a command's help and its rows: names, and what they mean."""
    arguments, options = [], {}
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is None:
            continue
        term, meaning = record
        if parameter.param_type_name == "argument":
            # The record has the Python type beside the name.
            arguments.append((str(parameter.metavar or parameter.name), _tidy(meaning.removesuffix("[required]"))))
        else:
            long_name = max(parameter.opts, key=len)
            options[long_name] = (term, _tidy(meaning))
    panels = sort_into_panels(context.info_name, list(options))
    rows = {title: [options[name] for name in names] for title, names in panels.items()}
    return {ARGUMENTS: arguments, **rows} if arguments else rows


def sort_into_panels(command: str, options: list[str]) -> dict[str, list[str]]:
    """Return the title of each panel and those of the options (their long names) that stand in it."""
    panels = {
        title: [f"--{name}" for name in names.split() if f"--{name}" in options]
        for title, names in PANELS.get(command, {}).items()
    }
    named = {name for names in panels.values() for name in names}
    panels[OTHERS] = [name for name in options if name not in named]
    return {title: names for title, names in panels.items() if names}


def _tidy(meaning: str) -> str:
    """Return a help text without the ranges of numbers that click adds ("[x>=1]")."""
    meaning = re.sub(rf"\s*\[{_RANGE}\]$", "", meaning)
    return " ".join(re.sub(rf"; {_RANGE}\]$", "]", meaning).split())


def _expand(value: Any) -> Any:
    """Return a value with `~` and `~user` at the beginning of a text or path replaced by the home folder."""
    if isinstance(value, str | Path) and not isinstance(value, Enum):
        return type(value)(os.path.expanduser(value))  # noqa: PTH111 - Path.expanduser raises for an unknown user
    if isinstance(value, list | tuple):
        return type(value)(_expand(item) for item in value)
    return value


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
