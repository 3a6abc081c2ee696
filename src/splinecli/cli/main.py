"""The Typer app and the entry point, which turns every error into an exit code.

Importing this module must stay fast.
"""

from __future__ import annotations

import inspect
import io
import json
import logging
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from enum import Enum
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TextIO, get_origin, get_type_hints

import typer
from msgspec import NODEFAULT
from msgspec.structs import fields
from typer import Argument, Context
from typer import Option as TyperOption
from typer.core import TyperCommand, TyperGroup

from splinecli._version import __version__
from splinecli.cli.commands import calibrate, evaluate, import_weights, integrate, prepare, train
from splinecli.cli.console import (
    DEFECT,
    Messages,
    ParserError,
    error_document,
    explain,
    print_lines,
    printed_documents,
)
from splinecli.cli.help import write_help
from splinecli.cli.infer import infer, info, watch
from splinecli.cli.signals import INTERRUPTED, TOLD
from splinecli.errors import UsageError
from splinecli.records.base import (
    PANELS,
    Option,
    Record,
    choices_of,
    complete_list,
    field_types,
    long_name,
    number_of,
    option_of,
    plain,
)
from splinecli.system.machine import check_address_space, keep_freed_memory


def command(function: Callable[..., int | None], module: str) -> Callable[..., int | None]:
    """Return a function for Typer that accepts the options of a function's records.

    It calls the function with the records. The module that defines them is imported here, so that
    it does not slow down the help of other commands.
    """
    kinds = get_type_hints(function, localns=vars(import_module(module)))
    del kinds["return"]
    records = {name: kind for name, kind in kinds.items() if kind is not Context}
    options = [option for record in records.values() for option in _options(record)]
    options.sort(key=lambda option: PANELS.index(option[1].panel))
    parameters = [_parameter(*option) for option in options]
    if len(records) < len(kinds):
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter("context", keyword, annotation=Context))

    def call(**given: Any) -> int | None:
        made = {name: record.from_arguments(given) for name, record in records.items()}
        return function(**given, **made)

    call.__name__, call.__doc__ = function.__name__, help_of(function)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return call


def help_of(function: Callable[..., object]) -> str:
    """Return the text of a function's docstring, with each paragraph on one line."""
    paragraphs = inspect.cleandoc(function.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(text.split()) for text in paragraphs)


def _options(record: type[Record]) -> Iterator[tuple[str, Option, Any, Any]]:
    """Yield the name, option, annotation and default of each field that has an option."""
    defaults = {field.name: field.default for field in fields(record)}
    for name, kind in field_types(record).items():
        option = option_of(kind)
        if option is not None:
            yield name, option, kind, defaults[name]
        elif isinstance(kind, type) and issubclass(kind, Record):
            yield from _options(kind)


def _parameter(name: str, option: Option, kind: Any, default: Any) -> inspect.Parameter:
    """Return Typer's parameter for a field. Record.from_arguments converts texts to numbers and
    lists.
    """
    typed, metavar, complete = plain(kind), option.metavar, option.complete
    choices, repeated = choices_of(kind), get_origin(typed) is list and not option.items
    if choices:
        metavar, complete = metavar or "|".join(choices), choices
    elif option.items:
        complete = complete_list(option.items)
    if choices or option.items or option.parse or number_of(kind):
        typed = list[str] if repeated else str
    if default is NODEFAULT:
        default = inspect.Parameter.empty
    elif isinstance(default, tuple):
        default = (list(map(str, default)) if repeated else ",".join(default)) or None
    elif default is not None and not isinstance(default, bool):
        default = str(default)
    if default is None:
        typed = typed | None
    if complete is not None and not callable(complete):
        complete = _offer(complete)
    # By default, Typer rejects an unreadable path, so one such capture would end a batch.
    shared: dict[str, Any] = {
        "metavar": metavar,
        "help": option.help,
        "autocompletion": complete,
        "readable": False,
    }
    info: Any
    if option.is_argument:
        info = Argument(show_default=False, **shared)
    else:
        names, shown = option.names.split() or [long_name(name, option)], option.default or True
        info = TyperOption(*names, show_default=shown, rich_help_panel=option.panel, **shared)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[typed, info]
    )


def _offer(names: Collection[str]) -> Callable[[], list[str]]:
    return lambda: list(names)


# The command whose JSON output is a list of documents, and the option for JSON output
INFER, JSON = "infer", "--json"

_MODULES: dict[str, tuple[Callable[..., int | None], ...]] = {
    "pipeline.infer_options": (infer, watch, info),
    "pipeline.options": (calibrate, integrate, evaluate),
    "workshop.options": (prepare, train, import_weights),
}
COMMANDS = {
    each.__name__.replace("_", "-"): (each, f"splinecli.{module}")
    for module, functions in _MODULES.items()
    for each in functions
}
"""Maps names of commands to their functions and the modules that declare their options."""


class Command(TyperCommand):
    """A command that expands `~` in its arguments and creates its options on demand.

    With --json, a command that fails also prints a document on stdout: {"error", "exit_code"}.
    """

    @cached_property
    def _made(self) -> Any:
        alone = typer.Typer(add_completion=False)
        alone.command()(command(*COMMANDS[str(self.name)]))
        return typer.main.get_command(alone)

    def __getattribute__(self, name: str) -> Any:
        """Return an attribute. The options are created on demand, because their imports are
        slow.
        """
        own = self._made if name in ("params", "callback") else super()
        return own.__getattribute__(name)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, and add the context to parser errors, so that messages name the
        command.
        """
        # The parser will remove them from the list.
        wants_json, wants_lines = JSON in args, "--jsonl" in args
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

        def run() -> Any:
            try:
                Path.cwd()
            except FileNotFoundError:
                problem = "the current folder was removed"
                raise UsageError(problem, hint="Change to another folder") from None
            try:
                return super(Command, self).invoke(ctx)
            except EOFError as error:  # click treats it as an interruption by the user
                raise RuntimeError("unexpected end of a file") from error

        try:
            check_address_space()
            keep_freed_memory()
            if ctx.info_name != INFER:
                return run()
            with printed_documents(
                as_list=ctx.params["as_json"], as_lines=ctx.params["as_json_lines"]
            ) as ctx.obj:
                return run()
        except Exception as error:
            if (
                ctx.params.get("as_json")
                and ctx.info_name != INFER
                and not isinstance(error, typer.Exit | typer.Abort)
            ):
                print(json.dumps(error_document(error), indent=2))
            raise

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return the completions of a word, each with one line of help.

        Shells would treat a second line as another word.
        """
        items = super().shell_complete(ctx, incomplete)
        for item in items:  # Typer wraps the help of an option at 80 columns
            item.help = textwrap.shorten(item.help or "", 72, placeholder=" ...")
        return items

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line, without the braces that Typer adds."""
        return [re.sub("[{}]", "", piece) for piece in super().collect_usage_pieces(ctx)]

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option --help, which is shown in the panel of the output."""
        option: Any = super().get_help_option(ctx)
        option.rich_help_panel, option.metavar = "Output", ""
        return option

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help by panels, with examples."""
        write_help(self, ctx, formatter)


def _expand(value: Any) -> Any:
    if isinstance(value, str | Path) and not isinstance(value, Enum):
        return type(value)(os.path.expanduser(value))  # noqa: PTH111 - Path.expanduser raises for an unknown user
    if isinstance(value, list | tuple):
        return type(value)(_expand(item) for item in value)
    return value


class Commands(TyperGroup):
    """The `splinecli` command itself."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help in the same form as for each command."""
        write_help(self, ctx, formatter)


app = typer.Typer(
    name="splinecli",
    cls=Commands,
    help="Surface normals from a few photographs under known lights (photometric stereo with"
    " SPLINE-Net).",
    epilog="Exit codes: 0 done, 1 defect, 2 usage, 3 bad input, 4 weights or configuration, 5"
    " output, 130 interrupted.",
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
        bool,
        typer.Option(
            "--version", help="Print the version and exit.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    pass


for _name, (_function, _) in COMMANDS.items():
    app.command(name=_name, help=help_of(_function), cls=Command)(lambda: None)


def main(args: Sequence[str] | None = None) -> int:
    """Run `splinecli ARGS` and return the exit code (see docs/files-and-frames.md)."""
    _repair_streams()
    # By default, PyTorch's threads spin while they wait for each other, which takes cores from the
    # computing thread if the machine is busy. PyTorch reads the variable when it is first imported.
    if "GOMP_SPINCOUNT" not in os.environ:
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    logging.disable()  # logs of libraries, such as Dask, are not meant for users
    # Work.enter already checks the versions on workers
    warnings.filterwarnings("ignore", module="distributed")
    out, err = UntilClosed(sys.stdout), UntilClosed(_apart(sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        code = _run_command(args)
        out.flush()
    return code


def _run_command(args: Sequence[str] | None) -> int:
    command, messages = typer.main.get_command(app), Messages(quiet=False)
    try:
        result = command.main(
            args=None if args is None else list(args), prog_name="splinecli", standalone_mode=False
        )
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
    """A text stream that discards all output once its pipe is closed.

    With a plain stream, the next line that a command prints would raise an error and end the
    command.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._mute()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._mute()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _mute(self) -> None:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)


def _repair_streams() -> None:
    """Repair streams that are closed (`>&-`) or cannot encode every character (an ASCII locale)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - for the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _apart(stream: TextIO) -> TextIO:
    """Return the stream stderr with a separate file descriptor.

    Descriptor 2 is redirected while an image is decoded, because C libraries print there (see
    native_stderr). With a separate descriptor, other threads can print in the meantime.
    """
    if not isinstance(stream, io.TextIOWrapper) or stream.fileno() != 2:
        return stream
    stream.flush()
    try:
        own = os.fdopen(os.dup(2), "wb", buffering=0)
    except OSError:  # too many open files, which the command will report
        return stream
    return io.TextIOWrapper(
        own, stream.encoding, stream.errors, line_buffering=True, write_through=True
    )
