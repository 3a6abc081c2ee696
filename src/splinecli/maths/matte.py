"""Fits of a matte model to many pixels by least absolute deviations, side by side for different
lights, transfer curves and amounts of constant light, with intensities of the lights that are known
or free.

Free intensities: under known directions, a mostly matte surface with many orientations determines
the intensities up to one factor: D. Cho, Y. Matsushita, Y.-W. Tai, I. S. Kweon, "Semi-calibrated
photometric stereo", TPAMI 2018. Normals and intensities are fitted in turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splinecli.maths import Bools, Float64Array
from splinecli.maths.normals import unit
from splinecli.maths.robust import absolute_weights, inverse_3x3, multiply_symmetric

SHADOW = 0.1  # of a pixel's largest value; smaller values are shadow
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # xx, yy, zz, xy, xz, yz of a product


@dataclass(frozen=True, eq=False)
class Fit:
    """A matte model under one reading."""

    residual: float
    normals: Float64Array
    intensities: Float64Array


def fit_matte(
    values: Float64Array,
    lights: Float64Array,
    gammas: Sequence[float] = (1.0,),
    *,
    free: bool = False,
    known: Bools | None = None,
    shadow: float = SHADOW,
    rounds: int | None = None,
) -> list[Fit]:
    """Fit values^gamma = e max(l . b, 0) by least absolute deviations of the values, side by side
    for each gamma and each set of lights.

    Args:
        values: (p, F), the largest of each pixel 1.
        lights: (F, 3) or (H, p, F, 3), of any length.
        free: Whether the intensities e are free; otherwise they are 1.
        known: (p, F), the values to be used; all by default.
        shadow: Values up to this one are left out.
        rounds: Number of weighted fits, by default enough to compare gammas and lights.
    """
    stored, vectors = values.T, _by_axis(lights)
    gamma = np.array(gammas)[:, None, None]
    lit = stored > shadow if known is None else (stored > shadow) & known.T
    # The slope of the linear value over the stored one, so that all readings have the same errors.
    start = lit / (gamma * np.maximum(stored, shadow) ** (gamma - 1))
    observed, weights, products = stored**gamma, start, _products(vectors)
    count = max(len(gammas), len(vectors))
    intensities = np.ones((count, len(stored)))
    for _ in range(rounds or (30 if free else 8)):
        e = intensities[..., None]
        scaled = weights * e
        normals = _solve(products, vectors, scaled * e, scaled * observed)
        equal = _shade(normals, vectors)
        weights = start * absolute_weights(observed - equal * e)
        if free:
            intensities = _intensities(observed, equal, weights, intensities)
    left = np.abs(stored - np.maximum(equal * e, 0) ** (1 / gamma))[:, lit]
    return _described(left, normals, intensities)


def fit_with_offsets(
    values: Float64Array, lights: Float64Array, offsets: Sequence[float]
) -> dict[float, Fit]:
    """Fit values = max(l . b, 0) + offset |b| as fit_matte does, for lights (F, 3) and each
    offset.
    """
    stored, vectors = values.T, _by_axis(lights)
    products, offset = _products(vectors), np.array(offsets)[:, None, None]
    lit = stored > SHADOW
    start = lit.astype(np.float64)
    # 0.8 is the usual cosine between a normal and the light under which its pixel is brightest.
    above = np.maximum(stored - offset / (offset + 0.8), 0)
    weights = np.broadcast_to(start, above.shape)
    normals = _solve(products, vectors, weights, weights * above)
    for _ in range(14):
        # Newton's step on |b|, halved: with much constant light, whole steps miss. Its vectors are
        # those of lights that the pixel faces, plus the offset along its normal.
        facing = weights * (_shade(normals, vectors) > 0)
        along = offset * np.moveaxis(unit(np.moveaxis(normals, 1, -1)), -1, 1)
        light = _sum_over_lights(vectors, facing)
        sums = _sum_over_lights(products, facing)
        sums += along[:, _ROWS] * light[:, _COLUMNS] + along[:, _COLUMNS] * light[:, _ROWS]
        sums += along[:, _ROWS] * along[:, _COLUMNS] * weights.sum(axis=1, keepdims=True)
        right_side = _sum_over_lights(vectors, facing * stored)
        right_side += along * (weights * stored).sum(axis=1, keepdims=True)
        normals = (normals + _solution(sums, right_side)) / 2
        predicted = np.maximum(_shade(normals, vectors), 0)
        predicted += offset * np.linalg.norm(normals, axis=1, keepdims=True)
        weights = start * absolute_weights(stored - predicted)
    left = np.abs(stored - np.maximum(predicted, 0))[:, lit]
    found = _described(left, normals, np.ones((len(offsets), len(stored))))
    return dict(zip(offsets, found, strict=True))


def _described(
    residuals: Float64Array, normals: Float64Array, intensities: Float64Array
) -> list[Fit]:
    """Return fits from their residuals (H, n), normals (H, 3, p) and intensities (H, F)."""
    mean = residuals.mean(axis=1)
    # The fits to few lights pass through most values. The median would be zero.
    typical = np.median(residuals, axis=1) if intensities.shape[1] >= 8 else mean
    sizes = np.sqrt(mean * typical).tolist()
    return [Fit(*each) for each in zip(sizes, normals.swapaxes(1, 2), intensities, strict=True)]


def _by_axis(lights: Float64Array) -> Float64Array:
    """Return lights (F, 3) or (H, p, F, 3) as (1, 3, F, 1) or (H, 3, F, p)."""
    if lights.ndim == 2:
        return lights.T[None, :, :, None]
    return np.ascontiguousarray(np.moveaxis(lights, (1, 2, 3), (3, 2, 1)))


def _products(vectors: Float64Array) -> Float64Array:
    """Return the products (H, 6, F, p) of the components of vectors (H, 3, F, p)."""
    return vectors[:, _ROWS] * vectors[:, _COLUMNS]


def _solve(
    products: Float64Array, vectors: Float64Array, weights: Float64Array, weighted: Float64Array
) -> Float64Array:
    """Return scaled normals (H, 3, p) for weights (H, F, p) and weighted values; see
    fit_scaled_normals.
    """
    return _solution(_sum_over_lights(products, weights), _sum_over_lights(vectors, weighted))


def _solution(sums: Float64Array, right_side: Float64Array) -> Float64Array:
    sums[:, :3] += 1e-6
    covariance = inverse_3x3(tuple(sums.swapaxes(0, 1)), 1e-6)
    return np.stack(multiply_symmetric(covariance, tuple(right_side.swapaxes(0, 1))), axis=1)


def _sum_over_lights(terms: Float64Array, values: Float64Array) -> Float64Array:
    """Return the sums (H, K, p) of terms (H, K, F, p) times values (H, F, p)."""
    if terms.shape[3] == 1:
        return np.asarray(terms[..., 0] @ values)
    return np.asarray(np.einsum("hkfp,hfp->hkp", terms, values))


def _shade(normals: Float64Array, vectors: Float64Array) -> Float64Array:
    """Return the shading (H, F, p) of scaled normals (H, 3, p) under lights (H, 3, F, p)."""
    if vectors.shape[3] == 1:
        return np.asarray(vectors[..., 0].swapaxes(1, 2) @ normals)
    return np.asarray(np.einsum("hkfp,hkp->hfp", vectors, normals))


def _intensities(
    observed: Float64Array, equal: Float64Array, weights: Float64Array, before: Float64Array
) -> Float64Array:
    """Return the next intensities (H, F) from the values (H, F, p) predicted for lights of
    intensity 1.
    """
    # the rest may be shadow
    weighted = weights * (equal > 0.2 * equal.max(axis=1, keepdims=True)) * equal
    power = (weighted * equal).sum(axis=2)
    found = (weighted * observed).sum(axis=2) / np.maximum(power, 1e-12)
    found = np.where(power > 0, found, before)
    found = np.clip(found / found.mean(axis=1, keepdims=True), 0.05, 20)
    intensities = before * (found / before) ** 1.5  # larger changes save a third of the fits
    return np.asarray(intensities / intensities.mean(axis=1, keepdims=True))
