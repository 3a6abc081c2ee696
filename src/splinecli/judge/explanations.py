"""Other readings of the images and their lights: encoded values, near lamps, unequal intensities,
light that every image has, and elevations of the lights that are all too high or too low.

Any one of them can be mistaken for another, so all are fitted to the same pixels. A matte model is
fitted under each reading, and its residual is computed in stored values. judge_net.py compares them
together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np

from splinecli.capture.near_lamps import NearLamps
from splinecli.capture.sample import Sample
from splinecli.maths import Float64Array, Floats
from splinecli.maths.matte import SHADOW, Fit, fit_matte, fit_with_offsets
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import lit_values

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
# Images are also read with a likely curve that leaves at most this share of the residual, if the
# others leave so many times as much. Of 900 rendered captures, 14 are such: all are encoded except
# for a translucent one.
CLEAR_CURVE, TIMES = 0.25, 1.7
_FOR_MOST = 6  # fewer lights determine the constant light only
# share of the residual at which a curve behind unequal lamps is better than one behind equal ones
_MUCH_LESS = 0.6


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
    fits_alone: bool = False  # whether it leaves much less of the residual than any other reading

    @property
    def is_clear(self) -> bool:
        """Whether it is so likely that the images are read in this way by default."""
        fits = self.fits_alone and self.reading.ratio <= CLEAR_CURVE
        return not self.others and (self.probability > CLEAR or fits)


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
        enough = (values > SHADOW).sum(axis=1) >= min(5, n_lights)
        self.values, self.lights, self.intensities = values[enough], lights, intensities
        self.rows, self.columns = (places[chosen[enough]] for places in np.nonzero(sample.mask))
        self.width = float(np.ptp(np.flatnonzero(sample.mask.any(axis=0))) + 1)
        self.shape = sample.mask.shape
        self.are_enough = n_lights >= 4 and len(self.values) >= 60

    @cached_property
    def given(self) -> Fit:
        """The fit under the given reading."""
        return fit_matte(self.values, self._with(self.lights))[0]

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
        (free,) = fit_matte(self.values, vectors, free=True)
        unequal = _best("intensities", {1.0: free}, given)
        curve, behind = self._best_curve(), self._best_curve(free=True)
        # unequal lamps may hide a curve
        behind = replace(behind, ratio=behind.ratio * unequal.ratio)
        lights = np.stack([self._with(unit(self.lights * (1, 1, each))) for each in _HEIGHTS])
        heights = dict(zip(_HEIGHTS, fit_matte(self.values, lights[:, None]), strict=True))
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
        given = self.given if used is None else fit_matte(self.values, self._with(lights))[0]
        return float(np.median(angle_between_deg(unit(given.normals), unit(reading.normals))))

    def _best_curve(self, *, free: bool = False) -> Explanation:
        # encoded shadows are brighter
        vectors, gammas = self._with(self.lights), (1.0, *_EXPONENTS)
        given, *fits = fit_matte(self.values, vectors, gammas, free=free, shadow=0.35)
        return _best("curve", dict(zip(_EXPONENTS, fits, strict=True)), given)

    def _best_near(self, given: Fit) -> Explanation:
        """Return the best distance. Intensities are free: near lamps look unequal, and unequal
        lamps may be near.
        """
        lights = np.stack([self._with(self._near(widths)) for widths in _WIDTHS])
        fits = dict(zip(_WIDTHS, fit_matte(self.values, lights, free=True), strict=True))
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
        fits = fit_with_offsets(self.values, vectors, [0.02 * 1.5**k for k in range(16)])
        for _ in range(3):  # halve the interval around the best constant light
            tried = sorted(fits)
            best = tried.index(min(tried, key=lambda offset: fits[offset].residual))
            around = pairwise(tried[max(best - 1, 0) : best + 2])
            between = [float(np.sqrt(one * other)) for one, other in around]
            fits |= fit_with_offsets(self.values, vectors, between)
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


def constant_light(values: Floats, lights: Float64Array, share: float) -> Float64Array:
    """Return the constant light (p, 1) in values (p, F), which is a share of the value of a pixel
    that faces the light of a lamp; lights (F, 3) have any length.
    """
    largest = np.maximum(values.max(axis=1, keepdims=True), 1e-12)
    scaled = np.asarray(values / largest, np.float64)
    normals = fit_with_offsets(scaled, lights, [share])[share].normals
    return np.asarray(largest * share * np.linalg.norm(normals, axis=1, keepdims=True))
