"""Random light rigs: how many lights a pixel has and where they stand."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def draw_light_counts(pixels: int, low: int, high: int, usual: int, generator: torch.Generator) -> Tensor:
    """Number of lights of each pixel (P,): `usual` for 30 %, else log-uniform over low..high."""
    device = generator.device
    exponent = torch.rand(pixels, generator=generator, device=device)
    counts = (low * ((high + 1) / low) ** exponent).long().clamp(low, high)
    plain = torch.rand(pixels, generator=generator, device=device) < 0.3
    return torch.where(plain, torch.full_like(counts, usual), counts)


def draw_light_directions(pixels: int, lights: int, generator: torch.Generator) -> Tensor:
    """Unit light directions (P, F, 3), a rig of its own for each pixel.

    A rig's lights fall uniformly, by projected area, into an ellipse of the (x, y) disc: half-axis sin U(20,
    88) degrees, the other U(0.5, 1) of it, turned at random. Half of the rigs lean: their centre is moved by
    up to 0.35 (1 - 0.6 half-axis), as on a copy stand, a shelf, or with a lamp held above; what then lies
    outside 0.996 of the disc is drawn in to its rim.
    """
    device = generator.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    radius = torch.sqrt(uniform(pixels, lights))
    angle = 2 * math.pi * uniform(pixels, lights)
    major = torch.sin(torch.deg2rad(20 + 68 * uniform(pixels, 1)))
    along, across = (
        radius * angle.cos() * major,
        radius * angle.sin() * major * (0.5 + 0.5 * uniform(pixels, 1)),
    )
    turn = 2 * math.pi * uniform(pixels, 1)
    x = turn.cos() * along - turn.sin() * across
    y = turn.sin() * along + turn.cos() * across
    lean = (uniform(pixels, 1) < 0.5) * uniform(pixels, 1) * 0.35 * (1 - 0.6 * major)
    lean_azimuth = 2 * math.pi * uniform(pixels, 1)
    x, y = x + lean * lean_azimuth.cos(), y + lean * lean_azimuth.sin()
    distance = torch.sqrt(x * x + y * y)
    shrink = (0.996 / distance.clamp(min=1e-6)).clamp(max=1)
    x, y = x * shrink, y * shrink
    return torch.stack((x, y, (1 - x * x - y * y).clamp(min=0).sqrt()), dim=-1)
