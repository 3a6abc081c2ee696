"""Lambertian predictions of observations by weighted least squares: what saturation and light strengths are told by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHADOW_SHARE = 0.05
"""Of a pixel's largest observation: what is darker is taken for shadow."""

_EVEN = 0.02
"""Residuals, as shares of a pixel's largest observation, far below which all weigh alike."""

Array = NDArray[np.float64]


def shadow_weights(observations: Array) -> Array:
    """1 for lit observations (P, F), next to nothing for shadows; each pixel is scaled to a largest value of 1."""
    return np.where(observations < SHADOW_SHARE, 1e-3, 1.0)


def predict(observations: Array, weights: Array, light_directions: Array) -> Array:
    """What the best matte pixels show: I = l . b with b of weighted least squares, (P, F)."""
    products = light_directions[:, :, None] * light_directions[:, None, :]
    matrix = (weights @ products.reshape(-1, 9)).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
    vector = (weights * observations) @ light_directions
    predicted: Array = np.linalg.solve(matrix, vector[..., None])[..., 0] @ light_directions.T
    return predicted


def absolute_weights(residuals: Array) -> Array:
    """Weights by which the next least squares are least absolute deviations, nearly."""
    weights: Array = 1 / (np.abs(residuals) + _EVEN)
    return weights
