"""Kill every command while it replaces earlier output: `python tests/faults/kill_commands.py
--kills 200`.

A kill comes before a change of a file, or at a random time. After it,

- every file is whole: it is that of the earlier run or of the new one;
- the files are all of one run, or the folder has no report;
- after the next start has locked the folder, it has no hidden file.

Then the same command runs again, and must end with the same files as an undisturbed run. An
undisturbed run must also sync every file before it renames it.
"""

import argparse
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / "fuzz"), str(Path(__file__).parents[1])]

from run import prepare_process, run_warm  # noqa: E402

from kills import changes_files, content, killer, missing_syncs, record_calls  # noqa: E402

_MEASURED = re.compile(rb'("(?:seconds|peak_memory_mib|minutes)\\?": ?)(?:[\d.e-]+|{[^}]*})')


@dataclass(frozen=True)
class Replacement:
    """A command that replaces what another one wrote."""

    target: str  # the input, one of the fuzz corpus
    old: str  # the commands
    new: str
    folder: str = "out"  # the folder that the command holds
    # the file that describes the others. None if files are replaced one by one
    report: str | None = "report.json"


_INFER = "infer capture --method ls -o out --overwrite -q"
_CALIBRATE = "calibrate ball -o out --overwrite -q"
_INTEGRATE = "integrate n.npy -o out --overwrite -q --format"
_EVALUATE = "evaluate capture --method ls --n-lights 4 -o out -q --trials"
_PREPARE = "prepare -o out/set -q"
_INFO = "info --plot out/p.png -q"
_TRAIN = "train set -o out/run -q --config a.toml"
REPLACEMENTS = {
    "infer": Replacement(
        "earlier", _INFER, f"{_INFER} --format png8,tiff --maps preview", "out/capture"
    ),
    "calibrate": Replacement(
        "ball", f"{_CALIBRATE} --gray-ball gray", _CALIBRATE, report="calibration.json"
    ),
    "integrate": Replacement(
        "normals", f"{_INTEGRATE} ply,npy", f"{_INTEGRATE} obj,npy", report="surface.json"
    ),
    "evaluate": Replacement(
        "earlier", f"{_EVALUATE} 1", f"{_EVALUATE} 2 --n-lights 5", report="results.json"
    ),
    "prepare": Replacement(
        "earlier", f"{_PREPARE} capture", f"{_PREPARE} capture more", "out/set", "manifest.json"
    ),
    "info": Replacement("earlier", f"{_INFO} capture", f"{_INFO} more --overwrite", report=None),
    "train": Replacement("training", _TRAIN, f"{_TRAIN} --resume --steps 3", "out/run", None),
}


class KilledCommand:
    """A replacement, ready to be killed again and again."""

    def __init__(self, name, work):
        """Write the input, and run both commands undisturbed."""
        from corpus import TARGETS

        self.replacement = REPLACEMENTS[name]
        self.case, self.start = work / name / "case", work / name / "start"
        self.case.mkdir(parents=True)
        target = next(target for target in TARGETS if target.name == self.replacement.target)
        target.write(self.case)
        if target.name == "earlier":
            shutil.copytree(self.case / "capture", self.case / "more")
            (self.case / "more" / "filenames.txt").unlink()
        # In the place where it is replaced, because reports and checkpoints name absolute paths.
        assert run_warm(self.case, self.replacement.old) == 0
        shutil.copytree(self.case, self.start)
        self.seconds = self._run_again()
        if name == "evaluate":  # what was scored is kept, so that all runs have the same seconds
            shutil.copy(self.case / "out/trials.jsonl", self.start / "out/trials.jsonl")
        self.old, self.new = self._state(self.start), self._state(self.case)
        self.kill_count = self.new_count = 0

    def kill(self, step=None, seconds=None):
        """Kill the command at a step or after some time, and yield what is wrong afterwards."""
        from splinecli.system.publishing import held_folder

        self._reset()
        child = os.fork()
        if child == 0:
            if step is not None:
                sys.addaudithook(killer(step))
            os._exit(run_warm(self.case, self.replacement.new))
        if seconds is not None:
            time.sleep(seconds)
            os.kill(child, signal.SIGKILL)
        was_killed = os.WIFSIGNALED(os.waitpid(child, 0)[1])
        self.kill_count += was_killed  # a run may end before its time
        if not was_killed and self._state(self.case) != self.new:
            yield "a run that was not killed ends with other files"
        if (self.case / self.replacement.folder).exists():
            with held_folder(self.case / self.replacement.folder):
                pass
        after = self._state(self.case)
        self.new_count += after == self.new
        yield from self._problems(after)
        self._run_again()
        after = self._state(self.case)
        if (
            self.replacement.target == "normals"
        ):  # the lost report named the earlier files that were to go
            after = {
                name: value
                for name, value in after.items()
                if name in self.new or value != self.old.get(name)
            }
        if after != self.new:
            yield "the next run ends with other files"

    def missing_syncs(self):
        """Yield what an undisturbed run renames before it is on the disk."""
        self._reset()
        yield from missing_syncs(record_calls(self._run_again), self.replacement.report)

    def count_steps(self):
        """Return the number of changes of files in an undisturbed run."""
        self._reset()
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            count = 0

            def counted(event, args):
                nonlocal count
                count += changes_files(event, args)

            sys.addaudithook(counted)
            run_warm(self.case, self.replacement.new)
            os.write(writer, str(count).encode())
            os._exit(0)
        os.waitpid(child, 0)
        os.close(writer)
        count = int(os.read(reader, 100))
        os.close(reader)
        return count

    def _problems(self, state):
        """Yield what is wrong with the files after a kill."""
        if self.replacement.folder == "out/set" and b'"complete": false' in state.get(
            "set/manifest.json", b""
        ):
            return  # a pixel set says itself that it is not finished
        for name, value in state.items():
            if value not in (self.old.get(name), self.new.get(name)):
                yield f"{name} is neither the old file nor the new one"
        if self.replacement.report is None:
            return
        report = (
            (Path(self.replacement.folder) / self.replacement.report).relative_to("out").as_posix()
        )
        wholes = [whole for whole in (self.old, self.new) if whole.get(report) == state.get(report)]
        # A set that is being added to may have files that its manifest does not name yet.
        if report in state and not any(whole.items() <= state.items() for whole in wholes):
            yield f"a report of a mixture of {sorted(state)}"

    def _reset(self):
        shutil.rmtree(self.case, ignore_errors=True)
        shutil.copytree(self.start, self.case)

    def _run_again(self):
        started = time.monotonic()
        command = self.replacement.new
        assert run_warm(self.case, command) == 0, command
        return time.monotonic() - started

    def _state(self, folder):
        """Return the content of the output by name, without what differs from run to run, such as
        times and memory.
        """
        files = content(folder / "out")
        files.pop("run/metrics.csv", None)
        for name in (name for name in files if name.endswith("checkpoint.safetensors")):
            # the seconds change the length of its header
            end = 8 + int.from_bytes(files[name][:8], "little")
            files[name] = files[name][8:end].rstrip() + files[name][end:]
        return {name: _MEASURED.sub(rb"\1", value) for name, value in files.items()}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--kills", type=int, default=200, help="kills at random times, beside those at every step"
    )
    parser.add_argument(
        "--steps", type=int, help="kill at so many of the steps only, evenly chosen"
    )
    options = parser.parse_args()
    prepare_process()
    rng, failed, kills = random.Random(0), list[str](), 0
    with tempfile.TemporaryDirectory() as work:
        for name in REPLACEMENTS:
            command = KilledCommand(name, Path(work))
            failed += [f"{name}: {problem}" for problem in command.missing_syncs()]
            total = command.count_steps()
            steps = sorted(
                {
                    int(step)
                    for step in np.linspace(0, total - 1, min(total, options.steps or total))
                }
            )
            for step in steps:
                failed += [f"{name}, step {step}: {problem}" for problem in command.kill(step=step)]
            for _ in range(options.kills // len(REPLACEMENTS)):
                seconds = rng.uniform(0, 1.1 * command.seconds)
                failed += [
                    f"{name}, {seconds:.3f} s: {problem}"
                    for problem in command.kill(seconds=seconds)
                ]
            kills += command.kill_count
            told = (
                f"{command.kill_count} kills, at {len(steps)} of {total} steps and at random times"
            )
            print(f"{name}: {told}; {command.new_count} ended in the new files", flush=True)
    print(*failed, f"{kills} kills, {len(failed)} failed", sep="\n")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
