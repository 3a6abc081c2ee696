"""Pixels a second in training: the whole step, and the drawing of its batch alone.

python benchmarks/training_speed.py [SET] [--device cuda] [--batch-size N]

Without a SET on the online generator. Means over 60 steps, after a warm-up of 10.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from splinecli.devices import choose_device
from splinecli.training.config import PRESETS
from splinecli.training.config_files import configure
from splinecli.training.loop import Trainer

STEPS, WARM_UP = 60, 10


def pixels_per_second(call: Callable[[], object], batch_size: int, device: torch.device) -> float:
    for _ in range(WARM_UP):
        call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(STEPS):
        call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return STEPS * batch_size / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", nargs="?", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batch-size", type=int)
    options = parser.parse_args()
    device = choose_device(options.device)
    print(f"{device.type}, {torch.get_num_threads()} threads")
    changes = [{"batch_size": options.batch_size}] if options.batch_size else []
    if options.set:
        changes.append({"sources": {str(options.set): 1.0}})
    losses = {"symmetric_weight": 2e-2, "asymmetric_weight": 2e-5}
    for preset in PRESETS:
        for name, extra in (("", {}), (", Ls and La", losses), (", alternating", {"updates": "alternating"})):
            if preset == "paper" and extra:
                continue
            config = configure(preset, None, [*changes, extra])
            with tempfile.TemporaryDirectory() as folder:
                trainer = Trainer(config, Path(folder), device)
                drawing = pixels_per_second(trainer.draw, config.batch_size, device)
                whole = pixels_per_second(trainer.step, config.batch_size, device)
            print(f"{preset + name:25} {whole:8.0f} pixels/s (drawing alone {drawing:.0f})", flush=True)


if __name__ == "__main__":
    main()
