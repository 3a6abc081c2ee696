"""What else would explain the images: values that are display-encoded, or lamps that are near.

A matte model is fitted to a sample as the capture says it is, and under the other reading. Both fits are compared where
the values are stored: what the second leaves, as a share of what the first leaves. The thresholds were chosen on
rendered captures with and without these faults (benchmarks/capture_faults.py), of all classes of materials.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.capture_warnings import ENCODED_VALUES, LAMPS_NEAR, CaptureWarning
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture.robust_fit import absolute_weights, fit_scaled_normals, lit_rows, predict
from splinecli.capture.sample import Sample
from splinecli.normals import unit

Array = NDArray[np.float64]

DISPLAY_EXPONENT = 2.2
"""A curve of this gamma is close to sRGB."""

ENCODED_RATIO = 0.9
"""Images count as display-encoded if the fit to decoded values leaves less than this share of the mean difference. Of
rendered captures that are linear, it leaves 1.1 times as much or more."""

DISTANCES = (1.0, 1.5, 2.0, 2.5, 3.2, 4.3, 6.0, 9.0)
"""The distances that are tried, in widths of the object. A minimum at the first or the last of them does not count."""

NEAR_RATIO, NEAR_RATIO_ROUND = 0.84, 0.6
"""Lamps count as near if the best distance leaves less than the first share; on round objects, than the second."""

ROUND = 0.85
"""Share of the places' variance that normals predict, from which an object is round: on a ball, gloss varies with the
place as the light of near lamps does."""

MIN_LIGHTS = 8
_MIN_MISFIT = 0.006  # of a pixel's largest value; less is noise and rounding
_MAX_PIXELS, _MIN_PIXELS, _MAX_OBSERVATIONS = 500, 60, 20_000
_DARK_SHARE, _SHADOW_SHARE, _FITS = 0.1, 0.1, 6
_ENCODED_SHADOW_SHARE = 0.35  # encoded, 0.1 is 0.35: what is shadow in one reading is in the other, too


def explain(
    sample: Sample, light_directions: Array, *, linear: bool, has_positions: bool
) -> list[CaptureWarning]:
    """Return a warning about what explains a sample better than distant lights (F, 3) and linear values, or none.

    Args:
        linear: whether the values were taken as linear.
        has_positions: whether positions of lamps are known.
    """
    ratio = decoding_ratio(sample.observations, light_directions) if linear else None
    if ratio is not None and ratio < ENCODED_RATIO:
        text = (
            "The images fit the lights much better if their values are decoded: they look display-encoded, but are read"
            f" as linear (what the lights cannot explain falls to {100 * ratio:.0f} %). Add --transfer srgb or"
            " --transfer gamma:2.2."
        )
        return [CaptureWarning(ENCODED_VALUES, text)]
    near = None if has_positions else near_distance(sample, light_directions)
    if near is None:
        return []
    text = (
        f"The lamps look near, about {near[0]:.1f} widths of the object away, but count as distant: at this distance,"
        f" they leave {100 * near[1]:.0f} % of the misfit. Measure the distance and the width of the object, or try"
        f" --light-distance {near[0]:.1f} --object-width 1."
    )
    return [CaptureWarning(LAMPS_NEAR, text)]


def decoding_ratio(observations: NDArray[np.floating], light_directions: Array) -> float | None:
    """Return what a fit leaves of observations (P, F) if they are decoded first, as a share of that without.

    Returns None where there are too few lights (F, 3) or lit pixels, or hardly anything is left.
    """
    chosen = _choose(observations)
    if chosen is None:
        return None
    values = _scaled(observations[chosen])
    before = _misfits(values, light_directions, shadow=_ENCODED_SHADOW_SHARE)[0]
    after = _misfits(values, light_directions, DISPLAY_EXPONENT, shadow=_ENCODED_SHADOW_SHARE)[0]
    return float(after / before) if before >= _MIN_MISFIT else None


def near_distance(sample: Sample, light_directions: Array) -> tuple[float, float] | None:
    """Return the distance of the lamps in widths of the object at which a sample fits best, and the share it leaves.

    The surface counts as a plane, and all lamps (F, 3) as equally far from the middle of the image. Returns None where
    distant lamps explain the images about as well, or the images do not tell.
    """
    chosen = _choose(sample.observations)
    if chosen is None:
        return None
    values = _scaled(sample.observations[chosen])
    before = _misfits(values, light_directions)
    if before[1] < _MIN_MISFIT:
        return None
    rows, columns = (places[chosen] for places in np.nonzero(sample.mask))
    width = float(np.ptp(np.flatnonzero(sample.mask.any(axis=0))) + 1)
    shape = (sample.mask.shape[0], sample.mask.shape[1])
    ratios, lights = [], []
    for widths in DISTANCES:
        lamps = NearLamps.of(light_directions * widths * width, 1.0, shape, equal=True)
        directions, strengths = lamps.light_at(lamps.plane_points(rows, columns))
        lights.append(np.asarray(directions * strengths[..., None], np.float64))
        ratios.append(float(np.sqrt(np.prod(_misfits(values, lights[-1]) / before))))
    best = int(np.argmin(ratios))
    if best in (0, len(DISTANCES) - 1):
        return None
    places = np.stack((columns, -rows), axis=1)
    limit = NEAR_RATIO_ROUND if _roundness(values, lights[best], places) > ROUND else NEAR_RATIO
    if ratios[best] >= limit:
        return None
    near = slice(best - 1, best + 2)
    square, slope, _ = np.polyfit(1 / np.array(DISTANCES[near]), ratios[near], 2)
    return float(-2 * square / slope), ratios[best]


def _choose(observations: NDArray[np.floating]) -> NDArray[np.intp] | None:
    """Return rows of lit pixels of observations (P, F), evenly spread, or None for too few."""
    n_pixels, n_lights = observations.shape
    if n_lights < MIN_LIGHTS or n_pixels < _MIN_PIXELS:
        return None
    chosen = lit_rows(observations, _DARK_SHARE, min(_MAX_PIXELS, _MAX_OBSERVATIONS // n_lights))
    # Three unknowns need more than three lit observations to leave a residual.
    chosen = chosen[(_scaled(observations[chosen]) > _SHADOW_SHARE).sum(axis=1) >= 5]
    return chosen if len(chosen) >= _MIN_PIXELS else None


def _scaled(observations: NDArray[np.floating]) -> Array:
    values = observations.astype(np.float64).clip(min=0)
    return np.asarray(values / np.maximum(values.max(axis=1, keepdims=True), 1e-12))


def _misfits(values: Array, lights: Array, gamma: float = 1.0, *, shadow: float = _SHADOW_SHARE) -> Array:
    """Return mean and median |difference| of lit values (p, F) from a robust fit of I^gamma = l . b.

    Args:
        lights: (F, 3) or (p, F, 3), of any length.
        shadow: values up to this do not count.
    """
    lit = values > shadow
    linear = values**gamma
    # The slope of the stored value over the linear one, so that both readings have the same errors.
    slopes = lit / (gamma * np.maximum(values, shadow) ** (gamma - 1)) ** 2
    weights = slopes
    for _ in range(_FITS):
        residuals = values - np.maximum(predict(linear, weights, lights), 0) ** (1 / gamma)
        weights = slopes * absolute_weights(residuals)
    differences = np.abs(residuals[lit])
    return np.array((differences.mean(), np.median(differences)))


def _roundness(values: Array, lights: Array, places: NDArray[np.integer]) -> float:
    """Return the share of the variance of places (p, 2) that a cubic function of the slopes of normals predicts."""
    lit = (values > _SHADOW_SHARE).astype(np.float64)
    across = unit(fit_scaled_normals(values, lit, lights))[:, :2]
    terms = np.concatenate(
        (across, across * (across**2).sum(axis=1, keepdims=True), np.ones((len(across), 1))), axis=1
    )
    missed = places - terms @ np.linalg.lstsq(terms, places, rcond=None)[0]
    return float(1 - missed.var(axis=0).sum() / max(places.var(axis=0).sum(), 1e-12))
