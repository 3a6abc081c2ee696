"""Intensities and colours of the lamps, estimated from the images of the object.

Intensities: see fit_matte. They are used only if they fit much better than equal ones.

Colours: these may vary between images. A matte pixel has a colour of its own, and each lamp changes
it by the same factors everywhere: R_pf = e_f^R a_p^R s_pf, and so on. Averaged over the channels, a
red pixel then looks darker under a green lamp, as if it were facing away. The factors are found
from the medians of the colours' changes, and each channel is divided by its own.
"""

from collections.abc import Callable

import numpy as np

from splinecli.maths import Bools, Float32Array, Float64Array, Floats, Integers
from splinecli.maths.matte import SHADOW, fit_matte
from splinecli.maths.normals import spread_of, unit
from splinecli.maths.robust import (
    fit_robustly,
    fit_scaled_normals,
    lit_values,
    shade,
    shadow_weights,
)
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning

Lights = Float64Array | Callable[[Integers], Float64Array]

# Each light adds an unknown. Four observations fit any intensities, and with five lights half of
# the estimates are wrong.
FEWEST_FOR_INTENSITIES = 6
# Normals with a smaller spread (their second largest standard deviation) belong to a flat object,
# such as a coin or a painting. Tilting all its normals together has nearly the same effect as other
# intensities, so the result also depends on the likeliest tilt: the more, the less the images
# reveal.
FLAT_SPREAD = 0.35
# standard deviation of the slope of flat objects towards the camera, in x and in y: 5 degrees
TILT = 0.09
# Surfaces deviate from the matte model together, so that many pixels are worth one or two. With
# this factor on the residual, the stated errors of 48 rendered captures have the size of the true
# ones.
_DEVIATION = 1.3
_LEAST_RESIDUAL = 0.005  # of real surfaces
# The networks turn their normals less than the fits: with this share, the expected and the true
# share of small errors agree on the 48 captures.
_TURNED = 0.3
_UNEQUAL = 0.25  # standard deviation of the logarithm of unequal intensities
_ROUNDS = 150  # after 100, six intensities of a statue were still twice as far off
_LOWEST_COSINE, _LEAST_VARIANCE = 0.05, 1e-4


def estimate_light_intensities(
    observations: Float32Array, missing: Bools | None, lights: Lights
) -> Float64Array | None:
    """Return light intensities (F,) with a mean of 1, or None if equal ones fit or the images do
    not determine them.

    The observations (P, F) are not divided by intensities; `missing` (P, F) are left out, such as
    saturated ones. The lights are (F, 3), or a function from rows (p,) to (p, F, 3), as under near
    lamps.

    The limits below were tried on DiLiGenT's Ball and Cat without their measured intensities,
    PSBox's cat and the medallion. With six lights, 45 of 48 draws are recognised as unequal; with
    eight or ten lights, all 85 are. Of 180 draws from uw's sphere and horse and from path-traced
    objects, with metals and bowls among them, none is. For intensities that differ by 30 %, the
    error of ten is 1.7 % on Ball and 2.2 % on Cat; of six, it is 1.9 and 2.3 %.
    """
    n_lights = observations.shape[1]
    if n_lights < FEWEST_FOR_INTENSITIES:
        return None
    rows, values = _some_values(observations)
    known = np.ones(values.shape, np.bool_) if missing is None else ~missing[rows]
    enough = known.sum(axis=1) >= FEWEST_FOR_INTENSITIES
    if enough.sum() < 100:
        return None
    rows, values, known = rows[enough], values[enough], known[enough]
    light_vectors = lights(rows) if callable(lights) else lights
    intensities = np.ones(n_lights)
    equal = shade(_fit(values, known, intensities, light_vectors), light_vectors)
    equal_error = _error(values, equal, known)
    if equal_error <= 0.02:
        return None
    each = light_vectors if light_vectors.ndim == 2 else light_vectors[None]
    for _ in range(2):  # at first, the light of weak lamps may be mistaken for shadow
        scaled = values / intensities
        scaled /= scaled.max(axis=1, keepdims=True)
        (fit,) = fit_matte(scaled, each, free=True, known=known, rounds=_ROUNDS)
        intensities = intensities * fit.intensities
    if ((known & (scaled > SHADOW)).sum(axis=0) < 10).any():
        return None
    intensities /= intensities.mean()
    normals = _fit(values, known, intensities, light_vectors)
    if spread_of(unit(normals)) < FLAT_SPREAD:
        intensities = _of_least_deviations(values, known, intensities, light_vectors)
        normals = _fit(values, known, intensities, light_vectors)
        level = _likeliest_tilt(intensities, unit(normals), light_vectors)
        doubt = _tilt_variance(values / intensities, normals, known, light_vectors)
        share = doubt / (doubt + TILT**2)
        intensities = intensities ** (1 - share) * level**share
        intensities /= intensities.mean()
        normals = _fit(values, known, intensities, light_vectors)
        # A flat object may be nearer to its tilt under equal intensities than to the likeliest
        # tilt.
        directions, shown = _shown(intensities, unit(normals), light_vectors)
        tilt = _fit_tilt(shown, directions, _LEAST_VARIANCE)
        slopes = directions[:, :2] - directions[:, :2].mean(axis=0)
        tilt_error = _variance(shown, directions, tilt) * np.trace(
            np.linalg.pinv(slopes.T @ slopes)
        )
        if tilt_error < 2 * (1.5 * TILT) ** 2:
            return None
    predicted = shade(normals, light_vectors)
    error = _error(values / intensities, predicted, known)
    # metals have a larger error
    return intensities if error < min(0.35 * equal_error, 0.035) else None


def turn_by_intensities_deg(
    observations: Float32Array, intensities: Float64Array, lights: Lights
) -> float:
    """Return how far the errors of estimated intensities (F,) turn the normals, in degrees.

    The arguments are those of `estimate_light_intensities`, and its result.
    """
    rows, values = _some_values(observations)
    lit = (values / intensities > SHADOW).sum(axis=1)  # three leave no residual
    rows, values = rows[lit > 3], values[lit > 3]
    if not len(values):
        return 0.0
    vectors = lights(rows) if callable(lights) else lights
    known = np.ones(values.shape, np.bool_)
    normals = _fit(values, known, intensities, vectors)
    certainty, turns = _sensitivity(values / intensities, normals, known, vectors)
    variances = np.linalg.inv(certainty + np.eye(len(intensities)) / _UNEQUAL**2)
    turn = np.sqrt(((turns @ variances) * turns).sum(axis=(1, 2)).mean())
    return _TURNED * float(np.degrees(turn))


def _some_values(observations: Float32Array) -> tuple[Integers, Float64Array]:
    return lit_values(observations, 0.1, min(2000, 100_000 // observations.shape[1]))


def _tilt_variance(
    observed: Float64Array, normals: Float64Array, known: Bools, lights: Float64Array
) -> float:
    """Return the variance of the slopes of a flat object, which the images leave open."""
    directions, facing = _plane_cosines(unit(normals), lights)
    changes = directions[:, :2] / facing[:, None]
    changes -= changes.mean(axis=0)
    certainty, _ = _sensitivity(observed, normals, known, lights)
    return float(2 / max(np.trace(changes.T @ certainty @ changes), 1e-9))


def _sensitivity(
    observed: Float64Array, normals: Float64Array, known: Bools, lights: Float64Array
) -> tuple[Floats, Floats]:
    """Return how certain the logarithms of the intensities are, as the inverse of their covariance
    (F, F), and how they turn the normals (p, 3, F), in radians.

    The scaled normals (p, 3) fit the observed values (p, F), divided by the intensities.
    """
    lit = (known & (observed > SHADOW * observed.max(axis=1, keepdims=True))).astype(np.float64)
    predicted = shade(normals, lights)
    curvature, moves = _curvature(lit, predicted, lights)
    residual = _DEVIATION * max(_error(observed, predicted, lit > 0), _LEAST_RESIDUAL)
    length = np.linalg.norm(normals, axis=1)[:, None, None]
    along = normals[:, :, None] / length
    turns = (moves - along * (along * moves).sum(axis=1, keepdims=True)) / length
    return curvature / len(normals) / residual**2, turns


def _curvature(weights: Floats, predicted: Floats, lights: Float64Array) -> tuple[Floats, Floats]:
    """Return the curvature (F, F) of the weighted squared residuals over the logarithms of the
    intensities, with the best normals for each, and how these scaled normals move (p, 3, F).
    """
    vectors = lights if lights.ndim == 3 else lights[None]
    weighted = (weights * predicted)[..., None] * vectors
    products = np.swapaxes(weights[..., None] * vectors, 1, 2) @ vectors + 1e-9 * np.eye(3)
    moves = np.linalg.solve(products, np.swapaxes(weighted, 1, 2))
    own = np.diag((weights * predicted**2).sum(axis=0))
    return own - np.tensordot(weighted, moves, ((0, 2), (0, 1))), moves


def _of_least_deviations(
    values: Float64Array, known: Bools, intensities: Float64Array, lights: Float64Array
) -> Float64Array:
    """Return the intensities (F,) of least absolute deviations, by Gauss and Newton's method.

    Fitting normals and intensities in turn takes thousands of rounds on a flat object.
    """
    for _ in range(20):
        observed = values / intensities
        observed /= observed.max(axis=1, keepdims=True)
        lit = (known & (observed > SHADOW)).astype(np.float64)
        _, weights = fit_robustly(observed, lit, lights, 5)
        left = observed - shade(fit_scaled_normals(observed, weights, lights), lights)
        curvature, _ = _curvature(weights, observed, lights)
        # A common factor is free.
        curvature += np.trace(curvature) / len(curvature) ** 2
        step = np.linalg.solve(curvature, (weights * observed * left).sum(axis=0))
        intensities = intensities * np.exp(step.clip(-0.5, 0.5))
        if np.abs(step).max() < 1e-3:
            break
    return np.asarray(intensities / intensities.mean())


def _likeliest_tilt(
    intensities: Float64Array, normals: Float64Array, lights: Float64Array
) -> Float64Array:
    """Return the intensities (F,) that explain the same images of a flat object with its likeliest
    tilt.

    Under a tilt t, a plane that shows k_f needs intensities k_f / l_f . (t, 1). The likeliest tilt
    leaves intensities that are nearly equal, and is small itself.
    """
    directions, shown = _shown(intensities, normals, lights)
    # The inequality of the intensities is measured on the part that a tilt cannot explain.
    # Otherwise a tilt would be mistaken for inequality, and a strongly tilted object would get too
    # weak a tilt.
    tilt = _fit_tilt(shown, directions, _LEAST_VARIANCE)
    tilt = _fit_tilt(shown, directions, max(_variance(shown, directions, tilt), _LEAST_VARIANCE))
    return np.asarray(shown / np.maximum(directions @ (*tilt, 1.0), _LOWEST_COSINE))


def _shown(
    intensities: Float64Array, normals: Float64Array, lights: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return unit directions (F, 3), and the brightness (F,) of a plane with the mean normal under
    each light.
    """
    directions, facing = _plane_cosines(normals, lights)
    return directions, intensities * facing


def _plane_cosines(
    normals: Float64Array, lights: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return unit directions (F, 3), and their cosines (F,) with the mean normal."""
    directions = unit(lights if lights.ndim == 2 else lights.mean(axis=0))
    return directions, np.maximum(directions @ unit(normals.mean(axis=0)), _LOWEST_COSINE)


def _variance(shown: Float64Array, directions: Float64Array, tilt: Float64Array) -> float:
    """Return the variance of the log intensities that a tilt does not explain."""
    return float((_inequality(shown, directions, tilt) ** 2).sum()) / max(len(shown) - 3, 1)


def _inequality(shown: Float64Array, directions: Float64Array, tilt: Float64Array) -> Float64Array:
    """Return the log intensities (F,), mean 0, that give a plane with this tilt the observed
    brightness.
    """
    unequal = np.log(shown / np.maximum(directions @ (*tilt, 1.0), _LOWEST_COSINE))
    return np.asarray(unequal - unequal.mean())


def _fit_tilt(shown: Float64Array, directions: Float64Array, variance: float) -> Float64Array:
    """Return the likeliest tilt (2,) of a plane, for log intensities of this variance and tilts of
    variance TILT^2.
    """
    tilt, certainty = np.zeros(2), TILT**2 / variance
    for _ in range(5):
        slopes = directions[:, :2] / np.maximum(directions @ (*tilt, 1.0), _LOWEST_COSINE)[:, None]
        slopes = slopes - slopes.mean(axis=0)
        right = certainty * slopes.T @ _inequality(shown, directions, tilt) - tilt
        tilt = tilt + np.linalg.solve(certainty * slopes.T @ slopes + np.eye(2), right)
    return tilt


def _fit(
    values: Float64Array, known: Bools, intensities: Float64Array, lights: Float64Array
) -> Float64Array:
    """Return the scaled normals (p, 3) of matte pixels with these observations, for lights (F, 3)
    or (p, F, 3).
    """
    observed = values / intensities
    largest = observed.max(axis=1, keepdims=True)
    observed = observed / largest
    normals, _ = fit_robustly(observed, shadow_weights(observed) * known, lights, 5)
    return np.asarray(normals * largest)


def _error(observed: Float64Array, predicted: Floats, known: Bools) -> float:
    """Return the median of |observed - predicted|, as a share of each pixel's brightest
    prediction.
    """
    shares = np.abs(observed - predicted) / np.maximum(predicted.max(axis=1, keepdims=True), 1e-12)
    return float(np.median(shares[known]))


COLOUR_SAMPLE = 1500  # pixels of which the colours are compared

_MIN_COLOUR_PIXELS = 50


def lamp_colours(colours: Floats) -> tuple[Float64Array | None, list[CaptureWarning]]:
    """Return the colours (F, 3) of lamps, by which channels are to be divided, or None for equal
    ones; and warnings.

    The argument (F, p, 3) is linear RGB of some pixels in all images, divided by the intensities
    that are known.
    """
    sums = colours.sum(axis=2, dtype=np.float64)
    lit = (sums > 0.15 * np.quantile(sums, 0.99)).all(axis=0)
    if np.count_nonzero(lit) < _MIN_COLOUR_PIXELS:
        # some of the pixels are in shadow everywhere
        lit = sums.min(axis=0) >= np.quantile(sums.min(axis=0), 0.7)
    if np.count_nonzero(lit) < _MIN_COLOUR_PIXELS:
        return None, []
    shares = colours[:, lit] / np.maximum(sums[:, lit, None], 1e-9)
    logs = np.log(np.maximum(shares, 1e-3))
    logs -= logs.mean(axis=2, keepdims=True)
    changes = logs - np.median(logs, axis=0)
    common = np.median(changes, axis=1)
    image, channel = np.unravel_index(np.abs(common).argmax(), common.shape)
    most = float(abs(common[image, channel]))
    scatter = float(np.median(np.abs(changes[image, :, channel] - common[image, channel])))
    variety = float(np.median(logs.std(axis=1).max(axis=1)))
    # White LEDs differ by 0.05. Light from other parts of the object varies over the pixels. An
    # object of one colour only looks brighter under one lamp and darker under another.
    if most < 0.15 or scatter > 0.4 * most or variety < 0.05:
        return None, []
    found = np.exp(common)
    found /= found.mean(axis=1, keepdims=True)
    said = "The colour of the light varies from image to image"
    if found.min() < 0.1:  # a fainter channel is mostly noise
        text = (
            f"{said}, and some lamps lack a colour, so it cannot be divided out. The normals of"
            " coloured objects are"
        )
        text += " wrong. Use white lamps, or give RGB intensities with --intensities FILE."
        # of an object with stripes of strong colours, at 0.5
        error_deg = 15.0 * min(1.0, variety / 0.5)
        return None, [CaptureWarning(codes.LIGHT_COLOURS, text, error_deg)]
    text = (
        f"{said}: it was estimated from the images and divided out. Use --intensities FILE if you"
        " have measured it."
    )
    return found, [CaptureWarning(codes.ESTIMATED_COLOURS, text)]
