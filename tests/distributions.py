"""Draws of many values, compared with the distribution that they come from."""

import numpy as np
import torch
from scipy import stats

# settings of CaptureConfig
FAULTLESS = {
    "light_direction_error_share": 0.0,
    "light_intensity_error_share": 0.0,
    "saturated_share": 0.0,
    "sensor_noise": False,
}
N = 20_000
# Four standard deviations of a share of 20 000.
SHARE = 0.015


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def assert_uniform(values, low, high):
    flat = np.asarray(values, np.float64).ravel()
    margin = 1e-4 * (high - low)
    assert flat.min() >= low - margin
    assert flat.max() <= high + margin
    assert stats.kstest(flat, stats.uniform(low, high - low).cdf).pvalue > 1e-3


def share(flags):
    """The share of flags that are set."""
    return flags.double().mean().item()
