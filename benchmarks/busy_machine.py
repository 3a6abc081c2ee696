"""Measure the network on a quiet machine and beside busy processes, with and without sleeping
threads.

python benchmarks/busy_machine.py [CAPTURE] [--busy N] [--pixels N] [--repeats 3]

PyTorch's threads wait for each other after each step. By default, a waiting thread keeps its core
busy for a while. If other processes need the core, the thread that the others wait for gets no
time. With OMP_WAIT_POLICY=passive, waiting threads sleep; the `splinecli` command sets this itself.

Each figure is the median time of one estimate by spline-net, in seconds, in a process of its own.
The settings take turns, so that all of them meet the same conditions. CAPTURE is examples/medallion
by default, and --busy the number of cores; --busy 0 measures the quiet machine alone.
"""

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

MEDALLION = Path(__file__).resolve().parents[1] / "examples/medallion"

SETTINGS = {
    "default": {},
    "passive": {"OMP_WAIT_POLICY": "passive"},
    "1 thread": {"OMP_NUM_THREADS": "1"},
}
"""Environment variables of each measured process."""

_TIMED = """
import sys, time
from splinecli.recipe import read_capture
from splinecli.inference import estimate_normals
from splinecli.methods import make_estimator

capture = read_capture(sys.argv[1]).choose_lights(range(10))
pixels, lights = capture.observations[: int(sys.argv[2])], capture.light_directions
estimator = make_estimator("spline-net")
estimator.estimate(pixels[:1], lights)
started = time.perf_counter()
estimator.estimate(pixels, lights)
print(time.perf_counter() - started)
"""


def seconds(capture: Path, pixels: int, variables: dict[str, str]) -> float:
    """Return the time of one estimate in a new process with these environment variables."""
    inherited = {
        name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))
    }
    done = subprocess.run(
        [sys.executable, "-c", _TIMED, str(capture), str(pixels)],
        env={**inherited, **variables},
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return float(done.stdout)


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep this many cores busy."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", nargs="?", type=Path, default=MEDALLION)
    parser.add_argument("--busy", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--pixels", type=int, default=10**9)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    print(f"{'':24}" + "".join(f"{name:>12}" for name in SETTINGS) + "   default / passive")
    cases = [("quiet", 0), (f"beside {options.busy} busy processes", options.busy)]
    for title, count in cases[: 2 if options.busy else 1]:
        times: dict[str, list[float]] = {name: [] for name in SETTINGS}
        with busy_processes(count):
            for _ in range(options.repeats):
                for name, variables in SETTINGS.items():
                    times[name].append(seconds(options.capture, options.pixels, variables))
        medians = {name: statistics.median(values) for name, values in times.items()}
        print(
            f"{title:24}"
            + "".join(f"{value:10.2f} s" for value in medians.values())
            + f"   {medians['default'] / medians['passive']:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
