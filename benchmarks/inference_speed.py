"""Pixels a second of the shipped network and of the paper's, on the CPU, same run; and the whole `infer` command.

python benchmarks/inference_speed.py [CAPTURE]

The networks get ten lights of one random rig. Medians over the repeats, after one warm-up. With a CAPTURE (such as
DiLiGenT's catPNG) the whole command is timed on it too, from ten lights, in processes of its own.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time

import torch

from splinecli.devices import choose_precision
from splinecli.methods.networks import NetworkEstimator, Precision
from splinecli.networks.config import NetworkConfig
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import LoadedNetwork, resolve_weights
from splinecli.synthesis.pixels import PixelGenerator, PixelGeneratorConfig


def pixels_per_second(loaded: LoadedNetwork, precision: Precision, pixels: int, repeats: int) -> float:
    """Median over the repeats of `pixels` over the seconds that they take."""
    config = PixelGeneratorConfig(min_lights=10, max_lights=10)
    batch = PixelGenerator(config, torch.Generator().manual_seed(0)).draw(pixels)
    observations, lights = batch.observations.numpy(), batch.light_directions[0].double().numpy()
    estimator = NetworkEstimator("spline-net", loaded, precision=precision)
    seconds = []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        estimator.estimate(observations, lights)
        seconds.append(time.perf_counter() - started)
    return pixels / statistics.median(seconds[1:])


def main() -> None:
    print(f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}")
    paper_network = SplineNet(NetworkConfig(size="paper")).eval().to(memory_format=torch.channels_last)
    paper = pixels_per_second(LoadedNetwork(paper_network, "paper", ""), "float32", 512, 3)
    print(f"paper      float32   {paper:8.0f} pixels/s")
    shipped = resolve_weights("spline-net")
    for precision in ("float32", "bfloat16"):
        speed = pixels_per_second(shipped, precision, 16_384, 5)
        auto = " (auto)" if choose_precision("auto", torch.device("cpu")) == precision else ""
        print(f"spline-net {precision:9} {speed:8.0f} pixels/s, {speed / paper:.0f} times the paper's{auto}")
    if len(sys.argv) > 1:
        seconds = []
        for _ in range(3):
            with tempfile.TemporaryDirectory() as out:
                command = [
                    sys.executable,
                    "-m",
                    "splinecli",
                    "infer",
                    sys.argv[1],
                    "--n-lights",
                    "10",
                    "-o",
                    out,
                ]
                started = time.perf_counter()
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                seconds.append(time.perf_counter() - started)
        print(f"infer {sys.argv[1]}: {statistics.median(seconds):.1f} s")


if __name__ == "__main__":
    main()
