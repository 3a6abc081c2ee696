"""Random light rigs: the number of lights of a pixel and their directions."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def draw_light_counts(pixels: int, low: int, high: int, usual: int, generator: torch.Generator) -> Tensor:
    """Draw the number of lights of each pixel (P,). Within a draw they differ by at most a fifth.

    Each draw has a largest number. For half of the draws it is usual - 1 to usual + 2, else it is log-uniform over
    low..high. The pixels have four fifths of that number or more, which saves padding.
    """
    device = generator.device

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    anywhere = low * ((high + 1) / low) ** uniform(1)
    about = usual - 1 + 4 * uniform(1)
    largest = torch.where(uniform(1) < 0.5, about, anywhere).floor().clamp(low, high)
    return (largest * (1 - 0.2 * uniform(pixels))).round().long().clamp(low, high)


def draw_light_directions(pixels: int, lights: int, generator: torch.Generator) -> Tensor:
    """Draw unit light directions (P, F, 3), a rig for each pixel.

    The lights of a rig fill an ellipse in the (x, y) disc uniformly, by projected area. One half-axis is sin U(20, 88)
    degrees, the other U(0.5, 1) of it, and the ellipse is turned at random. The centre of half of the rigs is moved by
    up to 0.35 (1 - 0.6 half-axis), as on a copy stand, a shelf, or with a lamp above. Lights outside 0.996 of the
    disc are moved to its rim.
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
