"""Saturated observations: find them, and replace them by estimates from the pixel's other observations."""

from collections.abc import Callable
from functools import reduce

import numpy as np

from splinecli.fits.robust import absolute_weights, fit_scaled_normals, shade, shadow_weights
from splinecli.maths import Array, Bools, Doubles, Integers, Singles

ITERATIONS = 16  # Fits to a pixel. More change the restored values by less than the fit's own error.

RAISED_WEIGHT = np.float32(0.1)
"""Weight of an observation that the last fit raised; one that the fit meets has 50. It determines nothing but what the
others leave open."""

MAX_BRIGHTENING = 8.0  # no observation is restored to more than this many times the pixel's brightest stored one

_TILE_PIXELS = 8192

LightsOf = Callable[[Integers], Doubles]
"""From p rows of the observations to light vectors (F, 3) or (p, F, 3), whose products with its scaled normal a matte
pixel shows."""


def find_saturated(pixels: Array) -> Bools:
    """Return which stored pixels (P, C) have a channel at full scale, (P,). Floating-point pixels have none."""
    if pixels.dtype.kind != "u":
        return np.zeros(len(pixels), np.bool_)
    return in_any_channel(pixels == np.iinfo(pixels.dtype).max)


def in_any_channel(flags: Bools) -> Bools:
    """Return flags.any(axis=1) of flags (P, C), C at most 3, several times as fast."""
    return np.asarray(reduce(np.logical_or, flags.T))


def restore_saturated(observations: Singles, saturated: Bools, lights: Doubles | LightsOf) -> Bools | None:
    """Replace saturated observations (P, F) by estimates, in place; return which were replaced, or None.

    A saturated observation was at least as bright as stored. Its estimate is the prediction of a robust Lambertian fit
    to the pixel (least absolute deviations by reweighting) or the stored value, whichever is brighter. The fit is
    repeated on the restored values, so a saturated observation can only raise it. Without this, a pixel would either
    lose its brightest observations, or its normal would tilt towards the mean of the lights (figures in
    docs/measurements.md). Pixels that are saturated under every light stay as they are.

    Args:
        saturated: (P, F).
        lights: unit light directions (F, 3), or see LightsOf.
    """
    everywhere = np.asarray(saturated.all(axis=1))
    rows = np.flatnonzero(saturated.any(axis=1) & ~everywhere)
    for start in range(0, len(rows), _TILE_PIXELS):
        tile = rows[start : start + _TILE_PIXELS]
        own = lights(tile) if callable(lights) else lights
        observations[tile] = _restored(observations[tile], saturated[tile], own.astype(np.float32))
    return saturated & ~everywhere[:, None] if len(rows) else None


def _restored(stored: Singles, saturated: Bools, lights: Singles) -> Singles:
    scale = stored.max(axis=1, keepdims=True)
    scale[scale <= 0] = 1
    values = lowest = stored / scale
    weights = lit = shadow_weights(lowest)
    for _ in range(ITERATIONS):
        predicted = shade(fit_scaled_normals(values, weights, lights), lights)
        residuals = predicted - lowest
        raised = saturated & (residuals > 0)
        values = np.where(raised, np.minimum(predicted, MAX_BRIGHTENING), lowest)
        weights = lit * np.where(raised, RAISED_WEIGHT, absolute_weights(residuals))
    # Rounding must not make a value darker than stored.
    return np.asarray(np.where(saturated, np.maximum(values * scale, stored), stored))
