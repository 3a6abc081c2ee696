"""Lambertian predictions by weighted least squares, from which saturation and light intensities are estimated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.solve_3x3 import inverse_3x3, multiply_symmetric

SHADOW_SHARE = 0.05
"""Observations below this share of a pixel's largest one count as shadow."""

_PRIOR = 1e-6  # pulls towards a black pixel, so that a pixel without three lit observations has a solution
_EQUAL_WEIGHT_BELOW = 0.02
"""Residuals far below this share of a pixel's largest observation have nearly equal weights."""

Array = NDArray[np.floating]


def shadow_weights(observations: Array) -> Array:
    """Return weights (P, F): 1 for lit observations, nearly 0 for shadows.

    Args:
        observations: (P, F), each pixel scaled to a largest value of 1.
    """
    return np.where(observations < SHADOW_SHARE, 1e-3, 1.0).astype(observations.dtype)


def predict(observations: Array, weights: Array, light_directions: Array) -> Array:
    """Return what matte pixels would show (P, F): I = l . b, where b minimises the weighted squared residuals.

    Args:
        observations, weights: (P, F).
        light_directions: (F, 3) or (P, F, 3), unit.
    """
    scaled_normals = fit_scaled_normals(observations, weights, light_directions)
    if light_directions.ndim == 2:
        return np.asarray(scaled_normals @ light_directions.T)
    return np.asarray((light_directions @ scaled_normals[..., None])[..., 0])


def fit_scaled_normals(
    observations: Array, weights: Array, light_directions: Array, *, prior: float = _PRIOR
) -> Array:
    """Return the scaled normals b (P, 3) of matte pixels that minimise the weighted squared residuals of I = l . b.

    The arguments are those of predict. `prior` pulls b towards 0.
    """
    x, y, z = np.moveaxis(light_directions, -1, 0)
    products = np.stack((x * x, y * y, z * z, x * y, x * z, y * z), axis=-1)
    xx, yy, zz, xy, xz, yz = _sum_over_lights(weights, products).T
    covariance = inverse_3x3((xx + prior, yy + prior, zz + prior, xy, xz, yz), prior)
    right_side = _sum_over_lights(weights * observations, light_directions)
    return np.stack(multiply_symmetric(covariance, tuple(right_side.T)), axis=1)


def _sum_over_lights(values: Array, terms: Array) -> Array:
    """Return the sums (P, K) of values (P, F) times terms (F, K) or (P, F, K)."""
    return values @ terms if terms.ndim == 2 else (values[:, None] @ terms)[:, 0]


def absolute_weights(residuals: Array) -> Array:
    """Return weights with which the next weighted least squares approximates least absolute deviations."""
    weights: Array = 1 / (np.abs(residuals) + _EQUAL_WEIGHT_BELOW)
    return weights
