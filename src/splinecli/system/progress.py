"""Progress of a long computation: finished pixels, messages, and the stages with their duration."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

# A function that is called with the amount of work just done, a number of pixels or a share of the
# total
Progress = Callable[[Any], object]


def ignore(*_: object, **__: object) -> None:
    """Show no progress."""


# The stages in order, except that page.html, which belongs to the pictures, is written after the
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


# The actual divided by the expected seconds of each stage, from this process's latest capture
_PACES: dict[str, float] = {}


class Advance(Protocol):
    """Advance the progress of a stage by `amount`. `note` is a short text shown next to the bar."""

    def __call__(self, amount: float, note: str = "") -> None: ...


class Clock:
    """A clock that adds up the seconds of each stage, and moves one progress bar from 0 to 1
    through all stages.

    A stage ends when the next one begins. The first stage is reading.
    """

    def __init__(self, show: Advance | None = None) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)
        self._stage, self._since = STAGES[0], time.perf_counter()
        self._show, self._shares, self._expected = show, dict[str, float](), dict[str, float]()
        # positions on the bar: now, and at the beginning and end of the stage
        self._shown = self._start = self._end = 0.0

    def expect(self, seconds: Mapping[str, float]) -> None:
        """Divide the rest of the bar among stages in proportion to their expected seconds,
        corrected by earlier clocks of this process.
        """
        self._expected |= seconds
        seconds = {stage: each * _PACES.get(stage, 1.0) for stage, each in seconds.items()}
        whole = sum(seconds.values()) / (1 - self._end)
        self._shares = {stage: each / whole for stage, each in seconds.items()}

    def begin(self, stage: str, steps: float = 1.0, note: str = "") -> Advance:
        """End the current stage, begin one of STAGES, and return a function that counts its steps.

        `note` is shown next to the bar.
        """
        now = time.perf_counter()
        self._seconds[self._stage] += now - self._since
        if stage != self._stage or stage in self._shares:  # else another part of this stage
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
        """Return the seconds of each stage so far, and their sum as `total`."""
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
    """Receiver of messages, warnings and progress that ignores them. Subclasses override the
    methods whose input they show.
    """

    def say(self, message: str) -> None:
        """Receive a message for the user."""

    def warn(self, message: str, *, once: str | None = None, again: str = "") -> None:
        """Receive a warning that the results may be less accurate than possible.

        Among warnings with the same keyword `once`, only the first needs to be shown in full;
        `again` is the text that replaces later ones.
        """

    def error(self, message: str) -> None:
        """Receive an error about one of several inputs, without which the work continues."""

    @contextmanager
    def progress(
        self, label: str, total: float, *, start: float = 0.0, unit: str = ""
    ) -> Iterator[Advance]:
        """Begin a stage of `total` steps, of which `start` are done, and yield the function that
        counts them.

        `unit` is the name of the steps, such as pixels, if their number per second is informative.
        """
        yield ignore


SILENT = Observer()
