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
from splinecli.maths.robust import fit_robustly, lit_values, shade, shadow_weights
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning

Lights = Float64Array | Callable[[Integers], Float64Array]

# Each light adds an unknown. Four observations fit any intensities, and with five lights half of
# the estimates are wrong.
FEWEST_FOR_INTENSITIES = 6
# Normals with a smaller spread (their second largest standard deviation) belong to a flat object,
# such as a coin or a painting. Tilting all its normals together has the same effect as other
# intensities, so the likeliest tilt is used.
FLAT_SPREAD = 0.35
# standard deviation of the slope of flat objects towards the camera, in x and in y: 5 degrees
TILT = 0.09
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
    rows, values = lit_values(observations, 0.1, min(2000, 100_000 // n_lights))
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
    intensities = _likeliest_tilt(intensities, unit(fit.normals), light_vectors)
    intensities /= intensities.mean()
    normals = _fit(values, known, intensities, light_vectors)
    if spread_of(unit(normals)) < FLAT_SPREAD:
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


def _likeliest_tilt(
    intensities: Float64Array, normals: Float64Array, lights: Float64Array
) -> Float64Array:
    """Return the intensities (F,) that explain the same images of a flat object with its likeliest
    tilt.

    Under a tilt t, a plane that shows k_f needs intensities k_f / l_f . (t, 1). The likeliest tilt
    leaves intensities that are nearly equal, and is small itself. Of other objects, the intensities
    are returned as they are.
    """
    if spread_of(normals) >= FLAT_SPREAD:
        return intensities
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
    directions = unit(lights if lights.ndim == 2 else lights.mean(axis=0))
    return directions, intensities * np.maximum(
        directions @ unit(normals.mean(axis=0)), _LOWEST_COSINE
    )


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
