"""The seconds that `infer` spends on each stage of a capture."""

import time

STAGES = ("read", "check", "distil", "estimate", "indirect_light", "refine", "pictures", "surface", "write")
"""The stages, in their order, but for page.html: it is one of the pictures, and comes after the surface."""


class Clock:
    """Adds up the seconds of stages, each of which ends where the next one begins. The first is reading."""

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)
        self._stage, self._since = STAGES[0], time.perf_counter()

    def begin(self, stage: str) -> None:
        """End the current stage and begin one of STAGES."""
        now = time.perf_counter()
        self._seconds[self._stage] += now - self._since
        self._stage, self._since = stage, now

    def seconds(self) -> dict[str, float]:
        """Return the seconds of each stage so far, and of all together as `total`."""
        self.begin(self._stage)
        return {stage: round(seconds, 3) for stage, seconds in self._seconds.items()} | {
            "total": round(sum(self._seconds.values()), 3)
        }
