"""Run splinecli on mutated inputs: `python tests/fuzz/run.py --cases 20000 --minutes 60`.

A case is decided by its seed alone: `--first N --cases 1` repeats case N. It passes if

- the exit code is documented, and no defect (1);
- a failure is told in one line on stderr, and a success writes no error;
- there is no traceback, no warning of Python, and no character that a terminal would obey;
- it takes less than 10 s of processor time and 1 GB of memory, or 300 MB if it fails;
- a failure leaves the earlier output as it was, and no run leaves unfinished files or locks.

The cases run one after another in a process that has imported everything, so each takes
milliseconds. If one kills the process or hangs, it fails, and another process takes the next.
"""

import argparse
import gc
import json
import os
import random
import resource
import select
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache, partial
from io import StringIO
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from corpus import OUT, write_corpus  # noqa: E402
from mutations import mutate, odd_path, rename  # noqa: E402

from kills import content  # noqa: E402
from splinecli.errors import printable  # noqa: E402

CPU_SECONDS, WALL_SECONDS, MEMORY, MEMORY_IF_REFUSED = 10, 300, 10**9, 300 * 2**20
ADDRESS_SPACE = 4 * 10**9
CASES_OF_A_PROCESS = 200
FAST = Path("/dev/shm")  # where files need no disk
DOCUMENTED = {0, 2, 3, 4, 5}


@dataclass(frozen=True)
class Ended:
    """What a process left: exit code (None if a signal ended it), texts, processor time, growth of
    memory in bytes.
    """

    code: int | None
    out: str
    err: str
    seconds: float
    memory: int


class Worker:
    """A forked process that runs commands, with stdout and stderr in files of a folder."""

    def __init__(self, folder):
        self._folder, self._left = folder, 0

    def run(self, folder, command):
        """Run a command in a folder."""
        if self._left == 0:
            self._start()
        self._left -= 1
        os.write(self._requests, json.dumps([str(folder), command]).encode() + b"\n")
        if not select.select([self._replies], [], [], WALL_SECONDS)[0]:
            os.kill(self._child, signal.SIGKILL)
        reply = os.read(self._replies, 1000)
        code, seconds, memory = json.loads(reply) if reply else (None, WALL_SECONDS, 0)
        if not (reply and self._left):
            self.end()
        texts = [
            (self._folder / name).read_text("utf-8", "replace") for name in ("stdout", "stderr")
        ]
        return Ended(code, *texts, seconds, memory)  # type: ignore[call-arg]

    def end(self):
        """End the process."""
        self._left = 0
        os.close(self._requests)
        os.close(self._replies)
        os.waitpid(self._child, 0)

    def _start(self):
        self._left = CASES_OF_A_PROCESS
        (requests, self._requests), (self._replies, replies) = os.pipe(), os.pipe()
        self._child = os.fork()
        if self._child == 0:
            os.close(self._requests)
            try:
                self._serve(requests, replies)
            finally:
                os._exit(99)
        os.close(requests)
        os.close(replies)

    def _serve(self, requests, replies):
        """Run the commands of the requests in this process."""
        warnings.simplefilter("always", RuntimeWarning)
        resource.setrlimit(
            resource.RLIMIT_AS, (_memory("VmSize") + ADDRESS_SPACE, resource.RLIM_INFINITY)
        )
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(self._folder / name, os.O_RDWR | os.O_CREAT | os.O_APPEND), number)
        for line in os.fdopen(requests):
            folder, command = json.loads(line)
            os.chdir(folder)
            for number in (1, 2):
                os.ftruncate(number, 0)
            started = time.process_time()
            resource.setrlimit(
                resource.RLIMIT_CPU, (int(started) + 3 * CPU_SECONDS, resource.RLIM_INFINITY)
            )
            Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
            base = _memory("VmRSS")
            code = _run_here(command)
            reply = json.dumps([code, time.process_time() - started, _memory("VmHWM") - base])
            os.write(replies, reply.encode())


def _memory(name):
    """Return a figure of this process in bytes: VmRSS, VmHWM, its peak, or VmSize."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) * 1024


def _run_here(command):
    from splinecli.cli.main import main

    sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))  # noqa: SIM115
    try:
        return main(shlex.split(command))
    except BaseException:
        traceback.print_exc()
        return 99
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def run_warm(folder, command):
    """Run a command in this process, so that what it imports is there for all forked processes."""
    from splinecli.cli.main import main

    here = Path.cwd()
    os.chdir(folder)
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            return main(shlex.split(command))
    finally:
        os.chdir(here)


def prepare_process():
    """Keep libraries from starting threads, which a forked process would lack, and leave out long
    work.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    import cv2
    import torch
    import typer

    from splinecli.workshop.synthesis import meshes
    from splinecli.workshop.training import run_files, tasks

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    typer.main.get_command = cache(typer.main.get_command)
    tasks.VALIDATION_PIXELS = 32
    run_files.RunLog.draw = lambda *_: None  # type: ignore[method-assign]
    meshes.split_long_edges = partial(meshes.split_long_edges, most_faces=10)


def faults(ended, before, after):
    """Yield what is wrong with a case."""
    if ended.code not in DOCUMENTED:
        yield f"exit code {ended.code}"
    if "Traceback" in ended.err or "defect" in ended.err:
        yield "traceback"
    if any("Warning:" in line and "/trimesh/" not in line for line in ended.err.split("\n")):
        yield "a warning of Python"
    notes = ("splinecli: warning: ", "splinecli: note: ")
    told = [
        line
        for line in ended.err.split("\n")
        if line.startswith("splinecli: ") and not line.startswith(notes)
    ]
    if ended.code and len(told) != 1:
        yield f"{len(told)} messages"
    if any(not (c.isprintable() or c == "\n") for c in ended.out + ended.err):
        yield "unprintable characters"
    if ended.seconds > CPU_SECONDS:
        yield f"{ended.seconds:.1f} s"
    if ended.memory > (MEMORY_IF_REFUSED if ended.code else MEMORY):
        yield f"{ended.memory / 1e9:.2f} GB"
    if ended.code and any(after.get(name) != value for name, value in before.items()):
        yield "earlier output changed"
    new = after.keys() - before.keys()
    if left := [name for name in new if ".splinecli-" in name or name.endswith("/.lock")]:
        yield f"files are left: {left}"


def run_case(number, corpus, targets, work, worker):
    """Run case `number` and return what it was, how it ended and what is wrong with it."""
    rng = random.Random(number)
    target = rng.choice(targets)
    folder = work / "case"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(corpus / target.name, folder)
    files = sorted(
        path for pattern in target.files for path in folder.glob(pattern) if path.is_file()
    )
    changed = rng.sample(files, min(len(files), rng.choice((1, 1, 1, 2))))
    others = [path for path in files if path not in changed] or files[:1]
    command = rng.choice(target.commands)
    if rng.random() < 0.1:  # an odd name in place of odd contents
        folders = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name != OUT]
        path = rng.choice(folders if folders and rng.random() < 0.5 else files)
        new = rename(path, rng)
        words = [
            odd_path(new.name, rng) if word == path.name else word for word in shlex.split(command)
        ]
        did, command = f"{path.name} is now {new.name!r}", shlex.join(words)
    else:
        did = ", ".join(mutate(path, others, rng) for path in changed)
    before = {} if target.grows else content(folder / OUT)
    ended = worker.run(folder, command)
    found = list(faults(ended, before, content(folder / OUT)))
    return f"{target.name}: {did}; {printable(command)}", ended, found


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--target", action="append", default=[], help="only this kind of input")
    options = parser.parse_args()
    prepare_process()
    codes: Counter[str] = Counter()
    failed, done, started = 0, 0, time.monotonic()
    with tempfile.TemporaryDirectory(dir=FAST if FAST.exists() else None) as temporary:
        work = Path(temporary)
        worker = Worker(work)
        targets = write_corpus(work / "corpus", work / "case", run_warm, tuple(options.target))
        gc.collect()
        gc.freeze()  # a collection in a forked process would copy all memory
        for number in range(options.first, options.first + options.cases):
            if time.monotonic() > started + 60 * options.minutes:
                break
            what, ended, found = run_case(number, work / "corpus", targets, work, worker)
            done += 1
            codes.update((f"exit code {ended.code}", what.split(":")[0]))
            if found:
                failed += 1
                last = ended.err.strip().split("\n")[-1][:300]
                print(
                    f"case {number}: {', '.join(found)}\n  {what}\n  {ended.seconds:.1f} s: {last}",
                    flush=True,
                )
    counts = ", ".join(f"{count} x {key}" for key, count in sorted(codes.items()))
    print(f"{done} cases in {time.monotonic() - started:.0f} s, {failed} failed: {counts}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
