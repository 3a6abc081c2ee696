"""Reports of a long computation: finished pixels, messages, stages and their seconds."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

# A function that is called with the amount of work that was just done: a number of pixels, or a
# share of the whole
Progress = Callable[[Any], object]


def ignore(*_: object, **__: object) -> None:
    """Show no progress."""


# The stages in order, except for page.html, which is one of the pictures but is written after the
# surface
STAGES = (
    "read",
    "check",
    "distil",
    "estimate",
    "indirect_light",
    "refine",
    "pictures",
    "surface",
    "write",
)


# The seconds of a stage over those that were expected, of this process's latest capture
_PACES: dict[str, float] = {}


class Advance(Protocol):
    """Move the progress of a stage by `amount`; `note` is a short text to show beside it."""

    def __call__(self, amount: float, note: str = "") -> None: ...


class Clock:
    """Adds up the seconds of stages, and moves one progress bar, from 0 to 1, through all stages.

    A stage ends where the next one begins. The first is reading.
    """

    def __init__(self, show: Advance | None = None) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)
        self._stage, self._since = STAGES[0], time.perf_counter()
        self._show, self._shares, self._expected = show, dict[str, float](), dict[str, float]()
        # places on the bar: now, and at the beginning and the end of the stage
        self._shown = self._start = self._end = 0.0

    def expect(self, seconds: Mapping[str, float]) -> None:
        """Divide the rest of the bar between stages by their expected seconds, which earlier clocks
        of this process correct.
        """
        self._expected |= seconds
        seconds = {stage: each * _PACES.get(stage, 1.0) for stage, each in seconds.items()}
        whole = sum(seconds.values()) / (1 - self._end)
        self._shares = {stage: each / whole for stage, each in seconds.items()}

    def begin(self, stage: str, steps: float = 1.0, note: str = "") -> Advance:
        """End the current stage and begin one of STAGES. Returns a function that counts its steps.

        `note` is shown beside the bar.
        """
        now = time.perf_counter()
        self._seconds[self._stage] += now - self._since
        if stage != self._stage or stage in self._shares:  # otherwise another part of the same
            self._start, self._end = self._end, self._end + self._shares.pop(stage, 0.0)
        self._stage, self._since = stage, now
        start, share, done = self._start, self._end - self._start, 0.0

        def advance(amount: float, note: str = note) -> None:
            nonlocal done
            done += amount
            self._move(start + share * min(done / steps, 1.0), note)

        advance(0.0)
        return advance

    def _move(self, place: float, note: str) -> None:
        if self._show is not None:
            self._show(max(0.0, place - self._shown), note)
            self._shown = max(place, self._shown)

    def seconds(self) -> dict[str, float]:
        """Return the seconds of each stage so far, and of all together as `total`."""
        now = time.perf_counter()
        self._seconds[self._stage] += now - self._since
        self._since = now
        for stage, expected in self._expected.items():
            if expected > 0 and self._seconds[stage] > 0:
                _PACES[stage] = self._seconds[stage] / expected
        return {stage: round(seconds, 3) for stage, seconds in self._seconds.items()} | {
            "total": round(sum(self._seconds.values()), 3)
        }


class Observer:
    """Receives messages, warnings and progress, and ignores them. A subclass overrides what it
    shows.
    """

    def say(self, message: str) -> None:
        """Receive a message for the user."""

    def warn(self, message: str, *, once: str | None = None, again: str = "") -> None:
        """Receive a warning: the results may be worse than they could be.

        Of several warnings with the same word `once`, the first one is enough; `again` is what the
        later ones add to it.
        """

    def error(self, message: str) -> None:
        """Receive an error: one of several inputs cannot be used,
        and the work continues without it.
        """

    @contextmanager
    def progress(
        self, label: str, total: float, *, start: float = 0.0, unit: str = ""
    ) -> Iterator[Advance]:
        """Begin a stage of `total` steps, of which `start` are done. Yields the function that
        counts steps.

        `unit` is the name of a step, such as pixels, if the number per second is informative.
        """
        yield ignore


SILENT = Observer()
