"""Measure the error of weights on spheres of measured materials, which training has not seen.

    python benchmarks/measured_spheres.py MATERIALS.npz LIGHTS.txt --weights spline-net [--draws 4]
    [--pixels 256]

Each material gives a sphere under ten of the lights (seed 0), without shadows, noise and errors of
calibration. Prints the mean angular error over all materials and pixels, and the materials with the
largest errors.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.workshop.synthesis.pixels import draw_visible_normals

N_LIGHTS = 10
_IMPLAUSIBLE = ("black-obsidian", "brass", "chrome-steel", "grease-covered-steel", "ss440")
"""Mirrors, whose published networks reflect more than all light, are black, or are not reciprocal.
"""

_HIGHEST_LOG = 10.0  # natural logarithm of the highest BRDF + 1
# cos 80 degrees. With light and view more than 160 degrees apart, the MERL data are extrapolated
# and the highlights of the networks grow without bound. The value at 160 degrees is used there.
_LOWEST_L_DOT_H = math.cos(math.radians(80))


class Materials(NamedTuple):
    """M measured materials: their names, and the layers w1, b1, w2, b2, w3, b3 of their networks,
    (M, ...).
    """

    names: list[str]
    layers: list[Tensor]

    def shade(self, index: Tensor, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """Return pi times the reflected radiance (P, D) of the materials of index (P,), gray.

        The input of the networks is the half vector, rotated to azimuth zero, and the difference
        vector: the light direction after the rotation that brings the half vector to the z axis
            (Rusinkiewicz, 1998). Exchanging light
        and view, or left and right, changes nothing. The direction nearer to the normal is used as
        the light.

        Args:
            n_dot_l, n_dot_v, l_dot_v: cosines, (P, D), (P, 1) and (D).
        """
        l_dot_h = ((1 + l_dot_v) / 2).clamp(min=1e-6).sqrt().expand_as(n_dot_l)
        n_dot_h = ((n_dot_l + n_dot_v) / (2 * l_dot_h)).clamp(0, 1)
        sine_h = (1 - n_dot_h * n_dot_h).sqrt()
        l_dot_h = l_dot_h.clamp(_LOWEST_L_DOT_H, 1)
        sine_d = (1 - l_dot_h * l_dot_h).sqrt()
        # n.v - n.l = 2 sin(theta_h) sin(theta_d) cos(phi_d)
        x = -torch.minimum((n_dot_v - n_dot_l).abs() / (2 * sine_h).clamp(min=1e-6), sine_d)
        y = (sine_d * sine_d - x * x).clamp(min=0).sqrt()
        value = torch.stack((sine_h, torch.zeros_like(x), n_dot_h, x, y, l_dot_h), dim=-1)
        w1, b1, w2, b2, w3, b3 = (layer[index] for layer in self.layers)
        for weight, bias in ((w1, b1), (w2, b2)):
            value = torch.baddbmm(bias[:, None], value, weight).relu_()
        brdf = (
            torch.baddbmm(b3[:, None], value, w3)
            .clamp_(max=_HIGHEST_LOG)
            .expm1_()
            .relu_()
            .mean(dim=-1)
        )
        return math.pi * brdf * n_dot_l.clamp(min=0)


def read_materials(path: Path) -> Materials:
    """Read the plausible networks of a file, float32.

    They map half and difference vector to the BRDF in RGB: max(exp(x) - 1, 0), in 1 / sr, without
    the cosine. The file is an .npz archive of `names` (M), `W1` (M, 6, H), `b1` (M, H), `W2` (M, H,
    K), `b2` (M, K), `W3` (M, K, 3) and `b3` (M, 3), as Sztrajman et al. published them ("Neural
    BRDF Representation and Importance Sampling", CGF 2021) for the materials of MERL (Matusik et
    al., SIGGRAPH 2003).
    """
    with np.load(path, allow_pickle=False) as arrays:
        names = [str(name) for name in arrays["names"]]
        kept = [place for place, name in enumerate(names) if name not in _IMPLAUSIBLE]
        keys = ("W1", "b1", "W2", "b2", "W3", "b3")
        layers = [torch.from_numpy(arrays[key][kept].astype(np.float32)) for key in keys]
    return Materials([names[place] for place in kept], layers)


@torch.inference_mode()
def errors_deg(
    network: SplineNet, materials: Materials, lights: Tensor, draws: int, pixels: int
) -> Tensor:
    """Return the mean error of each of M materials (M,) in degrees,
    over random normals and lights.
    """
    generator = torch.Generator().manual_seed(0)
    index = torch.arange(len(materials.names)).repeat_interleave(pixels)
    total = torch.zeros(len(materials.names))
    for _ in range(draws):
        drawn = lights[torch.randperm(len(lights), generator=generator)[:N_LIGHTS]]
        normals = draw_visible_normals(len(index), generator)
        found = []
        for rows in torch.arange(len(index)).split(pixels):  # a capture each
            seen = normals[rows]
            radiance = materials.shade(index[rows], seen @ drawn.T, seen[:, 2:], drawn[:, 2])
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
    parser.add_argument("--pixels", type=int, default=256)
    options = parser.parse_args(arguments)
    materials = read_materials(options.materials)
    lights = torch.nn.functional.normalize(
        torch.from_numpy(np.loadtxt(options.lights)).float(), dim=-1
    )
    for weights in options.weights or ["spline-net"]:
        network = resolve_weights(weights).network.eval()
        found = errors_deg(network, materials, lights, options.draws, options.pixels)
        worst = ", ".join(
            f"{materials.names[i]} {found[i]:.1f}" for i in found.argsort(descending=True)[:5]
        )
        print(f"{weights}: {found.mean():.2f} degrees; largest: {worst}")


if __name__ == "__main__":
    main()
