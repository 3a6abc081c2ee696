"""Measure the pixels per second of the shipped network and of the paper's, and the whole `infer`
command.

python benchmarks/inference_speed.py [CAPTURE]

The networks run on the CPU, on --pixels generated pixels under ten random lights; the paper's
network, which is much slower, gets a thirty-second of them. Each figure is the median over
--repeats runs, after one warm-up. With a CAPTURE (such as DiLiGenT's catPNG), the whole command is
measured too, with ten lights, in processes of its own.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

import torch

from splinecli.estimate.methods.batched import NetworkEstimator
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import LoadedNetwork, resolve_weights
from splinecli.system.machine import Precision, choose_precision
from splinecli.workshop.synthesis.pixels import PixelGenerator, PixelGeneratorConfig


def pixels_per_second(
    loaded: LoadedNetwork, precision: Precision, pixels: int, repeats: int
) -> float:
    """Return the median speed over the repeats."""
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


def command_seconds(capture: str, repeats: int) -> float:
    """Return the median time of `splinecli infer CAPTURE --n-lights 10`."""
    seconds = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as out:
            command = [
                sys.executable,
                "-m",
                "splinecli",
                "infer",
                capture,
                "--n-lights",
                "10",
                "-o",
                out,
            ]
            started = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def speeds(pixels: int, repeats: int) -> dict[str, float]:
    """Return the pixels per second of the paper's layers, and of the shipped network in both number
    formats.
    """
    paper_network = (
        SplineNet(NetworkConfig(size="paper")).eval().to(memory_format=torch.channels_last)
    )
    paper = LoadedNetwork(paper_network, "paper", "")
    found = {
        "layers of the paper, float32": pixels_per_second(paper, "float32", pixels // 32, repeats)
    }
    shipped = resolve_weights("spline-net")
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    for precision in precisions:
        name = f"spline-net-pixelwise, {precision}"
        found[name] = pixels_per_second(shipped, precision, pixels, repeats)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", nargs="?")
    parser.add_argument("--pixels", type=int, default=16_384)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(arguments)
    chosen = choose_precision("auto", torch.device("cpu"))
    print(
        f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}; auto is"
        f" {chosen}"
    )
    found = speeds(options.pixels, options.repeats)
    first = next(iter(found.values()))
    for name, speed in found.items():
        print(f"{name:32} {speed:8.0f} pixels/s, {speed / first:.0f} times the paper's")
    if options.capture:
        print(f"infer {options.capture}: {command_seconds(options.capture, options.repeats):.1f} s")


if __name__ == "__main__":
    main()
