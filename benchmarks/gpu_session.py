"""The steps of gpu_session.sh: a GPU against the processor, then rendering on the cores and training on the GPU.

python benchmarks/gpu_session.py OUT [--data DATA] [--minutes M] [--device cuda] [--size full]

Each step is a process of its own with a limit of time, and the others go on where one fails. OUT/report.json and
report.txt are written after each step. Rendering ends after RENDERED_SHARE of the time, and training has the rest.
Only the standard library is imported here, so the report also says what could not be installed.
"""

import argparse
import dataclasses
import json
import os
import platform
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import metadata
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MEDALLION = ROOT / "examples/medallion"
PACKAGES = ("torch", "numpy", "opencv-python-headless", "scipy", "pyamg", "trimesh", "embreex", "distributed")
RENDERED_SHARE = 0.55  # of the time, when rendering ends
LEAST_RENDERED_SHARE = 0.1  # of the time, for rendering after slow steps
SPARE_SECONDS = 15  # of training's time, to validate and save at its end
LEAST_SECONDS = 5  # of a step; it is left out where less is left
STOP_SECONDS = 15  # that an interrupted process has to clean up

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Size:
    """What is measured."""

    megapixels: tuple[float, ...]
    network_pixels: int  # for the speed of the pixelwise network
    methods: tuple[str, ...]  # that are evaluated
    steps: int  # of each comparison of training
    captures: int  # that a comparison of the refinement nets photographs first
    scene: tuple[str, ...]  # options of `prepare`


SIZES = {
    "full": Size((6, 24), 1 << 16, ("all",), 20, 12, ("--size", "128", "--n-lights", "100")),
    "small": Size((0.05, 0.2), 1 << 10, ("spline-net", "ia14"), 4, 2, ("--size", "32", "--n-lights", "16")),
}


# Steps in a process of their own


def machine() -> Row:
    """Return versions and hardware."""
    found: Row = {"python": platform.python_version(), "cores": len(os.sched_getaffinity(0))}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    import torch

    from splinecli.system.devices import choose_precision

    found["processor"] = f"{torch.backends.cpu.get_cpu_capability()}, {choose_precision('auto', torch.device('cpu'))}"
    found["gpu"] = None
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        found["gpu"] = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"
    return found


def splinecli(*arguments: str) -> None:
    """Run `splinecli ARGUMENTS`. Raises RuntimeError if it fails."""
    from splinecli.cli.main import main

    if code := main(arguments):
        raise RuntimeError(f"splinecli {' '.join(arguments)} ended with exit code {code}")


def infer(capture: str, out: str, device: str, runs: int) -> Row:
    """Return speed and memory of the last of several runs of `infer` in one process: the first one loads CUDA."""
    for _ in range(runs):
        splinecli("infer", capture, "-o", out, "--device", device, "--overwrite", "--quiet")
    report = json.loads((Path(out) / Path(capture).name / "report.json").read_text("utf-8"))
    seconds, errors = report["seconds"], report["angular_error_deg"]
    computed = sum(seconds[stage] for stage in ("distil", "estimate", "indirect_light", "refine"))
    return {
        "pixels": report["n_pixels"],
        "pixels_per_second": round(report["n_pixels"] / computed),
        "mae_deg": errors and errors["mean"],
        "distillation": report["distillation"],
        "seconds": seconds,
        "peak_gpu_mib": peak_gpu_mib(),
    }


def peak_gpu_mib() -> int:
    """Return the most memory of the GPU that PyTorch reserved in this process."""
    import torch

    return torch.cuda.max_memory_reserved() >> 20 if torch.cuda.is_available() else 0


def normals_apart(first: str, second: str) -> Row:
    """Return the angles between two normal maps in degrees."""
    import numpy as np

    from splinecli.maths.normals import angle_between_deg

    one, other = np.load(first), np.load(second)
    inside = one.any(axis=-1)
    angle_deg = angle_between_deg(one[inside], other[inside])
    return {"mean_deg": float(angle_deg.mean()), "max_deg": float(angle_deg.max())}


def network_speed(device: str, pixels: int) -> Row:
    """Return pixels per second of the pixelwise network under ten lights, for batches of several sizes."""
    import torch

    from splinecli.methods import MethodOptions, make_estimator
    from splinecli.synthesis.pixels import PixelGenerator, PixelGeneratorConfig

    config = PixelGeneratorConfig(min_lights=10, max_lights=10)
    batch = PixelGenerator(config, torch.Generator().manual_seed(0)).draw(pixels)
    observations, lights = batch.observations.numpy(), batch.light_directions[0].double().numpy()
    found: Row = {}
    for batch_size in (256, 1024, 4096, 16384):
        options = MethodOptions(device=device, batch_size=batch_size)
        estimator = make_estimator("spline-net-pixelwise", options)
        for _ in range(2):
            started = time.perf_counter()
            estimator.estimate(observations, lights)
            found[f"batches of {batch_size}"] = round(pixels / (time.perf_counter() - started))
    return {**found, "peak_gpu_mib": peak_gpu_mib()}


def mean_errors(captures: Sequence[str], out: str, device: str, methods: Sequence[str]) -> dict[str, float]:
    """Return the mean angular error in degrees by method and capture."""
    chosen = [word for method in methods for word in ("--method", method)]
    limits = ("--trials", "1", "--max-pixels", "2000", "--device", device)
    splinecli("evaluate", *captures, *chosen, *limits, "-o", out, "--quiet")
    results = json.loads((Path(out) / "results.json").read_text("utf-8"))["results"]
    return {f"{result['method']}, {result['capture']}": result["mae_deg"] for result in results}


def train_steps(
    preset: str, changes: Sequence[Row], device: str, steps: int, captures: int, *, same_batches: bool
) -> Row:
    """Return the losses and the times of some steps of a preset.

    Args:
        captures: that are photographed before the first step.
        same_batches: whether the pixels are drawn on the processor, whose random numbers differ from the GPU's.
    """
    import torch

    from splinecli.system.devices import choose_device
    from splinecli.training import tasks
    from splinecli.training.config_files import configure
    from splinecli.training.loop import Trainer

    tasks.FIRST_EXAMPLES, tasks.VALIDATION_SCENES = captures, 1
    config, place = configure(preset, None, list(changes)), choose_device(device)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        trainer = Trainer(config, Path(folder), place)
        prepared = time.perf_counter() - started
        if same_batches and isinstance(trainer.task, tasks.PixelTask):
            draw = tasks.PixelTask(config, trainer.shards, torch.device("cpu")).draw
            trainer.task.draw = lambda step: moved(draw(step), place)  # type: ignore[method-assign]
        losses, seconds = [], []
        for _ in range(steps):
            started = time.perf_counter()
            losses.append(float(trainer.step()[0]))
            seconds.append(time.perf_counter() - started)
    later = seconds[1:]  # the first one loads CUDA
    return {
        "losses": losses,
        "steps_per_second": 1 / statistics.mean(later),
        "median_step_seconds": statistics.median(later),
        "prepare_seconds": prepared,
        "peak_gpu_mib": peak_gpu_mib(),
    }


def moved(value: Any, device: Any) -> Any:
    """Return a batch with all its tensors on a device."""
    import torch

    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, list | tuple):
        return type(value)(moved(part, device) for part in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{name: moved(part, device) for name, part in vars(value).items()})
    return value


def finish_set(folder: str) -> Row:
    """Finish a pixel set whose rendering was interrupted. Raises RuntimeError if it has too few scenes."""
    from splinecli.pixel_sets.writer import PixelSetWriter

    entries = PixelSetWriter(Path(folder)).finish().entries
    scenes = len({entry.scene for entry in entries})
    if scenes < 2:
        raise RuntimeError(f"{scenes} scenes are rendered; training and validation need one each")
    return {"entries": len(entries), "shapes": scenes, "pixels": sum(entry.n_pixels for entry in entries)}


def train(pixel_set: str, run: str, device: str, ends: float, seconds_per_capture: float) -> Row:
    """Train the refinement nets until `ends`, a time of time.time(), and return the last metrics.

    Photographing the first captures takes half of the time at most.
    """
    from splinecli.training import tasks
    from splinecli.training.run_log import read_metrics

    usual, held = tasks.FIRST_EXAMPLES, tasks.VALIDATION_SCENES
    left = ends - SPARE_SECONDS - time.time()
    share = min(1.0, left / 2 / (seconds_per_capture * (usual + held)))
    tasks.FIRST_EXAMPLES, tasks.VALIDATION_SCENES = (max(1, round(share * number)) for number in (usual, held))
    photographing = seconds_per_capture * (tasks.FIRST_EXAMPLES + tasks.VALIDATION_SCENES)
    minutes = max(0.05, (left - photographing) / 60)
    splinecli("train", pixel_set, "--preset", "refine", "--device", device, "--minutes", f"{minutes:.2f}", "-o", run)
    rows = read_metrics(Path(run) / "metrics.csv")
    checked = [row.validation_deg for row in rows if row.validation_deg is not None]
    return {
        "minutes": minutes,
        "first_captures": tasks.FIRST_EXAMPLES,
        "steps": rows[-1].step,
        "loss": rows[-1].loss,
        "angle_deg": rows[-1].angle_deg,
        "validation_deg": checked,
        "peak_gpu_mib": peak_gpu_mib(),
    }


# The session


class Session:
    """Runs steps one after the other and writes the report."""

    def __init__(self, out: Path, work: Path, ends: float) -> None:
        self.out, self.work, self.ends = out, work, ends
        self.steps: list[Row] = []

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.ends - time.time()

    def step(self, name: str, call: Callable[..., Row], *arguments: Any, **keywords: Any) -> Row | None:
        """Add the result of a call to the report and return it, or None if it failed."""
        started = time.time()
        entry: Row = {"step": name}
        try:
            entry["result"] = call(*arguments, **keywords)
        except Exception as error:
            entry["error"] = f"{type(error).__name__}: {error}"
        entry["seconds"] = round(time.time() - started, 1)
        self.steps.append(entry)
        (self.out / "report.json").write_text(json.dumps(self.steps, indent=1) + "\n", "utf-8")
        text = "".join(map(as_text, self.steps))
        (self.out / "report.txt").write_text(text, "utf-8")
        print(as_text(entry), end="", flush=True)
        return entry.get("result")

    def child(self, call: Callable[..., Any], *arguments: Any, seconds: float, **keywords: Any) -> Any:
        """Return the result of a call in a process of its own.

        Raises TimeoutError after some seconds, at the latest at the session's end; RuntimeError if the call fails.
        """
        context, log = get_context("spawn"), self.work / "log.txt"
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_answer, args=(sender, str(log), call, arguments, keywords))
        seconds = min(seconds, self.left)
        if seconds < LEAST_SECONDS:
            raise TimeoutError("there is no time left")
        process.start()
        sender.close()
        answered = False
        try:
            if not receiver.poll(seconds):
                raise TimeoutError(f"stopped after {seconds:.0f} seconds")
            answered = True
            problem, result = receiver.recv()
        except EOFError:
            problem, result = f"the process ended with exit code {process.exitcode}", None
        finally:
            process.join(STOP_SECONDS if answered else 0)
            if process.is_alive():
                os.kill(process.pid or 0, signal.SIGINT)
                process.join(STOP_SECONDS)
                process.kill()
                process.join()
        if problem:
            raise RuntimeError("\n".join((problem, *log.read_text("utf-8", "replace").splitlines()[-12:])))
        return result


def _answer(sender: Connection, log: str, call: Callable[..., Any], arguments: Any, keywords: Any) -> None:
    """Send (problem, result) of a call, whose output goes to a log."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 1)
    os.dup2(file, 2)
    try:
        sender.send((None, call(*arguments, **keywords)))
    except Exception as error:
        sender.send((f"{type(error).__name__}: {error}", None))


def as_text(entry: Row) -> str:
    """Return a step of the report as lines of text."""
    lines = [f"{entry['step']} ({entry['seconds']} s)"]
    lines += [f"    FAILED {line}" for line in entry.get("error", "").splitlines()]
    for name, value in (entry.get("result") or {}).items():
        rows = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
        lines += [f"    {name}: {_words(row)}" for row in rows]
    return "\n".join(lines) + "\n"


def _words(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(part)}" for name, part in value.items())
    return "  ".join(map(_words, value)) if isinstance(value, list) else str(value)


def compare_devices(session: Session, size: Size, device: str, statues: Sequence[str]) -> None:
    """Compare inference and evaluation on the device and on the processor."""
    from large_captures import write_capture

    enlarged = {megapixels: session.work / f"relief-{megapixels}" for megapixels in size.megapixels}
    for folder in enlarged.values():
        folder.mkdir()
    with ThreadPoolExecutor() as threads:
        written = [threads.submit(write_capture, folder, megapixels) for megapixels, folder in enlarged.items()]
        outs = {place: str(session.work / f"infer-{place}") for place in (f"device {device}", "processor")}
        for (place, out), name in zip(outs.items(), (device, "cpu"), strict=True):
            session.step(f"infer medallion, {place}", session.child, infer, str(MEDALLION), out, name, 2, seconds=90)
        maps = [f"{out}/medallion/normals.npy" for out in outs.values()]
        session.step("angle between the normal maps", session.child, normals_apart, *maps, seconds=30)
        session.step("network, pixels/s", session.child, network_speed, device, size.network_pixels, seconds=60)
        errors = []
        for name in (device, "cpu"):
            out = tempfile.mkdtemp(dir=session.work)
            arguments = ([str(MEDALLION), *statues], out, name, size.methods)
            errors.append(session.step(f"evaluate, {name}", session.child, mean_errors, *arguments, seconds=90))
        session.step("evaluate, difference of the MAE in degrees", differences, *errors)
        for folder, writing in zip(enlarged.values(), written, strict=True):
            writing.result()
            out = str(session.work / "infer-large")
            session.step(f"infer {folder.name}", session.child, infer, str(folder), out, device, 1, seconds=120)


def differences(first: dict[str, float] | None, second: dict[str, float] | None) -> dict[str, float]:
    """Return the first numbers minus the second ones."""
    if first is None or second is None:
        raise RuntimeError("an evaluation failed")
    return {name: first[name] - second[name] for name in first}


def compare_training(session: Session, size: Size, device: str, preset: str, sources: Sequence[Row]) -> Row | None:
    """Compare steps of a preset on the device and on the processor; return the device's row, None if it failed."""
    exact = [*sources, {"precision": "float32"}]
    runs = {
        "processor, float32": ("cpu", exact, True),
        f"{device}, float32, the same batches": (device, exact, True),
        device: (device, [*sources], False),
    }
    found = {
        name: session.step(
            f"train {preset}, {name}",
            session.child,
            train_steps,
            *(preset, changes, place, size.steps, size.captures),
            same_batches=same,
            seconds=75,
        )
        for name, (place, changes, same) in runs.items()
    }
    rows = {name: row for name, row in found.items() if row is not None}
    losses = zip(*(row["losses"] for row in rows.values()), strict=True)
    session.step(f"train {preset}, losses", lambda: {"of": list(rows), "loss": [list(each) for each in losses]})
    return found[device]


def scenes_to_render(data: Path | None, size: Size) -> list[str]:
    """Return the options of `prepare`: views of the meshes, or random scenes without any. More than there is time for.

    Shapes of the statues are left out, because they are for measuring: statues/maria_specular is one of shapes/maria.
    """
    options = [*size.scene, "--workers", "auto"]
    statues = tuple(path.name.split("_")[0] for path in data.glob("statues/*")) if data else ()
    meshes = [path for path in sorted(data.glob("shapes/*.ply")) if not path.name.startswith(statues)] if data else []
    if data is None or not meshes:
        return [*options, "--scenes", "200"]
    relief = [word for path in sorted(data.glob("relief/*.jpg")) for word in ("--relief", str(path))]
    return [*options, "--views", "8", *(word for path in meshes for word in ("--mesh", str(path))), *relief]


def render(session: Session, options: Sequence[str], pixel_set: Path, seconds: float) -> Row:
    """Render scenes for some seconds, and finish the set with those that are complete."""
    with suppress(TimeoutError):
        session.child(splinecli, "prepare", *options, "-o", str(pixel_set), "--quiet", seconds=seconds)
    return session.child(finish_set, str(pixel_set), seconds=30)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", default="")
    parser.add_argument("--minutes", type=float, default=12)
    parser.add_argument("--started", type=float, default=time.time(), help="when the minutes began, in Unix time")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", choices=SIZES, default="full")
    parser.add_argument("--work", type=Path, help="a folder for what is not kept, with the log of the installation")
    options = parser.parse_args(arguments)
    size, device = SIZES[options.size], options.device
    data = Path(options.data) if options.data else None
    work = options.work or Path(tempfile.mkdtemp())
    options.out.mkdir(parents=True, exist_ok=True)
    session = Session(options.out, work, options.started + 60 * options.minutes)
    log = work / "install.log"
    lines = log.read_text("utf-8", "replace").splitlines()[-12:] if log.exists() else []
    session.step("install", lambda: {"until now": f"{time.time() - options.started:.0f} s", "log": [*map(str, lines)]})
    found = session.step("machine", session.child, machine, seconds=60)
    if found is None or (device == "cuda" and found["gpu"] is None):
        print("PyTorch finds no GPU: nothing else can be measured", file=sys.stderr)
        return 1
    statues = [*map(str, sorted(data.glob("statues/*")))] if data else []
    compare_devices(session, size, device, statues)
    compare_training(session, size, device, "compact", [])
    total = 60 * options.minutes
    rendered = max(LEAST_RENDERED_SHARE * total, session.left - (1 - RENDERED_SHARE) * total)
    pixel_set = work / "scenes"
    scenes = scenes_to_render(data, size)
    if session.step("render scenes", render, session, scenes, pixel_set, rendered) is not None:
        row = compare_training(session, size, device, "refine", [{"sources": {str(pixel_set): 1.0}}])
        seconds = row["prepare_seconds"] / (size.captures + 1) if row else 1.0
        run = str(options.out / "refine")
        places = (str(pixel_set), run, device, session.ends, seconds)
        session.step("train the refinement nets", session.child, train, *places, seconds=session.left)
    return int(any("error" in step for step in session.steps))


if __name__ == "__main__":
    sys.exit(main())
