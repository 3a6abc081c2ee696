"""How strong the lights were, from the photographs of the object itself, where that is plain to see.

Under known directions, the pixels of a surface that is mostly matte and turns many ways tell the lights' strengths up
to one factor: D. Cho, Y. Matsushita, Y.-W. Tai, I. S. Kweon, "Semi-calibrated photometric stereo", TPAMI 2018. Here the
alternation (normals, then strengths) is robust: least absolute deviations and medians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.restore.robust_fit import absolute_weights, predict, shadow_weights
from splinecli.normals import unit

Array = NDArray[np.float64]

FEWEST_LIGHTS = 6
"""Each light is an unknown more: four follow any strengths, and with five as many draws are mistaken as told."""

FLATTEST = 0.25
"""Smallest spread of the normals, the second largest standard deviation: where all look one way, as on a coin or a
painting, strengths and normals stand in for each other."""

PLAIN = 0.35
"""Strengths are believed where they leave at most this share of the residual that equal ones do..."""

WORST_FIT = 0.018
"""... and at most this, as a share of a pixel's brightest observation, in the median: flat shiny things fit some
strengths, too, but not so well..."""

MISFIT = 0.02
"""... and equal ones leave more than this.

With six lights of DiLiGenT's Ball and Cat, their measured strengths withheld, of PSBox's cat and of the medallion, 45
of 48 draws are told to be unequal, with eight or ten all of 85; of uw's sphere and horse and of path-traced objects,
metals and bowls among them, none of 180. Ten strengths are off by 1.6 % on Ball and 2.9 % on Cat, six by 4 and 7 %,
where equal ones would be by 46 %.
"""

_ROUNDS, _FITS = 200, 5
_OBSERVATIONS, _FEWEST_PIXELS, _MOST_PIXELS = 100_000, 100, 2000
_DARK = 0.1  # of the brightest hundredth of the pixels
_LIT = 0.3  # of a pixel's brightest prediction; darker ones may be shadows
_STEP = 1.5  # beyond what each round finds, which saves a third of them


def estimate_light_intensities(
    observations: NDArray[np.float32], missing: NDArray[np.bool_] | None, light_directions: Array
) -> Array | None:
    """Strengths (F,) with a mean of 1, or None where the lights may well be equally strong, or nothing tells.

    Args:
        observations: (P, F), each light's share of its strength not taken out.
        missing: (P, F), observations that do not count, such as saturated ones.
        light_directions: (F, 3), unit.
    """
    n_lights = len(light_directions)
    if n_lights < FEWEST_LIGHTS:
        return None
    brightest = observations.max(axis=1)
    # Not the dark background of a capture without a mask.
    lit = np.flatnonzero(brightest > _DARK * np.quantile(brightest, 0.99))
    number = min(len(lit), _MOST_PIXELS, _OBSERVATIONS // n_lights)
    chosen = lit[np.linspace(0, len(lit) - 1, number).astype(int)] if len(lit) else lit
    known = np.ones((len(chosen), n_lights), np.bool_) if missing is None else ~missing[chosen]
    told = known.sum(axis=1) >= FEWEST_LIGHTS
    known, values = known[told], observations[chosen[told]].astype(np.float64)
    if len(values) < _FEWEST_PIXELS:
        return None
    values /= values.max(axis=1, keepdims=True)
    equal = np.ones(n_lights)
    before = _residual(values, _fit(values, known, equal, light_directions), known)
    if before <= MISFIT:
        return None
    strengths = equal
    for _ in range(_ROUNDS):
        predicted = _fit(values, known, strengths, light_directions)
        counts = known & (predicted > _LIT * predicted.max(axis=1, keepdims=True))
        if (counts.sum(axis=0) < 10).any():
            return None
        ratios = np.divide(values, predicted, out=np.full_like(values, np.nan), where=counts)
        found: Array = np.nanmedian(ratios, axis=0)
        if not (found > 0).all():
            return None
        change = found / strengths
        strengths = strengths * change**_STEP
        strengths /= strengths.mean()
        if np.abs(np.log(change)).max() < 1e-4:
            break
    predicted = _fit(values, known, strengths, light_directions)
    normals = unit(predicted @ np.linalg.pinv(light_directions).T)
    spread = float(np.sqrt(np.linalg.eigvalsh(np.cov(normals.T))[1]))
    plain = _residual(values / strengths, predicted, known) < min(PLAIN * before, WORST_FIT)
    return strengths if plain and spread >= FLATTEST else None


def _fit(values: Array, known: NDArray[np.bool_], strengths: Array, lights: Array) -> Array:
    """What matte pixels of these values over strengths show under lights of strength 1."""
    observed = values / strengths
    largest = observed.max(axis=1, keepdims=True)
    observed = observed / largest
    lit = shadow_weights(observed) * known
    weights = lit
    for _ in range(_FITS):
        predicted = predict(observed, weights, lights)
        weights = lit * absolute_weights(observed - predicted)
    fitted: Array = predicted * largest
    return fitted


def _residual(observed: Array, predicted: Array, known: NDArray[np.bool_]) -> float:
    """The median of |observed - predicted|, each pixel's brightest prediction 1."""
    shares = np.abs(observed - predicted) / np.maximum(predicted.max(axis=1, keepdims=True), 1e-12)
    return float(np.median(shares[known]))
