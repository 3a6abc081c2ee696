"""Lambertian predictions of observations by weighted least squares: what saturation and light strengths are told by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.solve_3x3 import inverse_3x3, multiply_symmetric

SHADOW_SHARE = 0.05
"""Of a pixel's largest observation: what is darker is taken for shadow."""

_PRIOR = 1e-6  # towards a black pixel, so that one without three lit lights is solvable
_EVEN = 0.02
"""Residuals, as shares of a pixel's largest observation, far below which all weigh alike."""

Array = NDArray[np.floating]


def shadow_weights(observations: Array) -> Array:
    """1 for lit observations (P, F), next to nothing for shadows; each pixel is scaled to a largest value of 1."""
    return np.where(observations < SHADOW_SHARE, 1e-3, 1.0).astype(observations.dtype)


def predict(observations: Array, weights: Array, light_directions: Array) -> Array:
    """What the best matte pixels show: I = l . b with b of weighted least squares, (P, F)."""
    x, y, z = light_directions.T
    products = np.stack((x * x, y * y, z * z, x * y, x * z, y * z), axis=1)
    xx, yy, zz, xy, xz, yz = (weights @ products).T
    covariance = inverse_3x3((xx + _PRIOR, yy + _PRIOR, zz + _PRIOR, xy, xz, yz), _PRIOR)
    right_side = (weights * observations) @ light_directions
    scaled_normals = np.stack(multiply_symmetric(covariance, tuple(right_side.T)), axis=1)
    predicted: Array = scaled_normals @ light_directions.T
    return predicted


def absolute_weights(residuals: Array) -> Array:
    """Weights by which the next least squares are least absolute deviations, nearly."""
    weights: Array = 1 / (np.abs(residuals) + _EVEN)
    return weights
