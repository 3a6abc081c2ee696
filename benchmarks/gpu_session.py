"""The steps of gpu_session.sh: a GPU against the processor, then rendering on the cores and
training on the GPU.

python benchmarks/gpu_session.py OUT [--data DATA] [--minutes M] [--device cuda] [--size full]

Each step is a process with a limit of time, and the others go on where one fails. OUT/report.json
and report.txt are written after each. Rendering ends after RENDERED_SHARE of the time, and training
has the rest. Only the standard library is imported here, so the report also says what could not be
installed.
"""

import argparse
import dataclasses
import json
import os
import platform
import shutil
import signal
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import metadata
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

MEDALLION = str(Path(__file__).resolve().parents[1] / "examples/medallion")
PACKAGES = (
    "torch",
    "numpy",
    "opencv-python-headless",
    "scipy",
    "pyamg",
    "trimesh",
    "embreex",
    "distributed",
)
RENDERED_SHARE = 0.55
LEAST_RENDERED_SHARE = 0.1  # of the time, for rendering after slow steps
SPARE_SECONDS = 15  # of training, to validate and save at its end
LEAST_SECONDS = 5  # of a step; it is left out where less is left
STOP_SECONDS = 15  # that an interrupted process has to clean up

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    runs: int  # of `infer` on a small capture; CUDA is loaded in the first one
    megapixels: tuple[float, ...]
    methods: tuple[str, ...]  # that are evaluated
    steps: int  # of each comparison of training
    captures: int  # that a comparison of the refinement nets photographs first
    scene: tuple[str, ...]  # options of `prepare`


SIZES = {
    "full": Size(2, (6, 24), ("all",), 20, 12, ("--size", "128", "--n-lights", "100")),
    "small": Size(1, (0.01, 0.02), ("ia14",), 2, 1, ("--size", "32", "--n-lights", "16")),
}


def machine() -> Row:
    """Return versions and hardware."""
    import torch

    from splinecli.system.machine import choose_precision

    installed = {each.name: each.version for each in metadata.distributions()}
    found: Row = {
        "python": platform.python_version(),
        **{name: installed.get(name) for name in PACKAGES},
    }
    found["cores"] = len(os.sched_getaffinity(0))
    found["processor"] = (
        f"{torch.backends.cpu.get_cpu_capability()},"
        f" {choose_precision('auto', torch.device('cpu'))}"
    )
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        found["gpu"] = (
            f"{properties.name}, {properties.total_memory >> 30} GiB, CUDA {torch.version.cuda}"
        )
    return found


def splinecli(*arguments: str) -> None:
    """Run `splinecli ARGUMENTS`. Raises RuntimeError if it fails."""
    from splinecli.cli.main import main

    if code := main(arguments):
        raise RuntimeError(f"splinecli {arguments[0]} ended with exit code {code}")


def peak_gpu_mib() -> int:
    """Return the most memory of the GPU that PyTorch reserved in this process."""
    import torch

    return torch.cuda.max_memory_reserved() >> 20 if torch.cuda.is_available() else 0


def infer(capture: str, out: str, device: str, runs: int) -> Row:
    """Return speed and memory of the last of some runs of `infer` in one process."""
    for _ in range(runs):
        splinecli("infer", capture, "-o", out, "--device", device, "--overwrite", "--quiet")
    report = json.loads((Path(out) / Path(capture).name / "report.json").read_text("utf-8"))
    seconds = report["seconds"]
    computed = sum(seconds[stage] for stage in ("distil", "estimate", "indirect_light", "refine"))
    found = {
        "pixels": report["n_pixels"],
        "pixels_per_second": round(report["n_pixels"] / computed),
    }
    return {
        **found,
        "seconds": seconds,
        "distillation": report["distillation"],
        "peak_gpu_mib": peak_gpu_mib(),
    }


def infer_large(megapixels: float, work: str, device: str) -> Row:
    """Return speed and memory of `infer` on a capture of this size."""
    from large_captures import write_capture

    folder = Path(work) / f"relief-{megapixels}"
    folder.mkdir()
    write_capture(folder, megapixels)
    return infer(str(folder), work, device, 1)


def normals_apart(first: str, second: str) -> Row:
    """Return the angles between two normal maps in degrees."""
    import numpy as np

    from splinecli.maths.normals import angle_between_deg

    one, other = np.load(first), np.load(second)
    inside = one.any(axis=-1)
    angle_deg = angle_between_deg(one[inside], other[inside])
    return {"mean_deg": float(angle_deg.mean()), "max_deg": float(angle_deg.max())}


def mean_errors(captures: Sequence[str], out: str, device: str, methods: Sequence[str]) -> Row:
    """Return the mean angular error in degrees by method and capture."""
    chosen = [word for method in methods for word in ("--method", method)]
    limits = ("--trials", "1", "--max-pixels", "2000", "--device", device)
    splinecli("evaluate", *captures, *chosen, *limits, "-o", out, "--quiet")
    results = json.loads((Path(out) / "results.json").read_text("utf-8"))["results"]
    return {f"{result['method']} on {result['capture']}": result["mae_deg"] for result in results}


def train_steps(
    preset: str, changes: Sequence[Row], device: str, size: Size, same_batches: bool
) -> Row:
    """Return losses and times of some steps of a preset.

    With `same_batches`, pixels are drawn on the processor, because the GPU has other random
    numbers. Captures are always photographed with the processor's.
    """
    import torch

    from splinecli.system.machine import choose_device
    from splinecli.workshop.training import tasks
    from splinecli.workshop.training.config import configure
    from splinecli.workshop.training.loop import Trainer

    tasks.VALIDATION_SCENES = 1
    changes = [*changes, {"first_captures": size.captures}]
    config, place = configure(preset, None, changes), choose_device(device)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, Path(folder), place)
        if same_batches and isinstance(trainer.task, tasks.PixelTask):
            draw = tasks.PixelTask(config, trainer.shards, torch.device("cpu")).draw
            trainer.task.draw = lambda step: moved(draw(step), place)  # type: ignore[method-assign]
        losses, seconds = [], []
        for _ in range(size.steps):
            started = time.perf_counter()
            losses.append(float(trainer.step()[0]))
            seconds.append(time.perf_counter() - started)
        found: Row = {"losses": losses}
        if isinstance(trainer.task, tasks.RefinementTask):
            started = time.perf_counter()
            for _ in range(3):
                trainer.task.captures.add()
            found["capture_seconds"] = (time.perf_counter() - started) / 3
    found["steps_per_second"] = 1 / statistics.mean(seconds[1:])  # the first step loads CUDA
    found["median_step_seconds"] = statistics.median(seconds[1:])
    return {**found, "peak_gpu_mib": peak_gpu_mib()}


def moved(value: Any, device: Any) -> Any:
    """Return a batch with all its tensors on a device."""
    if isinstance(value, list | tuple):
        return type(value)(moved(part, device) for part in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(
            value, **{name: moved(part, device) for name, part in vars(value).items()}
        )
    return value.to(device) if hasattr(value, "to") else value


def finish_set(folder: str) -> Row:
    """Finish a pixel set whose rendering was interrupted. Raises RuntimeError if it has too few
    scenes.
    """
    from splinecli.workshop.pixel_sets.store import PixelSetWriter

    entries = PixelSetWriter(Path(folder)).finish().entries
    shapes = len({entry.scene for entry in entries})
    if shapes < 2:
        raise RuntimeError(f"{shapes} shapes are rendered; training and validation need one each")
    return {
        "entries": len(entries),
        "shapes": shapes,
        "pixels": sum(entry.n_pixels for entry in entries),
    }


def train(pixel_set: str, run: str, device: str, ends: float, capture_seconds: float) -> Row:
    """Train the refinement nets until `ends`, in Unix time. Photographing first takes about half of
    it at most.
    """
    from splinecli.cli.console import Messages
    from splinecli.workshop.training import CAPTURES, tasks
    from splinecli.workshop.training.config import PRESETS, configure
    from splinecli.workshop.training.loop import open_run

    def minutes_left() -> float:
        return max(0.05, (ends - SPARE_SECONDS - time.time()) / 60)

    usual, held = PRESETS["refine"].first_captures, tasks.VALIDATION_SCENES
    share = min(1.0, 60 * minutes_left() / 2 / (capture_seconds * (usual + held)))
    first, tasks.VALIDATION_SCENES = (max(1, round(share * number)) for number in (usual, held))
    changes = {"sources": {pixel_set: 1.0}, "minutes": minutes_left(), "first_captures": first}
    config = configure("refine", None, [changes])
    with open_run(
        config, Path(run), device, resume=False, tensorboard=False, observer=Messages(quiet=False)
    ) as trainer:
        # How long photographing takes is known only now.
        trainer.config = dataclasses.replace(config, minutes=minutes_left())
        last = trainer.run()
    shutil.rmtree(Path(run) / CAPTURES)
    assert last is not None
    found = {"first_captures": first, "training_minutes": trainer.config.minutes}
    return {**found, **dataclasses.asdict(last), "peak_gpu_mib": peak_gpu_mib()}


class Session:
    """Runs steps one after the other and writes the report."""

    def __init__(self, out: Path, work: Path, ends: float) -> None:
        self.out, self.work, self.ends = out, work, ends
        self.entries: list[Row] = []

    def step(
        self, name: str, call: Callable[..., Row], *arguments: Any, seconds: float | None = None
    ) -> Row | None:
        """Add the result of a call to the report and return it, or None if it failed.

        With a limit of seconds, it is called in a process of its own; see `child`.
        """
        started = time.time()
        entry: Row = {"step": name}
        try:
            entry["result"] = (
                call(*arguments)
                if seconds is None
                else self.child(call, *arguments, seconds=seconds)
            )
        except Exception as error:
            entry["error"] = f"{type(error).__name__}: {error}"
        entry["seconds"] = round(time.time() - started, 1)
        self.entries.append(entry)
        (self.out / "report.json").write_text(json.dumps(self.entries, indent=1) + "\n", "utf-8")
        (self.out / "report.txt").write_text("".join(map(as_text, self.entries)), "utf-8")
        print(as_text(entry), end="", flush=True)
        return entry.get("result")

    def child(self, call: Callable[..., Row | None], *arguments: Any, seconds: float) -> Any:
        """Return the result of a call in a process of its own.

        Raises TimeoutError after some seconds, at the latest at the session's end; RuntimeError if
        the call fails.
        """
        seconds = min(seconds, self.ends - time.time())
        if seconds < LEAST_SECONDS:
            raise TimeoutError("there is no time left")
        context, log = get_context("spawn"), self.work / f"{call.__name__}.txt"
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_answer, args=(sender, str(log), call, arguments))
        process.start()
        sender.close()
        answered = receiver.poll(seconds)
        try:
            problem, result = receiver.recv() if answered else (None, None)
        except EOFError:
            problem, result = "the process died", None
        process.join(STOP_SECONDS if answered else 0)
        if process.is_alive():
            os.kill(process.pid or 0, signal.SIGINT)
            process.join(STOP_SECONDS)
            process.kill()
        if not answered:
            raise TimeoutError(f"stopped after {seconds:.0f} seconds")
        if problem:
            lines = log.read_text("utf-8", "replace").splitlines()
            raise RuntimeError("\n".join((problem, *lines[-30:])))
        return result


def _answer(
    sender: Connection, log: str, call: Callable[..., Any], arguments: Sequence[Any]
) -> None:
    """Send (problem, result) of a call, whose output goes to a log."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    try:
        sender.send((None, call(*arguments)))
    except Exception as error:
        traceback.print_exc()
        sender.send((f"{type(error).__name__}: {error}", None))


def problems(log: Path) -> list[list[str]]:
    """Return what could not be installed, from the log of gpu_session.sh."""
    lines = log.read_text("utf-8", "replace").splitlines() if log.exists() else []
    return [[line] for line in lines if line.startswith("not installed")]


def as_text(entry: Row) -> str:
    """Return a step of the report as lines of text."""
    lines = [f"{entry['step']} ({entry['seconds']} s)"]
    lines += [f"    FAILED {line}" for line in entry.get("error", "").splitlines()]
    for name, value in (entry.get("result") or {}).items():
        rows = (
            value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
        )
        lines += [f"    {name}: {_words(row)}" for row in rows]
    return "\n".join(lines) + "\n"


def _words(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(part)}" for name, part in value.items())
    return "  ".join(map(_words, value)) if isinstance(value, list) else str(value)


def compare_inference(session: Session, size: Size, device: str, captures: Sequence[str]) -> None:
    """Compare `infer` and `evaluate` on the device and on the processor."""
    places = {device: device, "processor": "cpu"}
    for name, place in places.items():
        out = str(session.work / f"infer-{name}")
        session.step(
            f"infer medallion, {name}", infer, MEDALLION, out, place, size.runs, seconds=90
        )
    maps = [str(session.work / f"infer-{name}/medallion/normals.npy") for name in places]
    session.step("angle between the normal maps", normals_apart, *maps, seconds=30)
    # In a process that has done no other linear algebra:
    # https://github.com/pytorch/pytorch/issues/90613
    first = [MEDALLION], str(session.work / "evaluate-ia14"), device, ("ia14",)
    session.step(f"evaluate ia14 alone, {device}", mean_errors, *first, seconds=60)
    errors = []
    for name, place in places.items():
        how = captures, str(session.work / f"evaluate-{name}"), place, size.methods
        errors.append(session.step(f"evaluate, {name}", mean_errors, *how, seconds=90) or {})
    common = {name: errors[0][name] - errors[1][name] for name in errors[0] if name in errors[1]}
    session.step("evaluate, difference of the MAE in degrees", lambda: common)


def compare_training(
    session: Session, size: Size, device: str, preset: str, sources: Sequence[Row]
) -> Row | None:
    """Compare steps of a preset on the device and on the processor; return the device's row, None
    if it failed.
    """
    exact = [*sources, {"precision": "float32"}]
    found = {
        name: session.step(f"train {preset}, {name}", train_steps, preset, *how, seconds=75)
        for name, how in {
            "processor, float32": (exact, "cpu", size, True),
            f"{device}, float32, the same batches": (exact, device, size, True),
            device: (list(sources), device, size, False),
        }.items()
    }
    columns = {name: row["losses"] for name, row in found.items() if row is not None}
    losses = [list(each) for each in zip(*columns.values(), strict=True)]
    session.step(f"train {preset}, losses", lambda: {"columns": [list(columns)], "loss": losses})
    return found[device]


def scenes_to_render(data: Path | None, size: Size) -> list[str]:
    """Return options of `prepare` for more scenes than there is time for: views of meshes, or
    without any random ones.

    Shapes of the statues are left out, because they are for measuring: statues/maria_specular is
    one of shapes/maria.
    """
    options = [*size.scene, "--workers", "auto"]
    statues = tuple(path.name.split("_")[0] for path in data.glob("statues/*")) if data else ()
    meshes = (
        [path for path in sorted(data.glob("shapes/*.ply")) if not path.name.startswith(statues)]
        if data
        else []
    )
    if data is None or not meshes:
        return [*options, "--scenes", "200"]
    files = {"--mesh": meshes, "--relief": sorted(data.glob("relief/*.jpg"))}
    words = [word for name, paths in files.items() for path in paths for word in (name, str(path))]
    return [*options, "--views", "8", *words]


def prepare(options: Sequence[str], pixel_set: str) -> None:
    """Render scenes, and leave the cores to others that need them."""
    os.nice(10)
    splinecli("prepare", *options, "-o", pixel_set, "--quiet")


def render(session: Session, options: Sequence[str], pixel_set: str, seconds: float) -> Row:
    """Render scenes for some seconds, and finish the set with those that are complete."""
    with suppress(TimeoutError):
        session.child(prepare, options, pixel_set, seconds=seconds)
    found: Row = session.child(finish_set, pixel_set, seconds=30)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", default="")
    parser.add_argument("--minutes", type=float, default=12)
    parser.add_argument(
        "--started", type=float, default=time.time(), help="when the minutes began, in Unix time"
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", choices=SIZES, default="full")
    parser.add_argument(
        "--work", type=Path, help="a folder for what is not kept, with the log of the installation"
    )
    options = parser.parse_args(arguments)
    size, device, total = SIZES[options.size], options.device, 60 * options.minutes
    data = Path(options.data) if options.data else None
    work = options.work or Path(tempfile.mkdtemp())
    options.out.mkdir(parents=True, exist_ok=True)
    session = Session(options.out, work, options.started + total - STOP_SECONDS)
    installed = {
        "seconds": time.time() - options.started,
        "problems": problems(work / "install.log"),
    }
    session.step("install", lambda: installed)
    found = session.step("machine", machine, seconds=60)
    if found is None or (device == "cuda" and "gpu" not in found):
        print("PyTorch finds no GPU: nothing else is measured", file=sys.stderr)
        return 1
    compare_inference(
        session,
        size,
        device,
        [MEDALLION, *map(str, sorted(data.glob("statues/*")) if data else ())],
    )
    compare_training(session, size, device, "compact", [])
    pixel_set, run = str(work / "scenes"), str(options.out / "refine")
    rendered = max(
        LEAST_RENDERED_SHARE * total, session.ends - time.time() - (1 - RENDERED_SHARE) * total
    )
    with ThreadPoolExecutor(1) as thread:
        rendering = thread.submit(
            render, session, scenes_to_render(data, size), pixel_set, rendered
        )
        for megapixels in size.megapixels:
            name = f"infer {megapixels} megapixels, {device}, while scenes are rendered"
            session.step(name, infer_large, megapixels, str(work), device, seconds=150)
        scenes = session.step(f"render scenes, {rendered:.0f} s", rendering.result)
    if scenes is not None:
        row = compare_training(session, size, device, "refine", [{"sources": {pixel_set: 1.0}}])
        capture_seconds = row["capture_seconds"] if row else 1.0
        session.step(
            "train", train, pixel_set, run, device, session.ends, capture_seconds, seconds=total
        )
    return int(any("error" in entry for entry in session.entries))


if __name__ == "__main__":
    sys.exit(main())
