"""Uniform random numbers from a generator, and the seeds of generators."""

import numpy as np
import torch
from torch import Tensor


def draw_uniform(
    generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0
) -> Tensor:
    """Draw numbers from U(low, high) on the generator's device."""
    return torch.rand(*shape, generator=generator, device=generator.device) * (high - low) + low


def draw_number(generator: torch.Generator, low: float = 0.0, high: float = 1.0) -> float:
    """Draw one number from U(low, high)."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def stream_seed(*numbers: int) -> int:
    """Return the seed of a random stream from its numbers, such as the run's seed, the step and the
    stream index.

    The draws of a step depend on these numbers alone, so they are the same in a resumed run, or if
    the run is divided differently among processes.
    """
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)
