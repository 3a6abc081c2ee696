"""Other readings of the images and their lights: encoded values, near lamps, unequal intensities,
light that every image has, and elevations of the lights that are all too high or too low.

Any one of them can be mistaken for another, so all are fitted to the same pixels. A matte model is
fitted under each reading, and its residual is computed in stored values. judge_net.py compares them
together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np

from splinecli.capture.near_lamps import NearLamps
from splinecli.capture.sample import Sample
from splinecli.maths import Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import absolute_weights, inverse_3x3, lit_values, multiply_symmetric

Kind = Literal["curve", "near", "offset", "intensities", "elevation"]
ALL_KINDS: tuple[Kind, ...] = get_args(Kind)
_EXPONENTS = (1.4, 1.6, 1.8, 2.0, 2.2, 2.4, 2.6)  # of gamma curves
SRGB_EXPONENT = 2.2  # a curve of this gamma is close to sRGB
_HEIGHTS = (
    0.4,
    0.5,
    0.6,
    0.7,
    0.8,
    0.9,
    1.12,
    1.25,
    1.4,
    1.6,
    1.8,
    2.0,
    2.5,
)  # factors of z of the lights
_WIDTHS = (0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 11.0)  # distances of lamps, in widths of the object
LIKELY = 0.5  # probability from which a reading is named
CLEAR = 0.95  # probability from which images are read so
_FOR_MOST = 6  # fewer lights determine the constant light only
# share of the residual at which a curve behind unequal lamps is better than one behind equal ones
_MUCH_LESS = 0.6
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # xx, yy, zz, xy, xz, yz of a product
_SHADOW = 0.1  # of a pixel's largest value; smaller values are shadow


@dataclass(frozen=True, eq=False)
class Explanation:
    """A reading of the images, and how well it fits."""

    kind: Kind
    # exponent, distance in widths of the object, constant light, or factor of z of the lights; 1
    # for intensities
    amount: float
    ratio: float  # residual over the given reading's, on the same observations
    normals: Float64Array  # (p, 3), scaled, at the chosen pixels
    intensities: Float64Array  # (F,), mean 1; ones unless they are free


class Doubt(NamedTuple):
    """The probability that the given reading is wrong, and the reading that is then right."""

    reading: Explanation
    probability: float  # that any other reading is right
    # kinds of readings that the images hardly distinguish from it
    others: tuple[Kind, ...] = ()

    @property
    def is_clear(self) -> bool:
        """Whether it is so likely that the images are read in this way by default."""
        return self.probability > CLEAR and not self.others


@dataclass(frozen=True, eq=False)
class Fit:
    """A matte model under one reading."""

    residual: float
    normals: Float64Array
    intensities: Float64Array


class Explanations:
    """The pixels of a sample, whose observations are as stored, and the readings that were fitted
    to them.

    `lights` are (F, 3), unit; `intensities` (F,) were measured, or are None for equal ones.
    """

    def __init__(
        self,
        sample: Sample,
        lights: Float64Array,
        intensities: Float64Array | None = None,
    ) -> None:
        n_lights = len(lights)
        # Pixels below this share of the brightest hundredth are background.
        chosen, values = lit_values(sample.observations, 0.1, min(400, 16_000 // n_lights))
        # If a share of 1e-3 of the values is within 1e-5 of the largest one, they are saturated.
        clipped = sample.observations[chosen] >= (1 - 1e-5) * sample.observations.max()
        # Values at full scale look like a curve. Treated as shadows, they are ignored.
        if clipped.sum() > 1e-3 * clipped.size:
            values[clipped] = 0
        values = values.clip(min=0)
        # Three unknowns, and some more values that can contradict them.
        enough = (values > _SHADOW).sum(axis=1) >= min(5, n_lights)
        self.values, self.lights, self.intensities = values[enough], lights, intensities
        self.rows, self.columns = (places[chosen[enough]] for places in np.nonzero(sample.mask))
        self.width = float(np.ptp(np.flatnonzero(sample.mask.any(axis=0))) + 1)
        self.shape = sample.mask.shape
        self.are_enough = n_lights >= 4 and len(self.values) >= 60

    @cached_property
    def given(self) -> Fit:
        """The fit under the given reading."""
        return _fit(self.values, self._with(self.lights))[0]

    @cached_property
    def readings(self) -> dict[Kind, Explanation]:
        """The best reading of each kind; none with too few lit pixels or lights."""
        if not self.are_enough:
            return {}
        vectors, given = self._with(self.lights), self.given
        found: dict[Kind, Explanation] = {
            "offset": _best("offset", self._offset_fits(vectors), given)
        }
        if len(self.lights) < _FOR_MOST:
            return found
        (free,) = _fit(self.values, vectors, free=True)
        unequal = _best("intensities", {1.0: free}, given)
        curve, behind = self._best_curve(), self._best_curve(free=True)
        # unequal lamps may hide a curve
        behind = replace(behind, ratio=behind.ratio * unequal.ratio)
        lights = np.stack([self._with(unit(self.lights * (1, 1, each))) for each in _HEIGHTS])
        heights = dict(zip(_HEIGHTS, _fit(self.values, lights[:, None]), strict=True))
        return found | {
            "curve": behind if behind.ratio < _MUCH_LESS * curve.ratio else curve,
            "near": self._best_near(free),
            "intensities": unequal,
            "elevation": _best("elevation", heights, given),
        }

    def error_deg(self, reading: Explanation, used: Float64Array | None = None) -> float:
        """Return the median angle in degrees between a reading's normals and the given reading's.

        `used` are the intensities (F,) that were estimated and are divided out; None if there are
        none.
        """
        lights = self.lights if used is None else self.lights * used[:, None]
        given = self.given if used is None else _fit(self.values, self._with(lights))[0]
        return float(np.median(angle_between_deg(unit(given.normals), unit(reading.normals))))

    def _best_curve(self, *, free: bool = False) -> Explanation:
        # encoded shadows are brighter
        vectors, gammas = self._with(self.lights), (1.0, *_EXPONENTS)
        given, *fits = _fit(self.values, vectors, gammas, free=free, shadow=0.35)
        return _best("curve", dict(zip(_EXPONENTS, fits, strict=True)), given)

    def _best_near(self, given: Fit) -> Explanation:
        """Return the best distance. Intensities are free: near lamps look unequal, and unequal
        lamps may be near.
        """
        lights = np.stack([self._with(self._near(widths)) for widths in _WIDTHS])
        fits = dict(zip(_WIDTHS, _fit(self.values, lights, free=True), strict=True))
        return _best("near", fits, given)

    @cached_property
    def roundness(self) -> float:
        """How round the object is: the share of the variance of the pixels' places that a cubic
        function of the slopes of the normals predicts.

        On a ball, gloss varies with the position, like the light of near lamps.
        """
        places = np.stack((self.columns, -self.rows), axis=1)
        across = unit(self.given.normals)[:, :2]
        cubic = across * (across**2).sum(axis=1, keepdims=True)
        terms = np.concatenate((across, cubic, np.ones((len(across), 1))), axis=1)
        missed = places - terms @ np.linalg.lstsq(terms, places, rcond=None)[0]
        return float(1 - missed.var(axis=0).sum() / max(places.var(axis=0).sum(), 1e-12))

    def _offset_fits(self, vectors: Float64Array) -> dict[float, Fit]:
        """Return fits with constant light, over the value of a pixel that faces the light, and
        around the best one.
        """
        fits = _fit_with_offsets(self.values, vectors, [0.02 * 1.5**k for k in range(16)])
        for _ in range(3):  # halve the interval around the best constant light
            tried = sorted(fits)
            best = tried.index(min(tried, key=lambda offset: fits[offset].residual))
            around = pairwise(tried[max(best - 1, 0) : best + 2])
            between = [float(np.sqrt(one * other)) for one, other in around]
            fits |= _fit_with_offsets(self.values, vectors, between)
        return fits

    def _near(self, widths: float) -> Float64Array:
        lamps = NearLamps.of(self.lights * widths * self.width, 1.0, self.shape, equal=True)
        directions, attenuations = lamps.light_at(lamps.plane_points(self.rows, self.columns))
        return np.asarray(directions * attenuations[..., None], np.float64)

    def _with(self, lights: Float64Array) -> Float64Array:
        return lights if self.intensities is None else lights * self.intensities[:, None]


def _best(kind: Kind, fits: Mapping[float, Fit], given: Fit) -> Explanation:
    """Return the best of some fits by their amounts."""
    amount = min(fits, key=lambda each: fits[each].residual)
    found = fits[amount]
    least = 1e-4  # 16 bits do not go below it
    ratio = (found.residual + least) / (given.residual + least)
    return Explanation(kind, amount, ratio, found.normals, found.intensities)


def _fit(
    values: Float64Array,
    lights: Float64Array,
    gammas: Sequence[float] = (1.0,),
    *,
    free: bool = False,
    shadow: float = _SHADOW,
) -> list[Fit]:
    """Fit values^gamma = e max(l . b, 0) by least absolute deviations of the values, side by side
    for each gamma and each set of lights.

    Values (p, F) are scaled to 1; lights are (F, 3) or (H, p, F, 3), of any length. Intensities e
    are 1 or free.
    """
    stored, vectors = values.T, _by_axis(lights)
    gamma = np.array(gammas)[:, None, None]
    lit = stored > shadow
    # The slope of the linear value over the stored one, so that all readings have the same errors.
    start = lit / (gamma * np.maximum(stored, shadow) ** (gamma - 1))
    observed, weights, products = stored**gamma, start, _products(vectors)
    count = max(len(gammas), len(vectors))
    intensities = np.ones((count, len(stored)))
    for _ in range(30 if free else 8):
        e = intensities[..., None]
        scaled = weights * e
        normals = _solve(products, vectors, scaled * e, scaled * observed)
        equal = _shade(normals, vectors)
        weights = start * absolute_weights(observed - equal * e)
        if free:
            intensities = _intensities(observed, equal, weights, intensities)
    left = np.abs(stored - np.maximum(equal * e, 0) ** (1 / gamma))[:, lit]
    return _described(left, normals, intensities)


def _fit_with_offsets(
    values: Float64Array, lights: Float64Array, offsets: Sequence[float]
) -> dict[float, Fit]:
    """Fit values = max(l . b, 0) + offset |b|, as in _fit, for lights (F, 3) and each offset."""
    stored, vectors = values.T, _by_axis(lights)
    products, offset = _products(vectors), np.array(offsets)[:, None, None]
    lit = stored > _SHADOW
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


def constant_light(values: Floats, lights: Float64Array, share: float) -> Float64Array:
    """Return the constant light (p, 1) in values (p, F), which is a share of the value of a pixel
    that faces the light of a lamp; lights (F, 3) have any length.
    """
    largest = np.maximum(values.max(axis=1, keepdims=True), 1e-12)
    scaled = np.asarray(values / largest, np.float64)
    normals = _fit_with_offsets(scaled, lights, [share])[share].normals
    return np.asarray(largest * share * np.linalg.norm(normals, axis=1, keepdims=True))


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
