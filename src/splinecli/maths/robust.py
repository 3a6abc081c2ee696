"""Robust Lambertian fits in NumPy by weighted least squares, and the closed-form solution of 3 x 3
systems for all fits.

`inverse_3x3` works on both NumPy arrays and torch tensors. It limits its pivots from below, so that
the result remains positive definite.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Float64Array, Floats

MIN_LIGHTS = 3  # a normal scaled by an albedo has three unknowns
# Usual limit of pivots for unit light directions and a largest weight of about 1
SMALLEST_PIVOT = 1e-12


def inverse_3x3(entries: Sequence[Any], smallest: float) -> tuple[Any, ...]:
    """Return the inverses of symmetric positive matrices as xx, yy, zz, xy, xz, yz, each (P,).

    The input has the same form. The factors of A = L D L' are inverted. Pivots are at least
    `smallest`, and at least 1e-14 of the trace, the limit of rounding. Therefore, the inverse is
    positive definite even if the matrix has rank 1 or 2.
    """
    xx, yy, zz, xy, xz, yz = entries
    floor = smallest + 1e-14 * (xx + yy + zz)
    first = xx.clip(floor)
    l21, l31 = xy / first, xz / first
    second = (yy - l21 * xy).clip(floor)
    l32 = (yz - l31 * xy) / second
    third = (zz - l31 * xz - l32 * l32 * second).clip(floor)
    # The inverse of L has ones on its diagonal and these entries below it.
    m21, m31, m32 = -l21, l21 * l32 - l31, -l32
    return (
        1 / first + m21 * m21 / second + m31 * m31 / third,
        1 / second + m32 * m32 / third,
        1 / third,
        m21 / second + m31 * m32 / third,
        m31 / third,
        m32 / third,
    )


def multiply_symmetric(entries: Sequence[Any], vector: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Return the products of symmetric matrices, as in `inverse_3x3`, and vectors x, y, z, each
    (P,).
    """
    xx, yy, zz, xy, xz, yz = entries
    x, y, z = vector
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


def solve_each(values: NDArray[np.floating], vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the least-squares solutions b (P, 3) of vectors (P, F, 3) @ b = values (P, F) for each
    pixel.
    """
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    entries = [
        np.einsum("pf,pf->p", a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    ]
    right_side = [np.einsum("pf,pf->p", axis, values) for axis in (x, y, z)]
    return np.stack(multiply_symmetric(inverse_3x3(entries, SMALLEST_PIVOT), right_side), axis=1)


SHADOW_SHARE = 0.05  # observations below this share of a pixel's largest one are treated as shadow


def shadow_weights(observations: Floats) -> Floats:
    """Return weights (P, F), 1 for lit observations and nearly 0 for shadows.

    The largest observation of each pixel must be 1.
    """
    return np.where(observations < SHADOW_SHARE, 1e-3, 1.0).astype(observations.dtype)


def shade(scaled_normals: Floats, light_directions: Floats) -> Floats:
    """Return the observations I = l . b (P, F) of scaled normals (P, 3) under lights (F, 3) or (P,
    F, 3).
    """
    if light_directions.ndim == 2:
        return np.asarray(scaled_normals @ light_directions.T)
    return np.asarray((light_directions @ scaled_normals[..., None])[..., 0])


def fit_scaled_normals(
    observations: Floats, weights: Floats, light_directions: Floats, *, prior: float = 1e-6
) -> Floats:
    """Return the scaled normals b (P, 3) of matte pixels that minimise weighted squared residuals.

    The model is I = l . b. Observations and weights are (P, F), light directions (F, 3) or (P, F,
    3), of any length. The prior pulls towards a black pixel, so that a pixel with fewer than three
    lit observations has a solution.
    """
    x, y, z = np.moveaxis(light_directions, -1, 0)
    products = np.stack((x * x, y * y, z * z, x * y, x * z, y * z), axis=-1)
    xx, yy, zz, xy, xz, yz = _sum_over_lights(weights, products).T
    covariance = inverse_3x3((xx + prior, yy + prior, zz + prior, xy, xz, yz), prior)
    right_side = _sum_over_lights(weights * observations, light_directions)
    return np.stack(multiply_symmetric(covariance, tuple(right_side.T)), axis=1)


def _sum_over_lights(values: Floats, terms: Floats) -> Floats:
    """Return the sums (P, K) of values (P, F) times terms (F, K) or (P, F, K)."""
    return values @ terms if terms.ndim == 2 else (values[:, None] @ terms)[:, 0]


def absolute_weights(residuals: Floats) -> Floats:
    """Return weights for least absolute deviations by iteratively reweighted least squares."""
    # Residuals far below this value have nearly equal weights.
    return np.asarray(1 / (np.abs(residuals) + 0.02))


def fit_robustly(
    values: Floats, lit: Floats, lights: Floats, fits: int, weights: Floats | None = None
) -> tuple[Float64Array, Float64Array]:
    """Return scaled normals (P, 3) of least absolute deviations, and weights (P, F) for the next
    fit.

    The largest value of each pixel's values (P, F) is 1. The weights `lit` (P, F), for example from
    shadow_weights, do not depend on the fit; `weights` are the weights of the first fit, by default
    `lit`. The lights (F, 3) or (P, F, 3) have any length, and the number of weighted fits is at
    least 1.
    """
    weights = lit if weights is None else weights
    for _ in range(fits):
        normals = fit_scaled_normals(values, weights, lights)
        weights = lit * absolute_weights(values - shade(normals, lights))
    return np.asarray(normals, np.float64), np.asarray(weights, np.float64)


def lit_values(
    observations: Floats, dark_share: float, most: int
) -> tuple[NDArray[np.intp], Float64Array]:
    """Return the rows (p,) of at most `most` lit pixels, evenly spread, and their relative values
    (p, F).

    The values are relative to the largest of each pixel. Pixels below dark_share of the brightest
    hundredth are treated as dark, for example a background that is not masked.
    """
    brightest = observations.max(axis=1)
    lit = np.flatnonzero(brightest > dark_share * np.quantile(brightest, 0.99))
    chosen = lit[np.linspace(0, len(lit) - 1, min(len(lit), most)).astype(int)]
    values = observations[chosen].astype(np.float64)
    return chosen, values / values.max(axis=1, keepdims=True)
