"""What the pipeline reports while it works. The command line turns it into lines and progress bars."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Advance(Protocol):
    """Move the progress of a stage by `amount`; `note` is a short text to show beside it."""

    def __call__(self, amount: float, note: str = "") -> None: ...


class Observer:
    """Receives messages, warnings and progress. This base class ignores them all.

    A subclass overrides what it wants to show.
    """

    def say(self, message: str) -> None:
        """Receive a message for the user."""

    def warn(self, message: str) -> None:
        """Receive a warning: the results may be worse than they could be."""

    def error(self, message: str) -> None:
        """Receive an error: one of several inputs cannot be used, and the work goes on without it."""

    @contextmanager
    def progress(self, label: str, total: float, *, start: float = 0.0, unit: str = "") -> Iterator[Advance]:
        """Begin a stage of `total` steps, of which `start` are done. Yields the function that counts steps.

        `unit` is what the steps are, such as pixels, where their number in a second tells something.
        """
        yield lambda amount, note="": None


SILENT = Observer()
