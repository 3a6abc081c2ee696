"""Measured reflectances: small networks fitted to the MERL materials, for pixels that a formula cannot draw.

Data: Matusik, Pfister, Brand and McMillan, "A Data-Driven Reflectance Model", SIGGRAPH 2003 (100 isotropic
materials). Networks: Sztrajman, Rainer, Ritschel and Weyrich, "Neural BRDF Representation and Importance
Sampling", Computer Graphics Forum 40(6), 2021: from the half vector and the difference vector (Rusinkiewicz, "A
New Change of Variables for Efficient BRDF Representation", 1998) to the BRDF in RGB, 1 / sr, without the cosine.
The files that hold them (docs/files-and-frames.md) are read and checked in measured_files.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Natural logarithm of the highest BRDF + 1, 22,000 / sr: what a damaged network says stays finite.
_HIGHEST_LOG = 10.0
# cos 80 degrees. Where light and view are further than 160 degrees apart, MERL itself is extrapolated and the
# networks' highlights grow without bound; there the value at 160 degrees is taken.
_LOWEST_L_DOT_H = math.cos(math.radians(80))
# Evaluations at a time: on a processor the hidden layers are to stay in its cache.
_AT_ONCE_CPU = 1 << 16
_AT_ONCE_ELSEWHERE = 1 << 22


@dataclass(frozen=True)
class MeasuredLibrary:
    """M measured materials on one device.

    Attributes:
        names: of the materials, in the file's order.
        layers: the networks' three layers, (M, H + 1, 6), (M, H' + 1, H + 1) and (M, 3, H' + 1); the biases
            are the weights of an input, and of a hidden unit in each layer, that is always 1.
        albedos: of the three channels, averaged over view and light, cosine-weighted (M, 3).
        brightest: of the three channels, the largest share thrown back of the light from one direction (M, 3).
        dropped: the file's other materials and what is wrong with them.
    """

    names: tuple[str, ...]
    layers: tuple[Tensor, Tensor, Tensor]
    albedos: Tensor
    brightest: Tensor
    dropped: Mapping[str, str]

    def as_measured(self, names: Sequence[str]) -> MeasuredMaterial:
        """A pixel of each named material, gray as the mean of its channels. Raises ValueError for others."""
        index = torch.tensor([self.names.index(name) for name in names], device=self.albedos.device)
        return MeasuredMaterial(self, index, self.albedos.new_full((len(index), 3), 1 / 3))

    def draw(self, pixels: int, generator: torch.Generator) -> MeasuredMaterial:
        """Random materials, uniform over the library, each varied by a gray of its own and by its scale.

        The gray is a mix of the three channels with weights uniform over all that sum to 1: what another
        camera, light or pigment would show. The scale is 2^U(-1, 1.5), for MERL's whites throw back no more
        than a third; it ends where some direction's light would be thrown back whole.
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
    """P pixels of a library's materials: index (P,) into them, weights (P, 3) of the channels in the gray."""

    library: MeasuredLibrary
    index: Tensor
    weights: Tensor

    def take(self, pixels: slice | Tensor) -> MeasuredMaterial:
        """The materials of some of the pixels."""
        return MeasuredMaterial(self.library, self.index[pixels], self.weights[pixels])

    def shade(self, n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
        """pi times the reflected radiance (P, D); arguments as in Material.shade, float32.

        Exactly reciprocal: exchanging light and view changes the BRDF by nothing but rounding.
        """
        l_dot_v = l_dot_v.expand_as(n_dot_l)
        brdf = torch.empty_like(n_dot_l)
        at_once = _AT_ONCE_CPU if n_dot_l.device.type == "cpu" else _AT_ONCE_ELSEWHERE
        # A pixel's gathered layers weigh as much as some twenty directions.
        step = max(1, at_once // (n_dot_l.shape[1] + 20))
        for first in range(0, len(n_dot_l), step):
            some = slice(first, first + step)
            vectors = half_and_difference(n_dot_l[some], n_dot_v[some], l_dot_v[some])
            colours = evaluate([layer[self.index[some]] for layer in self.library.layers], vectors)
            brdf[some] = (self.weights[some, None] @ colours)[:, 0]
        return math.pi * brdf * n_dot_l.clamp(min=0)

    def albedo(self) -> Tensor:
        """Share of light from everywhere that is thrown back (P, 1)."""
        return (self.weights * self.library.albedos[self.index]).sum(dim=1, keepdim=True)


def half_and_difference(n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> Tensor:
    """What the networks read (P, 6, D): half vector (sin, 1, cos) and difference vector, from cosines (P, D).

    The half vector's azimuth is zero, so its y is unused and holds the 1 that multiplies the biases. The
    difference vector is the light's, turned so that the half vector is on the z axis. An isotropic, reciprocal
    BRDF does not know light from view nor left from right, so x <= 0 <= y: of the two directions, the less
    grazing one counts as the light, since in training errors weighed as the light's cosine.
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
    """The BRDF's channels (P, 3, D), 1 / sr, from layers (P, out, in) and vectors (P, 6, D)."""
    first, second, last = layers
    hidden = torch.bmm(first, vectors).relu_()
    hidden = torch.bmm(second, hidden).relu_()
    return torch.bmm(last, hidden).clamp_(max=_HIGHEST_LOG).expm1_().relu_()
