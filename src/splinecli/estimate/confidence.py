"""Correct the errors that a network predicts, using residuals of the whole capture.

A single pixel does not allow wrong lights or values to be distinguished from an unusual
reflectance. Many pixels do: calibration errors depend on the lights, the position in the image, or
the brightness in the same way everywhere.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from splinecli.capture import Capture
from splinecli.estimate.methods.estimator import Estimator
from splinecli.lights.light_fit import LIT_SHARE, MIN_PIXELS_PER_LIGHT, find_factors
from splinecli.lights.lighting import LightingAt, PixelIndices, PixelPlaces, parts_of_pixels
from splinecli.lights.rough_normals import smooth_normals
from splinecli.maths import Bools, Float32Array, Float64Array, Floats, Integers
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import Blocks
from splinecli.maths.robust import absolute_weights, fit_robustly, fit_scaled_normals
from splinecli.system.machine import side_by_side

# with fewer, the residuals of a fit do not suffice to assess a capture
_FEWEST_LIGHTS, _FEWEST_PIXELS = 5, 50
_FITS = 4
# The shape of the log-logistic distribution of an error that all normals share; four out of five
# are within a factor of 1.6.
COMMON_SHAPE = 3.5
_LEAST_SHARE, _LEAST_DEG = 1e-3, 0.1  # added before a logarithm is taken


def correct_errors(
    capture: Capture,
    estimator: Estimator,
    lighting_at: LightingAt,
    normals: Float32Array,
    errors: Float32Array,
) -> bool:
    """Correct the distributions of errors (P, 2) of normals (P, 3) in place; return whether this
    was possible.

    It is impossible if the capture is too small, or if there is no correction for the estimator's
    weights. Pixels that are black under every light are left unchanged. `lighting_at` returns the
    light of given pixels.
    """
    import torch

    from splinecli.estimate.networks.weights import capture_head

    head = None if estimator.weights is None else capture_head(estimator.weights["sha256"])
    if head is None:
        return False
    found = capture_features(capture.mask, lighting_at, normals, errors, capture.light_directions)
    if found is None:
        return False
    features, scale = found
    whole = torch.tensor(features, dtype=torch.float32)
    places = PixelPlaces(capture.mask)

    def correct(rows: PixelIndices) -> None:
        brightness = capture.observations[rows].mean(axis=1)
        rows, brightness = rows[brightness > 0], brightness[brightness > 0]
        pixels = scale.features(brightness, normals[rows], *places.places(rows))
        own = torch.from_numpy(errors[rows])
        errors[rows] = head(own, torch.from_numpy(pixels.astype(np.float32)), whole).numpy()

    for _ in side_by_side(correct, parts_of_pixels(len(normals))):
        pass
    return True


def add_common_error(errors: Float32Array, error_deg: float) -> None:
    """Widen distributions of errors (P, 2) in place by an error in degrees that all normals share.

    Wrong lights or values rotate all normals together. The medians of both errors are added in
    quadrature, as for independent errors, and the shape approaches the shape of the common error if
    that error is larger.
    """
    own = 2 * errors[:, 0]
    errors[:, 0] = np.logaddexp(own, 2 * np.log(np.radians(error_deg))) / 2
    share = -np.expm1(own - 2 * errors[:, 0])
    errors[:, 1] += share * (np.log(COMMON_SHAPE) - errors[:, 1])


class CaptureFeatures(NamedTuple):
    """Numbers that describe how well a capture satisfies the assumptions; NaN if unknown.

    A misfit is the logarithm of a matte surface's residual relative to the brightness, as a median
    over pixels. A turn is the logarithm of the median angle in degrees by which normals would
    rotate.
    """

    misfit: float  # for the estimated normals
    free_misfit: float  # for the best-fitting normals
    # log of the residual of all images after the best fit of rank 3
    rank_residual: float
    light_misfit: float  # log of the distance of the lights from the lights of this fit
    free_light_misfit: float  # the same for arbitrary intensities
    # log of the share of the residual that remains after decoding the values once more
    decoding: float
    # width of the object over the distance of the lamps that the residuals indicate
    nearness: float
    near_share: float  # share of the residual that near lamps explain
    near_turn: float
    # log of the exponent of the values that the residuals indicate; it rotates normals only below
    # 1, as for encoded values
    bend: float
    bend_share: float
    bend_turn: float
    curl: float  # log of the ratio between the curl of the normals and their derivatives
    # |cosine| between normals and the outward direction at a steep outline; 1 for a ball or a bowl
    rim: float
    lights: float  # log of the number of lights
    spread: float  # how well the lights determine a normal
    # log of the median angle in degrees between the estimated and the best-fitting normals
    difference: float
    expected: float  # mean logarithm of the predicted errors
    shadow: float  # share of shadowed observations
    dark: float  # share of dark pixels


@dataclass(frozen=True)
class PixelScale:
    """Constants that relate pixels to their capture."""

    bright: float  # brightness of a bright pixel
    middle: tuple[float, float]  # row and column of the middle of the object
    width: float  # of the object, in pixels
    # (3, 3, 2), the linear map from a normal and its place to the normal's rotation by near lamps
    turning: Float64Array

    def features(
        self, brightness: Floats, normals: Floats, rows: Integers, columns: Integers
    ) -> Float64Array:
        """Return the features (n, 2) of pixels: the logarithms of their relative brightness, and of
        their rotation by near lamps in degrees.
        """
        turn_deg: Floats = np.zeros(len(normals))
        if self.turning.any():
            places = self.places(rows, columns).astype(np.float32)
            both = (normals[:, :, None] * places[:, None]).reshape(-1, 6)
            turn = both @ self.turning.reshape(3, 6).T.astype(np.float32)
            turn -= (turn * normals).sum(axis=1, keepdims=True) * normals
            turn_deg = np.degrees(np.arctan(np.linalg.norm(turn, axis=1)))
        return np.stack((np.log(brightness / self.bright + 1e-3), np.log(turn_deg + 0.3)), axis=1)

    def places(self, rows: Integers, columns: Integers) -> Float64Array:
        """Return places (n, 2) relative to the middle of the object, x right and y up, in widths of
        the object.
        """
        return np.stack((columns - self.middle[1], self.middle[0] - rows), axis=1) / self.width


def capture_features(
    mask: Bools,
    lighting_at: LightingAt,
    normals: Float32Array,
    errors: Float32Array,
    lights: Float64Array,
) -> tuple[CaptureFeatures, PixelScale] | None:
    """Return the features of a capture and its PixelScale, or None if too few pixels are usable.

    The mask (H, W) has P pixels with normals (P, 3) and errors (P, 2); see networks/li_ne_net.py.
    The lights (F, 3) are unit vectors, at the origin for near lamps. `lighting_at` returns the
    light of given pixels.
    """
    n_lights = len(lights)
    if n_lights < _FEWEST_LIGHTS:
        return None
    rows = np.arange(
        0, len(normals), -(-len(normals) // max(1500, 3 * MIN_PIXELS_PER_LIGHT * n_lights // 2))
    )
    light = lighting_at(rows)
    brightness = light.observations.mean(axis=1, dtype=np.float64)
    bright = float(np.quantile(brightness, 0.95))
    kept = brightness > 0.1 * bright  # darker pixels carry no information about the capture
    if np.count_nonzero(kept) < _FEWEST_PIXELS:
        return None
    values = light.observations[kept].astype(np.float64)
    values /= values.max(axis=1, keepdims=True)
    own = normals[rows][kept].astype(np.float64)
    if light.directions.ndim == 3:  # convert the values of matte pixels to distant lights
        directions = light.in_frame_of_capture(light.directions)[kept]
        scaled = fit_scaled_normals(
            values, (values > LIT_SHARE).astype(np.float64), directions.astype(np.float64)
        )
        values = (values + np.einsum("pfc,pc->pf", lights - directions, scaled)).clip(min=0)
        values = np.asarray(values / values.max(axis=1, keepdims=True).clip(min=1e-12))
    lit = (values > LIT_SHARE).astype(np.float64)
    shaded = (lit * values).sum(axis=1).clip(min=LIT_SHARE)

    left = _residuals_under(own, values, lit, lights)
    scaled, weights = fit_robustly(values, lit, lights, _FITS)
    fitted = scaled @ lights.T
    residuals = values - fitted
    best = unit(scaled)
    difference = angle_between_deg(own, best)

    def explain(terms: Float64Array, sign: int) -> tuple[float, float, float]:
        """Return the amount of `terms` (p, F) in the residuals, the share that they explain, and
        the log of the rotation.

        An amount with the opposite sign is not due to this fault and does not rotate normals.
        """
        scaled_terms = fit_scaled_normals(terms, weights, lights)
        terms = terms - scaled_terms @ lights.T
        power = (weights * terms**2).sum()
        # The terms are accurate to first order in width over distance, or in the change of the
        # exponent.
        amount = float(((weights * terms * residuals).sum() / max(power, 1e-12)).clip(-1.5, 1.5))
        share = amount**2 * power / max((weights * residuals**2).sum(), 1e-12)
        turn = angle_between_deg(best, unit(scaled - sign * max(sign * amount, 0.0) * scaled_terms))
        return amount, float(share), _log_median(turn, _LEAST_DEG)

    places = PixelPlaces(mask)
    row, column = places.places(rows[kept])
    middle = float(row.mean()), float(column.mean())
    scale = PixelScale(bright, middle, float(np.sqrt(len(normals))), np.zeros((3, 3, 2)))
    at = scale.places(row, column)
    # To first order in width over distance, observations under near lamps are n.l (1 + 3 l.x) -
    # n.x.
    near = explain(
        3 * fitted * (at @ lights[:, :2].T) - (scaled[:, :2] * at).sum(axis=1, keepdims=True), 1
    )
    bend = explain(values * np.log(values.clip(min=0.01)), -1)
    features = CaptureFeatures(
        _log_median((np.abs(left) * lit).sum(axis=1) / shaded),
        _log_median((np.abs(residuals) * lit).sum(axis=1) / shaded),
        *_of_factors(values, lights),
        *near,
        *bend,
        *_of_shape(mask, places, normals),
        lights=float(np.log(n_lights)),
        spread=float(np.linalg.svd(lights, compute_uv=False)[-1] / np.sqrt(n_lights)),
        difference=_log_median(difference, _LEAST_DEG),
        expected=float(errors[rows[kept], 0].mean()),
        shadow=float(1 - lit.mean()),
        dark=float(1 - kept.mean()),
    )
    # The change (3,) of a normal by lamps at a distance of one width, per normal (3,) and place
    # (2,)
    solve = np.linalg.pinv(lights)
    turning = 3 * np.einsum("kf,fi,fj->kij", solve, lights, lights[:, :2])
    for axis in range(2):
        turning[:, axis, axis] -= solve.sum(axis=1)
    return features, replace(scale, turning=max(near[0], 0.0) * np.asarray(turning))


def _log_median(values: Float64Array, least: float = _LEAST_SHARE) -> float:
    return float(np.log(np.median(values) + least))


def _residuals_under(
    normals: Float64Array, values: Float64Array, lit: Float64Array, lights: Float64Array
) -> Float64Array:
    """Return the residuals of values (p, F) for matte pixels with these normals (p, 3) and the best
    albedos.
    """
    cosines = (normals @ lights.T).clip(min=0)
    seen = lit * (cosines > 0.05)  # predictions at grazing light are too uncertain
    weights = seen
    for _ in range(_FITS):
        albedo = (weights * values * cosines).sum(axis=1) / (weights * cosines**2).sum(axis=1).clip(
            min=1e-6
        )
        left = values - albedo[:, None] * cosines
        weights = seen * absolute_weights(left)
    return np.asarray(left)


def _of_factors(values: Float64Array, lights: Float64Array) -> tuple[float, float, float, float]:
    """Return rank_residual, light_misfit, free_light_misfit and decoding; see CaptureFeatures."""
    few = values[:: max(1, len(values) // max(1000, (MIN_PIXELS_PER_LIGHT + 1) * len(lights)))]
    factors = find_factors(few)
    if factors is None:
        return (np.nan,) * 4
    decoded = find_factors(np.maximum(few, 0) ** 2.2)  # an exponent close to the curve of sRGB
    misfits = (each.misfits(lights[None])[0] for each in (factors, factors.with_free_intensities()))
    known, free = (float(np.log(misfit + _LEAST_SHARE)) for misfit in misfits)
    rank = float(np.log(factors.residual + _LEAST_SHARE))
    if decoded is None:
        return rank, known, free, np.nan
    before, after = (
        np.hypot(each.misfits(lights[None])[0], each.residual) for each in (factors, decoded)
    )
    return rank, known, free, float(np.log(after / max(before, _LEAST_SHARE)))


def _of_shape(mask: Bools, places: PixelPlaces, normals: Floats) -> tuple[float, float]:
    """Return curl and rim of the normals (P, 3), averaged over blocks; see CaptureFeatures."""
    blocks = Blocks.over(mask, 2500)
    if min(blocks.mask.shape) < 2:
        return np.nan, np.nan
    sums = np.zeros((3, np.count_nonzero(blocks.mask)))
    for rows in parts_of_pixels(len(normals)):
        number = blocks.numbers_at(*places.places(rows))
        for total, column in zip(sums, normals[rows].T, strict=True):
            total += np.bincount(number, column, len(total))
    smooth = smooth_normals(sums.T, blocks.mask)
    return float(np.log(smooth.curl() + 0.01)), abs(smooth.rim())
