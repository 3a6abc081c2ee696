"""Kill every command while it replaces earlier output: `python tests/faults/kill_commands.py --kills 200`.

A kill comes before a change of a file, or at a random time. Afterwards the folder is put in order, as the next start
does. It must then hold the earlier files or the new ones, and nothing else. Then the same command runs again, and must
end with the same files as an undisturbed run.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / "fuzz"), str(Path(__file__).parents[1])]

from run import prepare_process, run_warm  # noqa: E402

from kills import changes_files, content  # noqa: E402

_MEASURED = re.compile(rb'("(?:read|estimate|write|seconds|peak_memory_mib|minutes)": ?)[\d.]+')


@dataclass(frozen=True)
class Replacement:
    """A command that replaces what another one wrote.

    Args:
        target: the input, one of the fuzz corpus.
        old, new: the commands.
        folder: the folder that the command holds.
        as_set: whether the files are replaced as a set. Those of a run are replaced one by one.
    """

    target: str
    old: str
    new: str
    folder: str = "out"
    as_set: bool = True


_INFER = "infer capture --method ls -o out --overwrite -q"
_CALIBRATE = "calibrate ball -o out --overwrite -q"
_INTEGRATE = "integrate n.npy -o out --overwrite -q"
_EVALUATE = "evaluate capture --method ls --n-lights 4 -o out -q"
_TRAIN = "train set -o out/run -q --config a.toml"
REPLACEMENTS = {
    "infer": Replacement("earlier", _INFER, f"{_INFER} --format png8,tiff --maps preview", "out/capture"),
    "calibrate": Replacement("ball", f"{_CALIBRATE} --gray-ball gray", _CALIBRATE),
    "integrate": Replacement("normals", f"{_INTEGRATE} --format ply,npy", f"{_INTEGRATE} --format obj,npy"),
    "evaluate": Replacement("earlier", f"{_EVALUATE} --trials 1", f"{_EVALUATE} --trials 2 --n-lights 5"),
    "prepare": Replacement(
        "earlier", "prepare capture -o out/set -q", "prepare capture more -o out/set -q", "out/set"
    ),
    "info": Replacement(
        "earlier",
        "info capture --plot out/p.png -q",
        "info more --plot out/p.png --overwrite -q",
        as_set=False,
    ),
    "train": Replacement("training", _TRAIN, f"{_TRAIN} --resume --steps 3", "out/run", as_set=False),
}


class KilledCommand:
    """A replacement, ready to be killed again and again."""

    def __init__(self, name: str, work: Path) -> None:
        """Write the input, and run both commands undisturbed."""
        from corpus import TARGETS

        self.replacement = REPLACEMENTS[name]
        self.case, self.start = work / name / "case", work / name / "start"
        self.start.mkdir(parents=True)
        target = next(target for target in TARGETS if target.name == self.replacement.target)
        target.write(self.start)
        if target.name == "earlier":
            shutil.copytree(self.start / "capture", self.start / "more")
            (self.start / "more" / "filenames.txt").unlink()
        assert run_warm(self.start, self.replacement.old) == 0
        self._reset()
        self.seconds = self._run_again()
        if name == "evaluate":  # what was scored is kept, so that all runs have the same seconds
            shutil.copy(self.case / "out/trials.jsonl", self.start / "out/trials.jsonl")
        self.old, self.new = self._state(self.start), self._state(self.case)
        self.new_count = 0

    def kill(self, step: int | None = None, seconds: float | None = None) -> Iterator[str]:
        """Kill the command at a step or after some time, and yield what is wrong afterwards."""
        from splinecli.publishing import held_folder

        self._reset()
        self.ended = not self._run_killed(step, seconds)
        if self.ended and self._state(self.case) != self.new:
            yield "a run that was not killed ends with other files"
        if (self.case / self.replacement.folder).exists():
            with held_folder(self.case / self.replacement.folder):
                pass
        after = self._state(self.case)
        self.new_count += after == self.new
        if self.replacement.as_set and after not in (self.old, self.new) and not self._is_unfinished(after):
            yield f"a mixture of {sorted(after)}"
        self._run_again()
        if self._state(self.case) != self.new:
            yield "the next run ends with other files"

    def _is_unfinished(self, state: dict[str, bytes]) -> bool:
        """A pixel set says itself that it is not finished."""
        return b'"complete": false' in state.get("set/manifest.json", b"")

    def _reset(self) -> None:
        shutil.rmtree(self.case, ignore_errors=True)
        shutil.copytree(self.start, self.case)

    def _run_again(self) -> float:
        started = time.monotonic()
        command = self.replacement.new
        assert run_warm(self.case, command) == 0, command
        return time.monotonic() - started

    def _run_killed(self, step: int | None, seconds: float | None) -> bool:
        child = os.fork()
        if child == 0:
            if step is not None:
                sys.addaudithook(_killer(step))
            os._exit(run_warm(self.case, self.replacement.new))
        if seconds is not None:
            time.sleep(seconds)
            os.kill(child, signal.SIGKILL)
        return os.WIFSIGNALED(os.waitpid(child, 0)[1])

    def _state(self, folder: Path) -> dict[str, bytes]:
        """Return the content of the output by name, without what differs from run to run: the log has minutes."""
        files = content(folder / "out").items()
        return {name: _MEASURED.sub(rb"\1", value) for name, value in files if name != "run/metrics.csv"}


def _killer(step: int):
    left = step

    def count(event: str, args: tuple[object, ...]) -> None:
        nonlocal left
        if changes_files(event, args):
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1

    return count


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--kills", type=int, default=200, help="kills at random times, beside those at every step"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", action="append", choices=REPLACEMENTS)
    options = parser.parse_args()
    prepare_process()
    rng, failures, kills = random.Random(options.seed), 0, 0
    names = options.command or list(REPLACEMENTS)
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            command, step, count = KilledCommand(name, Path(work)), 0, 0
            command.ended = False
            while not command.ended:
                problems = list(command.kill(step=step))
                step, count, failures = step + 1, count + 1, failures + bool(problems)
                for problem in problems:
                    print(f"{name}, step {step - 1}: {problem}")
            for _ in range(options.kills // len(names)):
                seconds = rng.uniform(0, 1.1 * command.seconds)
                problems = list(command.kill(seconds=seconds))
                count, failures = count + 1, failures + bool(problems)
                for problem in problems:
                    print(f"{name}, {seconds:.3f} s: {problem}")
            kills += count
            print(
                f"{name}: {count} kills, {step} of them at every step; {command.new_count} ended in the new files"
            )
    print(f"{kills} kills, {failures} failed")
    return bool(failures)


if __name__ == "__main__":
    sys.exit(main())
