"""Printing: the reports of the commands on stdout; messages, warnings, tables and progress on stderr."""

import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from splinecli.errors import printable
from splinecli.system.progress import Advance, Observer

LINE_SECONDS = 30.0  # seconds between two lines of progress where stderr is not a terminal


def print_report(report: dict[str, Any], *lines: str, as_json: bool, quiet: bool) -> None:
    """Print a report on stdout: as JSON, or as lines of text unless `quiet`."""
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        for line in lines:
            print(printable(line))


def print_lines(text: str) -> None:
    """Print a text of several lines on stderr, such as a traceback."""
    for line in text.rstrip("\n").split("\n"):
        print(printable(line), file=sys.stderr)


class Messages(Observer):
    """Writes for people, on stderr. With `quiet` it writes nothing.

    On a terminal, progress is a bar. Elsewhere it is a line every LINE_SECONDS.
    """

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet

    def say(self, message: str) -> None:
        """Print a line."""
        if not self.quiet:
            print(printable(message), file=sys.stderr)

    def warn(self, message: str) -> None:
        """Print a line that begins with "splinecli: warning:"."""
        self.say(f"splinecli: warning: {message}")

    def error(self, message: str) -> None:
        """Print a line that begins with "splinecli:", with `quiet` as well."""
        print(f"splinecli: {printable(message)}", file=sys.stderr)

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """Print a table: a header row, then rows of a name and numbers."""
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
    def progress(self, label: str, total: float, *, start: float = 0.0, unit: str = "") -> Iterator[Advance]:
        """Show the progress of a stage; yields `advance(amount, note="")`, which moves it."""
        if self.quiet:
            yield lambda amount, note="": None
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
                notes = [_in_words(speed, unit), f"{(total - done) / speed:.0f} s left"] if unit else []
                self.say(", ".join((f"{label}: {100 * done / total:.0f} %", *notes, *filter(None, [note]))))

        return advance


def _in_words(speed: float, unit: str) -> str:
    return f"{speed:,.0f} {unit}/s" if speed >= 10 else f"{speed:.2g} {unit}/s"


@contextmanager
def _bar(label: str, total: float, start: float, unit: str) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:3.0f}%"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[speed]}", markup=False),
        TextColumn("{task.fields[note]}", markup=False),
    )
    # A summary that goes to a file or a pipe must not land in the bar's stream.
    own = sys.stdout.isatty()
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=own) as bar:
        task = bar.add_task(printable(label), total=total, note="", speed="")
        bar.update(task, completed=start)

        def advance(amount: float, note: str = "") -> None:
            bar.update(task, advance=amount)
            if unit and (speed := bar.tasks[0].speed):
                bar.update(task, speed=_in_words(speed, unit))
            if note:
                bar.update(task, note=note)

        yield advance
