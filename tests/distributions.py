"""Draws of many values, compared with the distribution that they come from."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

N = 20_000
# Four standard deviations of a share of 20 000.
SHARE = 0.015


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def assert_uniform(values: Tensor | NDArray[Any], low: float, high: float) -> None:
    flat = np.asarray(values, np.float64).ravel()
    margin = 1e-4 * (high - low)
    assert flat.min() >= low - margin
    assert flat.max() <= high + margin
    assert stats.kstest(flat, stats.uniform(low, high - low).cdf).pvalue > 1e-3


def share(flags: Tensor) -> float:
    """The share of flags that are set."""
    return flags.double().mean().item()
