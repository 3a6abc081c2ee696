"""What the shading of a matte surface leaves open about its lights, and the evidence that decides it.

A bump looks like a hollow under lights with x and y negated: shading, attached shadows and highlights are equal, also
the curl of the normals. Cast shadows and the outline differ. And the heights of a surface may be scaled if its lights
are lowered or raised with them, the generalised bas-relief ambiguity, which keeps all shadows (Belhumeur, Kriegman and
Yuille, "The bas-relief ambiguity", IJCV 1999). The albedo then changes with the slope.
"""

import numpy as np

from splinecli.diagnosis.cast_shadows import cast_shadows
from splinecli.diagnosis.frame_evidence import smooth_normals
from splinecli.fits.robust import fit_robustly, lit_values, shadow_weights
from splinecli.maths import Bools, Doubles, Singles
from splinecli.maths.normals import unit
from splinecli.surface.integration import integrate_normals
from splinecli.surface.pixel_grid import Blocks

# Logistic regression on 1,056 rendered captures, on which it errs in 1 % of the decisions (3 % without the outline).
_SHADOW_LOG_ODDS, _OUTLINE_LOG_ODDS = 11.0, 8.0

_BLOCKS = 1200  # at most twice as many
_FITS = 5
_LEAST_Z = 0.1  # of normals that are integrated
_FACING = 0.15  # predicted share of a pixel's brightest observation, above which darkness is a cast shadow
_SHADOW = 0.5  # of the predicted brightness
_DARK_SHARE = 0.02  # of the brightest hundredth

_LOW_DEG = 55.0  # mean elevation of lights, below which the network finds them too high
_LOG_HEIGHTS = np.arange(-1.2, 0.05, 0.1)  # logarithms of the factors of the heights of the lights that are tried
_HEIGHT_PRIOR = 49.0  # entropy per square of this logarithm and of the expected error in degrees
_ALBEDO_BIN, _ALBEDO_BINS = 0.1, 41  # of the logarithm of the albedo
_MOST_PIXELS, _SHADE = 2000, 0.1


def bump_log_odds(observations: Singles, mask: Bools, light_directions: Doubles) -> float:
    """Return the log odds that the lights are right against that their x and y are negated.

    Args:
        observations: (P, F), linear, divided by the light intensities.
        mask: (H, W) with P true pixels, in row-major order.
        light_directions: (F, 3), unit.
    """
    blocks = Blocks.over(mask, _BLOCKS)
    values, mask = blocks.average(observations, mask).astype(np.float64), blocks.mask
    brightest = values.max(axis=1, keepdims=True)
    bright = brightest > _DARK_SHARE * np.quantile(brightest, 0.99)
    values /= np.maximum(brightest, 1e-12)
    scaled, _ = fit_robustly(values, shadow_weights(values), light_directions, _FITS)
    rough = smooth_normals(scaled, mask)
    rim = rough.rim()
    outline = 0.0 if np.isnan(rim) else rim * rough.rim_steepness

    normals = np.zeros((*mask.shape, 3))
    normals[mask] = unit(scaled)
    normals[..., 2] = np.where(mask, normals[..., 2].clip(min=_LEAST_Z), 0)
    heights = np.where(mask, integrate_normals(unit(normals), mask), np.nan)
    predicted = scaled @ light_directions.T
    facing = bright & (predicted > _FACING)
    dark = values[facing] < _SHADOW * predicted[facing]
    bump, hollow = (
        _correlation(cast_shadows(sign * heights, light_directions * (sign, sign, 1))[mask][facing], dark)
        for sign in (1, -1)
    )
    return _SHADOW_LOG_ODDS * (bump - hollow) + _OUTLINE_LOG_ODDS * outline


def _correlation(predicted: Bools, seen: Bools) -> float:
    """Return the correlation of two sets; 0 where one has all or none."""
    if min(predicted.sum(), (~predicted).sum(), seen.sum(), (~seen).sum()) == 0:
        return 0.0
    return float(np.corrcoef(predicted, seen)[0, 1])


def lower_lights(observations: Singles, light_directions: Doubles, error_deg: float) -> Doubles:
    """Return low lights (F, 3), lowered together towards those under which the albedo has few values; others as given.

    The entropy of the albedo is least (Alldrin, Mallick and Kriegman, "Resolving the generalized bas-relief ambiguity
    by entropy minimization", CVPR 2007). Lights are only lowered, as the network's errors are upwards.

    Args:
        observations: (P, F), linear, divided by the light intensities.
        light_directions: (F, 3), unit.
        error_deg: the mean expected error.
    """
    if np.degrees(np.arcsin(light_directions[:, 2].clip(-1, 1))).mean() > _LOW_DEG:
        return light_directions
    chosen, values = lit_values(observations, _DARK_SHARE, _MOST_PIXELS)
    lit = values > _SHADE * np.quantile(values, 0.6, axis=1, keepdims=True)
    scaled, _ = fit_robustly(values, lit.astype(np.float64), light_directions, _FITS)
    known = (lit.sum(axis=1) > 3) & (unit(scaled)[:, 2] > _LEAST_Z)
    scaled = (scaled * observations[chosen].max(axis=1)[:, None])[known]
    if len(scaled) < _ALBEDO_BINS:
        return light_directions
    prior = _HEIGHT_PRIOR / error_deg**2
    costs = [_entropy(scaled / (1, 1, np.exp(log))) + prior * log**2 for log in _LOG_HEIGHTS]
    return np.asarray(unit(light_directions * (1, 1, np.exp(_LOG_HEIGHTS[int(np.argmin(costs))]))))


def _entropy(scaled_normals: Doubles) -> float:
    """Return the entropy of the logarithms of the lengths of vectors (p, 3), relative to their median."""
    albedo = np.log(np.linalg.norm(scaled_normals, axis=1))
    places = np.rint((albedo - np.median(albedo)) / _ALBEDO_BIN) + _ALBEDO_BINS // 2
    counts = np.bincount(places.clip(0, _ALBEDO_BINS - 1).astype(int), minlength=_ALBEDO_BINS)
    shares = np.convolve(counts / len(albedo), (0.25, 0.5, 0.25))
    return float(-(shares[shares > 0] * np.log(shares[shares > 0])).sum())
