"""Light intensities, estimated from the images of the object.

Under known directions, a mostly matte surface with many orientations determines the intensities up to one factor:
D. Cho, Y. Matsushita, Y.-W. Tai, I. S. Kweon, "Semi-calibrated photometric stereo", TPAMI 2018. The alternation here
(normals, then intensities) is robust: it uses least absolute deviations and medians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.robust_fit import fit_robustly, lit_rows, shadow_weights
from splinecli.normals import unit

Array = NDArray[np.float64]

MIN_LIGHTS = 6
"""Each light adds an unknown. Four observations fit any intensities, and with five lights half of the estimates are
wrong."""

MIN_NORMAL_SPREAD = 0.25
"""Smallest accepted spread of the normals (their second largest standard deviation). Where all normals are alike, as
on a coin or a painting, an error of the intensities looks like one of the normals."""

MAX_ERROR_RATIO = 0.35
"""Largest accepted residual, as a share of the residual under equal intensities."""

MAX_ERROR = 0.018
"""Largest accepted residual: the median, as a share of a pixel's brightest observation. Flat shiny objects also fit
some intensities, but not so well."""

MIN_EQUAL_ERROR = 0.02
"""Smallest residual under equal intensities for which others are estimated, in the unit of MAX_ERROR.

These limits were tried on DiLiGenT's Ball and Cat without their measured intensities, PSBox's cat and the medallion.
With six lights, 45 of 48 draws are recognised as unequal; with eight or ten lights, all 85 are. Of 180 draws from uw's
sphere and horse and from path-traced objects, with metals and bowls among them, none is. The error of ten intensities
is 1.6 % on Ball and 2.9 % on Cat; of six intensities, it is 4 and 7 %. Equal intensities would have an error of 46 %.
"""

_MAX_ROUNDS, _FITS_PER_ROUND = 200, 5
_MAX_OBSERVATIONS, _MIN_PIXELS, _MAX_PIXELS = 100_000, 100, 2000
_MIN_PIXELS_PER_LIGHT = 10
_DARK_SHARE = 0.1  # of the brightest hundredth of the pixels
_LIT_SHARE = 0.3  # of a pixel's brightest prediction; darker observations may be shadows
_STEP = 1.5  # exponent of each round's change; beyond 1 it saves a third of the rounds
_CONVERGED = 1e-4  # change of the logarithms


def estimate_light_intensities(
    observations: NDArray[np.float32], missing: NDArray[np.bool_] | None, light_directions: Array
) -> Array | None:
    """Return light intensities (F,) with a mean of 1, or None where equal ones fit or the images do not determine them.

    Args:
        observations: (P, F), not divided by intensities.
        missing: (P, F), observations that do not count, such as saturated ones.
        light_directions: (F, 3), unit.
    """
    chosen = _choose_pixels(observations, missing)
    if chosen is None:
        return None
    values, known = chosen
    equal = np.ones(len(light_directions))
    equal_error = _error(values, _fit(values, known, equal, light_directions) @ light_directions.T, known)
    if equal_error <= MIN_EQUAL_ERROR:
        return None
    intensities = _alternate(values, known, light_directions)
    if intensities is None:
        return None
    scaled_normals = _fit(values, known, intensities, light_directions)
    spread = float(np.sqrt(np.linalg.eigvalsh(np.cov(unit(scaled_normals).T))[1]))
    error = _error(values / intensities, scaled_normals @ light_directions.T, known)
    fits = error < min(MAX_ERROR_RATIO * equal_error, MAX_ERROR)
    return intensities if fits and spread >= MIN_NORMAL_SPREAD else None


def _choose_pixels(
    observations: NDArray[np.float32], missing: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return observations (p, F) of lit pixels, each scaled to 1, and which of them count; None for too few."""
    n_lights = observations.shape[1]
    if n_lights < MIN_LIGHTS:
        return None
    chosen = lit_rows(observations, _DARK_SHARE, min(_MAX_PIXELS, _MAX_OBSERVATIONS // n_lights))
    known = np.ones((len(chosen), n_lights), np.bool_) if missing is None else ~missing[chosen]
    enough = known.sum(axis=1) >= MIN_LIGHTS
    known, values = known[enough], observations[chosen[enough]].astype(np.float64)
    if len(values) < _MIN_PIXELS:
        return None
    values /= values.max(axis=1, keepdims=True)
    return values, known


def _alternate(values: Array, known: NDArray[np.bool_], light_directions: Array) -> Array | None:
    """Return the intensities (F,) at which fits and medians agree; None where a light reaches too few pixels."""
    intensities = np.ones(len(light_directions))
    for _ in range(_MAX_ROUNDS):
        predicted = _fit(values, known, intensities, light_directions) @ light_directions.T
        counts = known & (predicted > _LIT_SHARE * predicted.max(axis=1, keepdims=True))
        if (counts.sum(axis=0) < _MIN_PIXELS_PER_LIGHT).any():
            return None
        ratios = np.divide(values, predicted, out=np.full_like(values, np.nan), where=counts)
        medians: Array = np.nanmedian(ratios, axis=0)
        if not (medians > 0).all():
            return None
        change = medians / intensities
        intensities = intensities * change**_STEP
        intensities /= intensities.mean()
        if np.abs(np.log(change)).max() < _CONVERGED:
            break
    return intensities


def _fit(values: Array, known: NDArray[np.bool_], intensities: Array, lights: Array) -> Array:
    """Return the scaled normals (p, 3) of matte pixels with these observations, for lights of intensity 1."""
    observed = values / intensities
    largest = observed.max(axis=1, keepdims=True)
    observed = observed / largest
    normals, _ = fit_robustly(observed, shadow_weights(observed) * known, lights, _FITS_PER_ROUND)
    return np.asarray(normals * largest)


def _error(observed: Array, predicted: Array, known: NDArray[np.bool_]) -> float:
    """Return the median of |observed - predicted|, as a share of each pixel's brightest prediction."""
    shares = np.abs(observed - predicted) / np.maximum(predicted.max(axis=1, keepdims=True), 1e-12)
    return float(np.median(shares[known]))
