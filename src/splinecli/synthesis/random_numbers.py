"""Random numbers of a range, from a generator."""

from __future__ import annotations

import torch
from torch import Tensor


def draw_uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Draw numbers from U(low, high) on the generator's device."""
    return torch.rand(*shape, generator=generator, device=generator.device) * (high - low) + low


def draw_number(generator: torch.Generator, low: float = 0.0, high: float = 1.0) -> float:
    """Draw one number from U(low, high)."""
    return low + (high - low) * float(torch.rand((), generator=generator))
