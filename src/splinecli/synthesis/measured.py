"""Measured reflectances: small networks fitted to the MERL materials.

They add materials to the training pixels that no formula describes. The data are 100 isotropic materials from
Matusik, Pfister, Brand and McMillan, "A Data-Driven Reflectance Model", SIGGRAPH 2003. The networks are those of
Sztrajman, Rainer, Ritschel and Weyrich, "Neural BRDF Representation and Importance Sampling", Computer Graphics Forum
40(6), 2021. They map the half vector and the difference vector (Rusinkiewicz, "A New Change of Variables for Efficient
BRDF Representation", 1998) to the BRDF in RGB, in 1 / sr, without the cosine. measured_files.py reads their files,
which docs/files-and-frames.md describes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Natural logarithm of the highest BRDF + 1, 22,000 / sr, so that the output of a damaged network stays finite.
_HIGHEST_LOG = 10.0
# cos 80 degrees. With light and view more than 160 degrees apart, the MERL data are extrapolated and the highlights
# of the networks grow without bound. The value at 160 degrees is used there.
_LOWEST_L_DOT_H = math.cos(math.radians(80))
# Evaluations at a time. On a CPU the hidden layers should fit in its cache.
_AT_ONCE_CPU = 1 << 16
_AT_ONCE_ELSEWHERE = 1 << 22


@dataclass(frozen=True)
class MeasuredLibrary:
    """M measured materials on one device.

    Attributes:
        names: names of the materials, in the order of the file.
        layers: the three layers of the networks, (M, H + 1, 6), (M, H' + 1, H + 1) and (M, 3, H' + 1). One input, and
            one hidden unit of each layer, is always 1. Its weights are the biases.
        albedos: reflected share of diffuse light, for each channel, (M, 3).
        brightest: largest reflected share of the light from one direction, for each channel, (M, 3).
        dropped: the materials of the file that were left out, with the reason.
    """

    names: tuple[str, ...]
    layers: tuple[Tensor, Tensor, Tensor]
    albedos: Tensor
    brightest: Tensor
    dropped: Mapping[str, str]

    def as_measured(self, names: Sequence[str]) -> MeasuredMaterial:
        """Return a pixel of each named material, gray as the mean of its channels.

        Raises:
            ValueError: there is no material of that name.
        """
        index = torch.tensor([self.names.index(name) for name in names], device=self.albedos.device)
        return MeasuredMaterial(self, index, self.albedos.new_full((len(index), 3), 1 / 3))

    def draw(self, pixels: int, generator: torch.Generator) -> MeasuredMaterial:
        """Draw materials uniformly from the library and vary their gray value and brightness.

        The gray value is a random mix of the three channels. This imitates other cameras, lights and pigments. The
        weights are uniform over all that sum to 1. The scale is 2^U(-1, 1.5), because the whites of MERL reflect at
        most a third of the light. It is limited so that no material reflects more light than it receives.
        """
        device = self.albedos.device
        index = torch.randint(len(self.names), (pixels,), generator=generator, device=device)
        # Exponential variates over their sum are uniform over the simplex.
        mix = -torch.rand(pixels, 3, generator=generator, device=device).clamp(min=1e-7).log()
        mix = mix / mix.sum(dim=1, keepdim=True).clamp(min=1e-7)
        scale = 2 ** (2.5 * torch.rand(pixels, 1, generator=generator, device=device) - 1)
        brightest = (mix * self.brightest[index]).sum(dim=1, keepdim=True)
        return MeasuredMaterial(self, index, mix * torch.minimum(scale, 1 / brightest.clamp(min=1e-7)))


@dataclass(frozen=True)
class MeasuredMaterial:
    """Materials of P pixels.

    Attributes:
        library: all materials.
        index: (P,) positions in the library.
        weights: (P, 3) weights of the channels in the gray value.
    """

    library: MeasuredLibrary
    index: Tensor
    weights: Tensor

    def take(self, pixels: slice | Tensor) -> MeasuredMaterial:
        """Return the materials of some of the pixels."""
        return MeasuredMaterial(self.library, self.index[pixels], self.weights[pixels])

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """Return pi times the reflected radiance, (P, D); arguments as in Material.shade, float32.

        The BRDF is reciprocal: exchanging light and view changes it by rounding errors only.
        """
        l_dot_v = l_dot_v.expand_as(n_dot_l)
        brdf = torch.empty_like(n_dot_l)
        at_once = _AT_ONCE_CPU if n_dot_l.device.type == "cpu" else _AT_ONCE_ELSEWHERE
        # The layers of a pixel take as much memory as about twenty directions.
        step = max(1, at_once // (n_dot_l.shape[1] + 20))
        for first in range(0, len(n_dot_l), step):
            some = slice(first, first + step)
            vectors = half_and_difference(n_dot_l[some], n_dot_v[some], l_dot_v[some])
            colours = evaluate([layer[self.index[some]] for layer in self.library.layers], vectors)
            brdf[some] = (self.weights[some, None] @ colours)[:, 0]
        return math.pi * brdf * n_dot_l.clamp(min=0)

    def albedo(self) -> Tensor:
        """Return the reflected share of diffuse light, (P, 1)."""
        return (self.weights * self.library.albedos[self.index]).sum(dim=1, keepdim=True)


def half_and_difference(n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
    """Return the input of the networks (P, 6, D): the half vector (sin, 1, cos) and the difference vector.

    The azimuth of the half vector is 0. Its y is not needed and is set to 1, the factor of the biases. The difference
    vector is the light direction after the rotation that brings the half vector to the z axis. An isotropic,
    reciprocal BRDF does not change when light and view, or left and right, are exchanged. So x <= 0 <= y is chosen:
    of light and view, the direction nearer to the normal is used as the light, because the training of the networks
    weighted errors by the light's cosine.

    Args:
        n_dot_l, n_dot_v, l_dot_v: cosines between normal, light and view, (P, D).
    """
    l_dot_h = ((1 + l_dot_v) / 2).clamp(min=1e-6).sqrt()
    n_dot_h = ((n_dot_l + n_dot_v) / (2 * l_dot_h)).clamp(0, 1)
    sine_h = (1 - n_dot_h * n_dot_h).sqrt()
    l_dot_h = l_dot_h.clamp(_LOWEST_L_DOT_H, 1)
    sine_d = (1 - l_dot_h * l_dot_h).sqrt()
    # n.v - n.l = 2 sin(theta_h) sin(theta_d) cos(phi_d)
    x = -torch.minimum((n_dot_v - n_dot_l).abs() / (2 * sine_h).clamp(min=1e-6), sine_d)
    y = (sine_d * sine_d - x * x).clamp(min=0).sqrt()
    return torch.stack((sine_h, torch.ones_like(x), n_dot_h, x, y, l_dot_h), dim=1)


def evaluate(layers: Sequence[Tensor], vectors: Tensor) -> Tensor:
    """Return the channels of the BRDF (P, 3, D), in 1 / sr, from layers (P, out, in) and vectors (P, 6, D)."""
    first, second, last = layers
    hidden = torch.bmm(first, vectors).relu_()
    hidden = torch.bmm(second, hidden).relu_()
    return torch.bmm(last, hidden).clamp_(max=_HIGHEST_LOG).expm1_().relu_()
