"""What all commands share: help in panels, `~` in every path, and a JSON document also where a command fails."""

import json
import os
import re
import textwrap
from enum import Enum
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from splinecli.cli.failures import ParserError, error_document, printed_documents
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
        "Input": "mask crop scale ground-truth transfer ambient flat-field white-level",
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
        "Scenes": "scenes mesh size n-lights seed",
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
