"""Run splinecli on mutated inputs: `python tests/fuzz/run.py --cases 20000 --minutes 60`.

A case is decided by its seed alone: `--first N --cases 1` repeats case N. It passes if

- the exit code is documented, and no defect (1);
- a failure is told in one line on stderr, and a success writes no error;
- there is no traceback, and no character that a terminal would obey;
- it takes less than 10 s of processor time and 1 GB of memory, or 300 MB if it fails;
- a failure leaves the earlier output as it was, and no run leaves unfinished files or locks.

Each case runs in a process of its own, forked from one that has imported everything, so it takes milliseconds.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from corpus import OUT, Target, write_corpus  # noqa: E402
from mutations import mutate, odd_path, rename  # noqa: E402

from kills import content  # noqa: E402
from splinecli.errors import printable  # noqa: E402

RENAMED_SHARE = 0.1  # of the cases, which have odd names in place of odd contents
CPU_SECONDS, WALL_SECONDS, MEMORY, MEMORY_IF_REFUSED = 10, 120, 10**9, 300 * 2**20
DOCUMENTED = {0, 2, 3, 4, 5}


@dataclass(frozen=True)
class Ended:
    """What a process left: exit code (None if a signal ended it), texts, processor time, growth of memory in bytes."""

    code: int | None
    out: str
    err: str
    seconds: float
    memory: int


def run_forked(folder: Path, command: str) -> Ended:
    """Run a command in a forked process, in a folder, with stdout and stderr in files beside the folder."""
    out, err = folder.parent / "stdout", folder.parent / "stderr"
    base = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    child = os.fork()
    if child == 0:
        _run_here(folder, command, out, err)
    deadline = time.monotonic() + WALL_SECONDS
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            break
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.001)
    code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else None
    texts = [path.read_text("utf-8", "replace") for path in (out, err)]
    return Ended(code, *texts, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 - base)


def _run_here(folder: Path, command: str, out: Path, err: Path) -> None:
    """Run the command line in this process, which ends with it."""
    code = 99
    try:
        os.chdir(folder)
        for number, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        from splinecli.cli.main import main

        code = main(shlex.split(command))
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def run_warm(folder: Path, command: str) -> int:
    """Run a command in this process, so that what it imports is there for all forked processes."""
    from splinecli.cli.main import main

    here = Path.cwd()
    os.chdir(folder)
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            return main(shlex.split(command))
    finally:
        os.chdir(here)


def prepare_process() -> None:
    """Keep libraries from starting threads, which a forked process would lack, and validation small."""
    os.environ["OMP_NUM_THREADS"] = "1"
    import cv2
    import torch

    from splinecli.training import tasks

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    tasks.VALIDATION_PIXELS = 32


def faults(ended: Ended, before: dict[str, bytes], after: dict[str, bytes]) -> Iterator[str]:
    """Yield what is wrong with a case."""
    no_memory = ended.code == 1 and "not enough memory" in ended.err
    if ended.code not in DOCUMENTED and not no_memory:
        yield f"exit code {ended.code}"
    if "Traceback" in ended.err or "defect" in ended.err:
        yield "traceback"
    told = [line for line in ended.err.split("\n") if line.startswith("splinecli: ") and not _is_note(line)]
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


def _is_note(line: str) -> bool:
    return line.startswith(("splinecli: warning: ", "splinecli: note: "))


def run_case(number: int, corpus: Path, targets: list[Target], work: Path) -> tuple[str, Ended, list[str]]:
    """Run case `number` and return what it was, how it ended and what is wrong with it."""
    rng = random.Random(number)
    target = rng.choice(targets)
    folder = work / "case"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(corpus / target.name, folder)
    files = sorted(path for pattern in target.files for path in folder.glob(pattern) if path.is_file())
    changed = rng.sample(files, min(len(files), rng.choice((1, 1, 1, 2))))
    others = [path for path in files if path not in changed] or files[:1]
    command = rng.choice(target.commands)
    if rng.random() < RENAMED_SHARE:
        did, command = rename_one(folder, files, command, rng)
    else:
        did = ", ".join(mutate(path, others, rng) for path in changed)
    before = content(folder / OUT)
    ended = run_forked(folder, command)
    found = list(faults(ended, before, content(folder / OUT)))
    return f"{target.name}: {did}; {printable(command)}", ended, found


def rename_one(folder: Path, files: list[Path], command: str, rng: random.Random) -> tuple[str, str]:
    """Rename a file or a folder of a case, here and in the command. Return what was done, and the new command."""
    folders = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name != OUT]
    path = rng.choice(folders if folders and rng.random() < 0.5 else files)
    new = rename(path, rng)
    words = [odd_path(new.name, rng) if word == path.name else word for word in shlex.split(command)]
    return f"{path.name} is now {new.name!r}", shlex.join(words)


def run_cases(
    cases: int,
    *,
    first: int = 0,
    minutes: float = 60.0,
    names: tuple[str, ...] = (),
    keep: Path | None = None,
) -> tuple[int, Counter[str], list[str]]:
    """Run cases, and return their number, the counts of exit codes and what failed."""
    prepare_process()
    codes: Counter[str] = Counter()
    failed, done, deadline = [], 0, time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        targets = write_corpus(work / "corpus", work / "case", run_warm, names)
        gc.collect()
        gc.freeze()  # a collection in a forked process would copy all memory
        for number in range(first, first + cases):
            if time.monotonic() > deadline:
                break
            what, ended, found = run_case(number, work / "corpus", targets, work)
            done += 1
            codes[str(ended.code)] += 1
            if found:
                last = ended.err.strip().split("\n")[-1][:300]
                failed.append(f"case {number}: {', '.join(found)}\n  {what}\n  {ended.seconds:.1f} s: {last}")
                print(failed[-1], flush=True)
                if keep is not None:
                    shutil.copytree(
                        work / "case", keep / str(number), symlinks=True, ignore=_special, dirs_exist_ok=True
                    )
    return done, codes, failed


def _special(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not (Path(folder, name).is_dir() or Path(folder, name).is_file())]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--target", action="append", default=[], help="only this kind of input")
    parser.add_argument("--keep", type=Path, help="copy the files of failed cases into this folder")
    options = parser.parse_args()
    started = time.monotonic()
    done, codes, failed = run_cases(
        options.cases,
        first=options.first,
        minutes=options.minutes,
        names=tuple(options.target),
        keep=options.keep,
    )
    counts = ", ".join(f"{count} x {code}" for code, count in sorted(codes.items()))
    print(f"{done} cases in {time.monotonic() - started:.0f} s, {len(failed)} failed; exit codes: {counts}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
