"""Measure training: pixels per second of whole steps, and of drawing their batches alone.

python benchmarks/training_speed.py [SET] [--device cuda] [--batch-size N]

The pixels come from the pixel set SET, or from the online generator. Each figure is a mean over
--steps steps, after --warm-up steps that are not counted.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from splinecli.system.machine import choose_device
from splinecli.workshop.training.config import PRESETS, configure
from splinecli.workshop.training.loop import Trainer
from splinecli.workshop.training.tasks import PixelTask

LOSSES = {"symmetric_weight": 2e-2, "asymmetric_weight": 2e-5}


def variants() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the measured presets: (printed name, preset, changed settings). The refinement net
    trains on no pixels.
    """
    for name, preset in PRESETS.items():
        if preset.updates == "refine_net":
            continue
        yield name, name, {}
        # The preset "paper" has both already. CNN-PS has no LI-Net, so neither applies to it.
        if name != "paper" and preset.network.interpolates:
            yield f"{name}, Ls and La", name, LOSSES
            yield f"{name}, alternating", name, {"updates": "alternating"}


def pixels_per_second(
    call: Callable[[], object], batch_size: int, device: torch.device, *, steps: int, warm_up: int
) -> float:
    """Return the pixels per second of a call that processes `batch_size` pixels."""
    for _ in range(warm_up):
        call()
    _wait(device)
    started = time.perf_counter()
    for _ in range(steps):
        call()
    _wait(device)
    return steps * batch_size / (time.perf_counter() - started)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", nargs="?", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batch-size", type=int)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--warm-up", type=int, default=10)
    options = parser.parse_args(arguments)
    device = choose_device(options.device)
    print(f"{device.type}, {torch.get_num_threads()} threads")
    changes: list[dict[str, Any]] = []
    if options.batch_size:
        changes.append({"batch_size": options.batch_size})
    if options.set:
        changes.append({"sources": {str(options.set): 1.0}})
    counts = {"steps": options.steps, "warm_up": options.warm_up}
    for name, preset, extra in variants():
        config = configure(preset, None, [*changes, extra])
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(config, Path(folder), device)
            assert isinstance(trainer.task, PixelTask)
            draw = partial(trainer.task.draw, 0)
            drawing = pixels_per_second(draw, config.batch_size, device, **counts)
            whole = pixels_per_second(trainer.step, config.batch_size, device, **counts)
        print(f"{name:25} {whole:8.0f} pixels/s (drawing alone {drawing:.0f})", flush=True)


if __name__ == "__main__":
    main()
