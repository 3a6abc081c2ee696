"""What the commands say besides their product: messages and progress, on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager


class Talk:
    """Messages on stderr; `quiet` keeps all of them back. Progress bars show only on a terminal."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet = quiet

    def say(self, message: str) -> None:
        """A line for people."""
        if not self.quiet:
            print(message, file=sys.stderr)

    def warn(self, message: str) -> None:
        """A line that says something may be wrong."""
        self.say(f"splinecli: warning: {message}")

    def table(self, rows: Sequence[Sequence[str]]) -> None:
        """A table for people: a header row, then rows whose first cell is a name and whose others are numbers."""
        if self.quiet:
            return
        from rich.console import Console
        from rich.table import Table

        header, *body = rows
        table = Table(box=None, pad_edge=False)
        for position, name in enumerate(header):
            table.add_column(name, justify="right" if position else "left")
        for row in body:
            table.add_row(*row)
        Console(stderr=True, markup=False, highlight=False).print(table)

    @contextmanager
    def progress(self, label: str, total: float, *, start: float = 0.0) -> Iterator[Callable[..., None]]:
        """A progress bar with the time left; `advance(amount, note="")`, which it yields, moves it."""
        if self.quiet or not sys.stderr.isatty():
            yield lambda amount, note="": None
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:3.0f}%"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(label, total=total, note="")
            bar.update(task, completed=start)

            def advance(amount: float, note: str = "") -> None:
                bar.update(task, advance=amount)
                if note:
                    bar.update(task, note=note)

            yield advance
