"""Transfer curves between linear and stored values: sRGB (IEC 61966-2-1), gamma curves and tables."""

import re

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import UsageError

_LINEAR_BELOW = 0.0031308  # linear value below which the sRGB curve is a straight line

AUTOMATIC = "auto"
"""The curve that the images state: that of a colour profile, sRGB for JPEG and PNG that says so, linear for others."""

TransferCurve = float | tuple[float, ...] | None
"""An exponent (1 is linear), None for sRGB, or a table: the linear values of evenly spaced stored values, 0 to 1."""

SRGB: TransferCurve = None


def _decode_bt709(stored: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(stored < 0.081, stored / 4.5, ((stored + 0.099) / 1.099) ** (1 / 0.45))


BT709: TransferCurve = tuple(_decode_bt709(np.linspace(0, 1, 256)).tolist())
"""The curve of most films (ITU-R BT.709), for values of 8 bits."""

GAMMAS = 0.1, 10.0
"""The smallest and the largest exponent."""


def encode_srgb(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode linear values as 8-bit sRGB; values outside 0 to 1 are clipped."""
    values = np.clip(linear, 0, 1)
    power = 1.055 * np.maximum(values, _LINEAR_BELOW) ** (1 / 2.4) - 0.055
    encoded: NDArray[np.uint8] = np.rint(255 * np.where(values <= _LINEAR_BELOW, 12.92 * values, power)).astype(
        np.uint8
    )
    return encoded


def parse_transfer(text: str) -> float | None:
    """Parse the name of a transfer curve: G for "gamma:G", 1 for "linear" and AUTOMATIC, None for "srgb".

    Raises:
        UsageError: the name is unknown, or G is not between 0.1 and 10.
    """
    named: dict[str, float | None] = {AUTOMATIC: 1.0, "linear": 1.0, "srgb": None}
    if text in named:
        return named[text]
    if match := re.fullmatch(r"gamma:([0-9.]+)", text):
        try:
            gamma = float(match[1])
        except ValueError:
            gamma = 0.0
        if GAMMAS[0] <= gamma <= GAMMAS[1]:
            return gamma
    raise UsageError(f"the transfer curve is {text!r}; expected auto, linear, srgb, or gamma:G with G from 0.1 to 10")


def decode_transfer(stored: NDArray[np.float32], curve: TransferCurve) -> NDArray[np.float32]:
    """Decode stored values, 0 to 1, to linear ones."""
    if curve == 1:
        return stored
    if isinstance(curve, tuple):
        return np.interp(stored, np.linspace(0, 1, len(curve)), curve).astype(np.float32)
    if curve is not None:
        return np.asarray(stored**curve, np.float32)
    power = ((stored + 0.055) / 1.055) ** 2.4
    return np.where(stored <= 12.92 * _LINEAR_BELOW, stored / 12.92, power).astype(np.float32)
