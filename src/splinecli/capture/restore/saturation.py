"""Saturated observations: told by the stored values, and put back as bright as the pixel's others say they were."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.restore.robust_fit import absolute_weights, predict, shadow_weights

ITERATIONS = 100
STEP = 1.6
"""Restored values go this share of the way to the fit's at each iteration: beyond it, which saves half of them."""

BRIGHTEST = 8.0
"""No observation is restored to more than this many times the pixel's brightest as stored."""

_TILE_PIXELS = 8192


def find_saturated(pixels: NDArray[Any]) -> NDArray[np.bool_]:
    """Which stored pixels (P, C) have a channel at full scale, (P,); of floating-point ones none."""
    if pixels.dtype.kind != "u":
        return np.zeros(len(pixels), np.bool_)
    full: NDArray[np.bool_] = (pixels == np.iinfo(pixels.dtype).max).any(axis=1)
    return full


def restore_saturated(
    observations: NDArray[np.float32], saturated: NDArray[np.bool_], light_directions: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Put estimates in the place of saturated observations (P, F), in the array itself.

    What a saturated observation was is not known, but that it was at least so bright is: each becomes the prediction
    of a robust Lambertian fit to the pixel (least absolute deviations by reweighting) or its stored value, whichever is
    brighter; the fit is made of the restored values in turn, so that a saturated one pulls at it from below alone.
    Leaving them out would leave a pixel with its darkest observations, and taking them as they are would bend its
    normal to the lights' middle: docs/measurements.md has figures. Pixels that are saturated under every light stay.

    Args:
        saturated: (P, F).
        light_directions: (F, 3), unit.
    """
    lights = light_directions.astype(np.float32)
    everywhere = np.asarray(saturated.all(axis=1))
    rows = np.flatnonzero(saturated.any(axis=1) & ~everywhere)
    for start in range(0, len(rows), _TILE_PIXELS):
        tile = rows[start : start + _TILE_PIXELS]
        observations[tile] = _restored(observations[tile], saturated[tile], lights)
    return saturated & ~everywhere[:, None] if len(rows) else None


def _restored(
    stored: NDArray[np.float32], saturated: NDArray[np.bool_], lights: NDArray[np.float32]
) -> NDArray[np.float32]:
    scale = stored.max(axis=1, keepdims=True)
    scale[scale <= 0] = 1
    lowest = stored / scale
    values = lowest
    lit = shadow_weights(lowest)
    weights = lit
    for _ in range(ITERATIONS):
        predicted = predict(values, weights, lights)
        further = np.clip(values + np.float32(STEP) * (predicted - values), lowest, BRIGHTEST)
        values = np.where(saturated, further, lowest)
        weights = lit * absolute_weights(predicted - values)
    # Not below what is stored, by a rounding either.
    restored: NDArray[np.float32] = np.where(saturated, np.maximum(values * scale, stored), stored)
    return restored
