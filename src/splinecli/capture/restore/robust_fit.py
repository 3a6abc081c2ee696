"""Lambertian predictions of observations by weighted least squares: what saturation and light strengths are told by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
    products = np.stack((x * x, x * y, x * z, y * y, y * z, z * z), axis=1)
    a, b, c, d, e, f = (weights @ products).T
    a, d, f = a + _PRIOR, d + _PRIOR, f + _PRIOR
    # By Cramer's rule: for many systems of three equations a dozen times as fast as LAPACK.
    adjugate = (d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b)
    aa, ab, ac, bb, bc, cc = adjugate
    u, v, w = ((weights * observations) @ light_directions).T
    scaled = np.stack((aa * u + ab * v + ac * w, ab * u + bb * v + bc * w, ac * u + bc * v + cc * w), axis=1)
    predicted: Array = (scaled / (a * aa + b * ab + c * ac)[:, None]) @ light_directions.T
    return predicted


def absolute_weights(residuals: Array) -> Array:
    """Weights by which the next least squares are least absolute deviations, nearly."""
    weights: Array = 1 / (np.abs(residuals) + _EVEN)
    return weights
