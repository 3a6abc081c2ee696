"""Between linear values and what is stored for a screen: the transfer curve of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LINEAR_BELOW = 0.0031308


def encode_srgb(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Linear values, cut off at 0 and 1, as 8-bit sRGB."""
    values = np.clip(linear, 0, 1)
    power = 1.055 * np.maximum(values, _LINEAR_BELOW) ** (1 / 2.4) - 0.055
    encoded: NDArray[np.uint8] = np.rint(
        255 * np.where(values <= _LINEAR_BELOW, 12.92 * values, power)
    ).astype(np.uint8)
    return encoded
