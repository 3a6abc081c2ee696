"""Output for users and programs: reports, messages, tables and progress.

Each error becomes one message and an exit code and, with JSON output, also a document. The class
names of Typer's and click's parser errors, such as an unknown option or a word instead of a number,
differ between versions. Therefore, only the attributes of these errors are used, and an error
without a known attribute keeps its text.
"""

import json
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import typer

from splinecli.errors import SplinecliError, UsageError, printable
from splinecli.records.base import listed
from splinecli.system.files import as_splinecli_error
from splinecli.system.machine import is_out_of_memory
from splinecli.system.progress import Advance, Observer, ignore

# message of unexpected errors
DEFECT = "this is a defect of splinecli; please report it with the lines above."
# The base class of click's usage errors. Typer includes its own copy of click, whose location
# depends on the version.
ParserError: type[Exception] = typer.BadParameter.__mro__[1]
# Click's messages as regular expressions, and their replacements
_SYNTAX = (
    (r"^Option '(.+)' requires an argument\.?$", r"\1 needs a value"),
    (r"^Option '(.+)' does not take a value\.?$", r"\1 does not take a value"),
    (r"^Missing argument '(.+)'\.?$", r"\1 is missing"),
    (r"^Missing option '([^']+)'.*$", r"\1 is missing"),
    (r"^Missing command\.?$", "a command is missing"),
    (r"^Got unexpected extra arguments?(?:\(s\))? \((.+)\)$", r"unexpected arguments: \1"),
)
# Options of earlier versions
RENAMED = {"--stiffness": "--discontinuity", "--lights-format": "--light-format"}


def explain(error: Exception) -> tuple[str, int]:
    """Return the message of an error that ends a command, and its exit code."""
    if isinstance(error, SplinecliError):
        return str(error), error.exit_code
    if isinstance(error, ParserError):
        return _usage_message(error), UsageError.exit_code
    if is_out_of_memory(error):
        problem = "there is not enough memory. Close other programs, or use smaller images."
        return problem, SplinecliError.exit_code
    if isinstance(error, OSError):
        return explain(as_splinecli_error(error))
    return DEFECT, SplinecliError.exit_code


def error_document(error: Exception) -> dict[str, Any]:
    """Return {"error", "exit_code"}, which is printed instead of a report."""
    message, exit_code = explain(error)
    return {"error": message, "exit_code": exit_code}


@contextmanager
def printed_documents(
    *, as_list: bool, as_lines: bool
) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield a function that prints a document of `infer` as soon as its capture is finished.

    Each document is printed on a line of its own, or as an item of a list. If an error ends the
    command, its document comes last.
    """
    is_empty = True

    def add(document: dict[str, Any]) -> None:
        nonlocal is_empty
        if as_lines:
            print(json.dumps(document), flush=True)
        elif as_list:
            item = textwrap.indent(json.dumps(document, indent=2), "  ")
            print("[\n" if is_empty else ",\n", item, sep="", end="", flush=True)
        is_empty = False

    try:
        yield add
    except Exception as error:
        add({"capture": None, **error_document(error)})
        raise
    finally:
        if as_list and not as_lines:
            print("[]" if is_empty else "\n]")


def _usage_message(error: Any) -> str:
    """Return the message for a usage error from click, with a reference to the help."""
    context = getattr(error, "ctx", None)
    where = context.command_path if context else "splinecli"
    text = _unknown_name(error) or error.format_message()
    for pattern, words in _SYNTAX:
        text = re.sub(pattern, words, text)
    end = "" if text.endswith("?") else "."
    return f"{text.rstrip('.')}{end} See '{where} --help'."


def _unknown_name(error: Any) -> str | None:
    def suggestion(names: list[str]) -> str:
        return f" Did you mean {listed(names)}?" if any(names) else ""

    text = error.format_message()
    option = getattr(error, "option_name", None)
    if option in RENAMED:
        return f"{option} is now {RENAMED[option]}."
    if option and hasattr(error, "possibilities"):
        return f"no option {option}.{suggestion((error.possibilities or [])[:1])}"
    command = re.match(r"No such command ('.*?')\.?(?: Did you mean (.*?))?\??$", text)
    return (
        f"no command {command[1]}.{suggestion((command[2] or '').strip('?').split(', '))}"
        if command
        else None
    )


_LEAST_DONE = 0.05  # share of the work after which the remaining time is shown
LINE_SECONDS = 30.0  # time between two progress lines if stderr is not a terminal


def print_report(report: dict[str, Any], *lines: str, as_json: bool, quiet: bool) -> None:
    """Print a report on stdout: as JSON, or as lines of text unless `quiet`."""
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        for line in lines:
            print(printable(line))


def print_lines(text: str) -> None:
    """Print a text of several lines, such as a traceback, on stderr."""
    for line in text.rstrip("\n").split("\n"):
        print(printable(line), file=sys.stderr)


class Messages(Observer):
    """Prints messages on stderr or, with `quiet`, only errors.

    On a terminal, progress is shown as a bar; elsewhere, one line is printed every LINE_SECONDS.
    """

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet
        self._warned = set[str | None]()

    def say(self, message: str) -> None:
        if not self.quiet:
            print(printable(message), file=sys.stderr)

    def warn(self, message: str, *, once: str | None = None, again: str = "") -> None:
        if once is not None and once in self._warned:
            message = again
        if message:
            self.say(f"splinecli: warning: {message}")
        self._warned.add(once)

    def error(self, message: str) -> None:
        print(f"splinecli: {printable(message)}", file=sys.stderr)  # also with `quiet`

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """Print a table that consists of a header row and rows with a name and numbers."""
        if self.quiet:
            return
        from rich.console import Console
        from rich.table import Table

        header, *body = rows
        table = Table(box=None, pad_edge=False)
        for position, name in enumerate(header):
            table.add_column(name, justify="right" if position else "left")
        for row in body:
            table.add_row(*(printable(cell) for cell in row))
        Console(stderr=True, markup=False, highlight=False).print(table)

    @contextmanager
    def progress(
        self, label: str, total: float, *, start: float = 0.0, unit: str = ""
    ) -> Iterator[Advance]:
        if self.quiet:
            yield ignore
        elif sys.stderr.isatty():
            with _bar(label, total, start, unit) as advance:
                yield advance
        else:
            yield self._lines(label, total, start, unit)

    def _lines(self, label: str, total: float, start: float, unit: str) -> Advance:
        done = start
        began = shown = time.monotonic()

        def advance(amount: float, note: str = "") -> None:
            nonlocal done, shown
            done += amount
            now = time.monotonic()
            if now - shown >= LINE_SECONDS and done < total:
                shown = now
                speed = (done - start) / (now - began)
                notes = [_in_words(speed, unit)] if unit else []
                known = done - start >= _LEAST_DONE * (total - start)
                notes += [f"{(total - done) / speed:.0f} s left"] if known else []
                self.say(
                    ", ".join(
                        (f"{label}: {100 * done / total:.0f} %", *notes, *filter(None, [note]))
                    )
                )

        return advance


def _in_words(speed: float, unit: str) -> str:
    return f"{speed:,.0f} {unit}/s" if speed >= 10 else f"{speed:.2g} {unit}/s"


@contextmanager
def _bar(label: str, total: float, start: float, unit: str) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, Task, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class TimeLeft(TimeRemainingColumn):
        def render(self, task: Task) -> Text:
            if task.completed - start < _LEAST_DONE * (total - start):
                return Text("-:--:--", style="progress.remaining")
            return super().render(task)

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeLeft(),
        TextColumn("{task.fields[speed]}", markup=False),
        TextColumn("{task.fields[note]}", markup=False),
    )
    # Summaries for a file or a pipe must not be redirected to the progress bar's stream.
    own = sys.stdout.isatty()
    with Progress(
        *columns, console=Console(stderr=True), transient=True, redirect_stdout=own
    ) as bar:
        task = bar.add_task(printable(label), total=total, note="", speed="")
        bar.update(task, completed=start)

        def advance(amount: float, note: str = "") -> None:
            bar.update(task, advance=amount)
            if unit and (speed := bar.tasks[0].speed):
                bar.update(task, speed=_in_words(speed, unit))
            if note:
                bar.update(task, note=note)

        yield advance
