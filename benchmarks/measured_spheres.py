"""Measure the error of weights on spheres of measured materials, which training has not seen.

    python benchmarks/measured_spheres.py MATERIALS.npz LIGHTS.txt --weights spline-net [--draws 4] [--pixels 40]

Each material gives a sphere under ten of the lights (seed 0), without shadows, noise and errors of calibration. Prints
the mean angular error over all materials and pixels, and the materials with the largest errors.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import resolve_weights
from splinecli.synthesis.measured import MeasuredLibrary
from splinecli.synthesis.measured_files import read_measured
from splinecli.synthesis.pixels import draw_visible_normals

N_LIGHTS = 10
_BATCH_PIXELS = 2048


@torch.inference_mode()
def errors_deg(
    network: SplineNet, library: MeasuredLibrary, lights: Tensor, draws: int, pixels: int
) -> Tensor:
    """Return the mean error of each material of the library (M,) in degrees, over random normals and lights."""
    generator = torch.Generator().manual_seed(0)
    names = [name for name in library.names for _ in range(pixels)]
    material = library.as_measured(names)
    total = torch.zeros(len(library.names))
    for _ in range(draws):
        drawn = lights[torch.randperm(len(lights), generator=generator)[:N_LIGHTS]]
        normals = draw_visible_normals(len(names), generator)
        found = []
        for rows in torch.arange(len(names)).split(_BATCH_PIXELS):
            seen = normals[rows]
            radiance = material.take(rows).shade(seen @ drawn.T, seen[:, 2:], drawn[:, 2]).clamp(min=0)
            found.append(network(radiance, drawn).normals)
        cosine = (torch.cat(found) * normals).sum(dim=1).clamp(-1, 1)
        total += torch.rad2deg(cosine.acos()).view(-1, pixels).mean(dim=1) / draws
    return total


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("materials", type=Path, help="file of measured materials")
    parser.add_argument("lights", type=Path, help="light directions, x y z a line")
    parser.add_argument("--weights", action="append", help="shipped name or file; may be repeated")
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--pixels", type=int, default=40)
    options = parser.parse_args(arguments)
    library = read_measured(options.materials)
    lights = torch.nn.functional.normalize(torch.from_numpy(np.loadtxt(options.lights)).float(), dim=-1)
    for weights in options.weights or ["spline-net"]:
        network = resolve_weights(weights).network.eval()
        found = errors_deg(network, library, lights, options.draws, options.pixels)
        worst = ", ".join(f"{library.names[i]} {found[i]:.1f}" for i in found.argsort(descending=True)[:5])
        print(f"{weights}: {found.mean():.2f} degrees; largest: {worst}")


if __name__ == "__main__":
    main()
