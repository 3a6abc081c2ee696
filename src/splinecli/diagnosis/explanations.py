"""What else would explain the images: encoded values, or near lamps.

A matte model is fitted to a sample as the capture says it is, and under the other reading. Both fits are compared where
the values are stored: what the second leaves, as a share of what the first leaves. The thresholds were chosen on
rendered captures with and without these faults (benchmarks/capture_faults.py), of all classes of materials.
"""

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import capture_warnings as codes
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture.robust_fit import fit_robustly, fit_scaled_normals, lit_values, shade
from splinecli.capture.sample import Sample
from splinecli.maths.arrays import Doubles, Floats, Integers
from splinecli.maths.normals import unit

DISPLAY_EXPONENT = 2.2  # a curve of this gamma is close to sRGB

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


def encoded_values(sample: Sample, light_directions: Doubles) -> list[CaptureWarning]:
    """Warn of a sample whose values fit distant lights (F, 3) much better if they are decoded."""
    _, values = _choose(sample.observations)
    if not len(values):
        return []
    before, after = (
        _misfits(values, light_directions, gamma, shadow=_ENCODED_SHADOW_SHARE)[0] for gamma in (1.0, DISPLAY_EXPONENT)
    )
    if before < _MIN_MISFIT or after >= ENCODED_RATIO * before:
        return []
    text = (
        "The images fit the lights much better if their values are decoded: they look display-encoded, but are read as"
        f" linear (what the lights cannot explain falls to {100 * after / before:.0f} %). Add --transfer srgb or"
        " --transfer gamma:2.2."
    )
    return [CaptureWarning(codes.ENCODED_VALUES, text)]


def near_lamps(sample: Sample, light_directions: Doubles) -> list[CaptureWarning]:
    """Warn of a sample that fits lamps in these directions (F, 3) much better if they are near."""
    near = near_distance(sample, light_directions)
    if near is None:
        return []
    text = (
        f"The lamps look near, about {near[0]:.1f} widths of the object away, but count as distant: at this distance,"
        f" they leave {100 * near[1]:.0f} % of the misfit. Measure the distance and the width of the object, or try"
        f" --light-distance {near[0]:.1f} --object-width 1."
    )
    return [CaptureWarning(codes.LAMPS_NEAR, text)]


def near_distance(sample: Sample, light_directions: Doubles) -> tuple[float, float] | None:
    """Return the distance of the lamps in widths of the object at which a sample fits best, and the share it leaves.

    The surface counts as a plane, and all lamps (F, 3) as equally far from the middle of the image. Returns None where
    distant lamps explain the images about as well, or the images do not tell.
    """
    chosen, values = _choose(sample.observations)
    if not len(chosen):
        return None
    before = _misfits(values, light_directions)
    if before[1] < _MIN_MISFIT:
        return None
    rows, columns = (places[chosen] for places in np.nonzero(sample.mask))
    width = float(np.ptp(np.flatnonzero(sample.mask.any(axis=0))) + 1)
    ratios, lights = [], []
    for widths in DISTANCES:
        lamps = NearLamps.of(light_directions * widths * width, 1.0, sample.mask.shape, equal=True)
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


def _choose(observations: Floats) -> tuple[NDArray[np.intp], Doubles]:
    """Return rows (p,) of lit pixels, evenly spread, and their values (p, F), scaled to 1; none for too few."""
    n_lights = observations.shape[1]
    none = np.zeros(0, np.intp), np.zeros((0, n_lights))
    if n_lights < MIN_LIGHTS or len(observations) < _MIN_PIXELS:
        return none
    chosen, values = lit_values(observations, _DARK_SHARE, min(_MAX_PIXELS, _MAX_OBSERVATIONS // n_lights))
    values = values.clip(min=0)
    # Three unknowns need more than three lit observations to leave a residual.
    enough = (values > _SHADOW_SHARE).sum(axis=1) >= 5
    return (chosen[enough], values[enough]) if enough.sum() >= _MIN_PIXELS else none


def _misfits(values: Doubles, lights: Doubles, gamma: float = 1.0, *, shadow: float = _SHADOW_SHARE) -> Doubles:
    """Return mean and median |difference| of lit values (p, F), above `shadow`, from a robust fit of I^gamma = l . b.

    The lights (F, 3) or (p, F, 3) have any length.
    """
    lit = values > shadow
    # The slope of the stored value over the linear one, so that both readings have the same errors.
    slopes = lit / (gamma * np.maximum(values, shadow) ** (gamma - 1))
    normals, _ = fit_robustly(values**gamma, slopes, lights, _FITS)
    differences = np.abs(values - shade(normals, lights).clip(min=0) ** (1 / gamma))[lit]
    return np.array((differences.mean(), np.median(differences)))


def _roundness(values: Doubles, lights: Doubles, places: Integers) -> float:
    """Return the share of the variance of places (p, 2) that a cubic function of the slopes of normals predicts."""
    lit = (values > _SHADOW_SHARE).astype(np.float64)
    across = unit(fit_scaled_normals(values, lit, lights))[:, :2]
    terms = np.concatenate((across, across * (across**2).sum(axis=1, keepdims=True), np.ones((len(across), 1))), axis=1)
    missed = places - terms @ np.linalg.lstsq(terms, places, rcond=None)[0]
    return float(1 - missed.var(axis=0).sum() / max(places.var(axis=0).sum(), 1e-12))
