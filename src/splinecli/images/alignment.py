"""Register images that moved between exposures, without being misled by the changing light.

All images are compared with a matte surface under their lights, I = l . b, so that the light's
effect on the images is part of the model. The transforms, and small corrections of the lights,
minimise the robust residuals of this model jointly, by Gauss-Newton steps in which every pixel's b
is eliminated (variable projection). This is the batch alignment of Y. Peng, A. Ganesh, J. Wright,
W. Xu, Y. Ma, "RASL: Robust alignment by sparse and low-rank decomposition", TPAMI 2012, with the
known lights instead of an unknown subspace. The images are high-pass filtered, which keeps the
model linear and removes most of the gloss. The first shifts come from correlations of the gradients
of images with similar lights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from splinecli.images.registration import ShiftedSums, are_still
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Floats
from splinecli.maths.pixel_grid import slices
from splinecli.maths.robust import inverse_3x3

Model = Literal["translation", "similarity", "homography"]
PARAMETERS: dict[Model, int] = {"translation": 2, "similarity": 4, "homography": 8}

MIN_IMAGES = 5
"""A pixel's b has three unknowns, so four images leave only one residual; they were misaligned by
pixels in trials.
"""

MOST_VALUES = 40_000_000
"""Images are reduced until they have at most this many pixels in total: 160 MiB."""

LEAST_FIT, CLEAR_FIT, MOST_UNLIKE = 0.3, 0.8, 3.0
"""An image does not fit if its correlation with its prediction from the others is below CLEAR_FIT,
and farther from 1 than the median correlation by the factor MOST_UNLIKE, because images with little
detail fit badly, but alike. A median below LEAST_FIT leaves nothing to align by: it is 0.05 to 0.25
on a real ball, and 0.44 to 0.95 on two statues."""

LARGEST_MOTION = 0.35  # of a pixel, as a share of the object's longer side
UNMOVED = 0.1  # pixels; a capture in which no image moved by more is left as it is

_REACH = 0.25  # of the first shifts, as a share of the object's shorter side
# pixels of the object on the coarsest level, and of images for first shifts
_SMALLEST_SIDE, _SIDE_OF_FIRST = (
    20,
    128,
)
# whose places are computed at a time: those of a whole image would take 60 bytes a pixel
_ROWS = 32
_NEIGHBOURS = 8  # images with similar lights that each image is compared with for its first shift
_HIGH_PASS, _LOW_PASS = 3.0, 0.7  # standard deviations in pixels
_MOST_OBSERVATIONS = 600_000  # on a level
_LIGHT_SIGMA, _BRIGHTNESS_SIGMA = 0.05, 0.3  # expected relative errors of the given lights
# neighbouring residuals are correlated: so many weigh as much as one against a prior
_CORRELATED = 300.0
_RIDGE = 0.02  # share of a pixel's weights, pulls its b to zero
# of a pixel's features, and residual with half of the weight, see _Fit
_SMALLEST_ENERGY, _CUT = (
    1e-3,
    2.0,
)
_DARK, _SHADOW_WEIGHT = 0.1, 0.05
_STEPS, _TRIALS = 15, 4
_SAME_PLACE = 1.0  # pixels between images at one place
_SIMPLER = 1.06  # a model with more parameters must reduce the residuals by this factor


@dataclass(frozen=True, eq=False)
class Alignment:
    """How images moved relative to one of them, in pixels: x is the column, y the row.

    reference: the first image, or the first one at the place of the majority if there is such a
    place. transforms: (F, 3, 3), from its pixel (x, y, 1) to the same point in each image.
    moved_pixels: (F,), the root mean square motion over the object.
    fits: (F,), the correlation of the aligned image with its prediction from the others.
    """

    model: Model
    transforms: Float64Array
    moved_pixels: Float64Array
    fits: Float64Array
    largest: float  # motion of a pixel of the object, as a share of its longer side
    reference: int = 0

    @property
    def unexplained(self) -> int | None:
        """The index of an image that matches the others nowhere, or None."""
        worst = int(self.fits.argmin())
        if self.fits[worst] < self.least_fit:
            return worst
        return int(self.moved_pixels.argmax()) if self.largest > LARGEST_MOTION else None

    @property
    def least_fit(self) -> float:
        """The expected correlation of each image."""
        usual = float(np.median(self.fits))
        return LEAST_FIT if usual < LEAST_FIT else min(CLEAR_FIT, 1 - MOST_UNLIKE * (1 - usual))


def align_images(images: Float32Array, mask: Bools, lights: Float64Array | None) -> Alignment:
    """Return how images (F, H, W) of an object in the mask (H, W) moved.

    Args:
        lights: (F, 3), towards the lights, or None if they are unknown.
    """
    pyramid = list(_pyramid(images, mask))
    unmoved = np.repeat(np.eye(3)[None], len(images), 0)
    start = _State(unmoved.copy(), _first_lights(*pyramid[-1], lights))
    number = next(
        (n for n, (_, each) in enumerate(pyramid) if max(each.shape) <= _SIDE_OF_FIRST),
        len(pyramid) - 1,
    )
    if are_still(images, mask, start.lights):
        return _described("translation", unmoved, mask, np.ones(len(images)))
    start.transforms[:, :2, 2] = 2.0**number * _first_shifts(*pyramid[number], start.lights)
    prior = 0.1 if lights is not None else 1e-3
    # The model is chosen on a level of half the resolution, where all of them are quick.
    first = min(1, len(pyramid) - 1)
    found = {model: _solve(pyramid, first, start, PARAMETERS[model], prior) for model in PARAMETERS}
    scale = found["homography"][0].scale
    costs = {
        model: level.cost(level.data, level.lights, scale) for model, (level, _) in found.items()
    }
    still, _ = _solve(pyramid, first, _State(unmoved, start.lights), 0, prior)
    least = min(costs["translation"], costs["similarity"])
    if still.cost(still.data, still.lights, scale) <= _SIMPLER * least:
        return _described("translation", unmoved, mask, still.correlations())
    model: Model = "translation"
    for richer in ("similarity", "homography"):
        if costs[model] > _SIMPLER * costs[richer]:
            model = richer
    level, state = found[model]
    if first:
        level, state = _solve(pyramid[:1], 0, state, PARAMETERS[model], prior)
    return _described(model, state.transforms, mask, level.correlations())


def _described(
    model: Model, transforms: Float64Array, mask: Bools, fits: Float64Array
) -> Alignment:
    rows, columns = np.nonzero(mask)
    places = np.stack((columns, rows, np.ones_like(rows))).astype(np.float64)
    moved, largest = [], 0.0
    middle = transforms @ places.mean(axis=1)
    middle /= middle[:, 2:]
    usual = np.linalg.norm(middle - np.median(middle, axis=0), axis=1) < _SAME_PLACE
    reference = int(usual.argmax()) if usual.mean() > 0.5 else 0
    transforms = transforms @ np.linalg.inv(transforms[reference])
    for transform in transforms:
        there = transform @ places
        distance = np.hypot(*(there[:2] / there[2] - places[:2]))
        moved.append(float(np.sqrt((distance**2).mean())))
        largest = max(largest, float(distance.max()))
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    if max(moved) < UNMOVED:
        transforms = np.repeat(np.eye(3)[None], len(transforms), 0)
    return Alignment(model, transforms, np.array(moved), fits, largest / side, reference)


def common_pixels(transforms: Float64Array, shape: Sequence[int]) -> Bools:
    """Return which pixels (H, W) of the reference are inside all images of this shape (H, W)."""
    height, width = shape
    common = np.ones((height, width), np.bool_)
    for rows in slices(height, _ROWS):
        for transform in transforms:
            x, y, w = _points(transform, rows, (height, width))
            inside = (x >= 0) & (x <= (width - 1) * w) & (y >= 0) & (y <= (height - 1) * w)
            common[rows] &= inside & (w > 0)
    return common


def _points(transform: Float64Array, rows: slice, shape: tuple[int, int]) -> list[Float64Array]:
    """Return the places of the pixels of some rows in another image, as homogeneous x, y and w."""
    y, x = np.arange(*rows.indices(shape[0]))[:, None], np.arange(shape[1])
    return [row[0] * x + row[1] * y + row[2] for row in transform]


def resample(
    stored: Array, linear: Float32Array, transform: Float64Array
) -> tuple[Array, Float32Array]:
    """Return an image (H, W, C) in the frame of the reference: as stored, from the nearest pixel,
    and interpolated.

    Stored values decide which observations are saturated, so they are not mixed.
    """
    import cv2

    size = stored.shape[1::-1]
    height, width = stored.shape[:2]
    if np.array_equal(transform, np.eye(3)):
        return stored, linear
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LANCZOS4
    moved = cv2.warpPerspective(
        linear, transform, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    nearest = np.empty_like(stored)
    for rows in slices(height, _ROWS):
        x, y, w = _points(transform, rows, (height, width))
        places = (np.rint(axis / w).astype(np.intp) for axis in (y, x))
        row, column = (
            each.clip(0, side - 1) for each, side in zip(places, (height, width), strict=True)
        )
        nearest[rows] = stored[row, column]
    return nearest, np.maximum(moved, 0, out=moved).reshape(linear.shape)


@dataclass(frozen=True, eq=False)
class AlignedImages:
    """How the images of a capture were aligned, in pixels of whole images."""

    reference: str  # the image in whose frame everything is
    model: Model
    # (F, 3, 3) of all images, from the reference to each image; see Alignment
    transforms: Float64Array
    moved_pixels: Float64Array  # (f,) of the images that are used
    common: Bools  # (H, W) of the part that is read: the pixels that all images show

    def as_dict(self, indices: Sequence[int]) -> dict[str, Any]:
        """Return the entry of the report for the images that are used."""
        return {
            "reference": self.reference,
            "model": self.model,
            "transforms": self.transforms[list(indices)].round(9).tolist(),
            "moved_pixels": self.moved_pixels.round(3).tolist(),
        }


def stride_for(n_values: int) -> int:
    """Return the factor by which images with this total number of pixels are reduced."""
    return max(1, int(np.ceil(np.sqrt(n_values / MOST_VALUES))))


def reduced(image: Float32Array, stride: int) -> Float32Array:
    """Return an image (H, W) with the means of squares of stride x stride pixels; the remainder at
    the borders is cropped.
    """
    height, width = (side // stride for side in image.shape)
    squares = image[: height * stride, : width * stride].reshape(height, stride, width, stride)
    return np.asarray(squares.mean(axis=(1, 3)), np.float32)


def place_in_whole(transforms: Float64Array, left: int, top: int, stride: int) -> Float64Array:
    """Return transforms (F, 3, 3) of reduced windows as transforms of whole images."""
    middle = (stride - 1) / 2
    to_whole = np.array(
        [[stride, 0, left + middle], [0, stride, top + middle], [0, 0, 1]], np.float64
    )
    moved = to_whole @ transforms @ np.linalg.inv(to_whole)
    return np.asarray(moved / moved[:, 2:, 2:])


class _State(NamedTuple):
    transforms: Float64Array  # (F, 3, 3)
    lights: Float64Array  # (F, 3), times their intensities


def _pyramid(images: Float32Array, mask: Bools) -> Iterator[tuple[Float32Array, Bools]]:
    import cv2

    images = images / max(float(np.quantile(images[:, mask].max(axis=0), 0.99)), 1e-12)
    while True:
        yield images, mask
        if min(int(np.ptp(places)) + 1 for places in np.nonzero(mask)) <= 2 * _SMALLEST_SIDE:
            return
        images = np.stack([cv2.pyrDown(image) for image in images])
        mask = cv2.pyrDown(mask.astype(np.float32)) > 0.5


def _first_lights(images: Float32Array, mask: Bools, lights: Float64Array | None) -> Float64Array:
    """Return the lights with intensities that fit the unaligned images; without lights, three
    singular vectors.
    """
    values = images[:, mask].astype(np.float64)
    if lights is None:
        left, sizes, _ = np.linalg.svd(values, full_matrices=False)
        return np.asarray(left[:, :3] * sizes[:3] / sizes[0] * np.sqrt(len(images)))
    lights = lights.copy()
    for _ in range(5):
        shading = lights @ np.linalg.lstsq(lights, values, rcond=None)[0]
        factors = (shading * values).sum(axis=1) / np.maximum((shading**2).sum(axis=1), 1e-12)
        lights *= np.clip(factors, 0.2, 5)[:, None]
    return lights


def _first_shifts(images: Float32Array, mask: Bools, lights: Float64Array) -> Float64Array:
    """Return the shifts (F, 2) of images relative to the first, from correlations of images with
    similar lights.
    """
    import cv2

    count = len(images)
    reach = max(2, round(_REACH * min(int(np.ptp(places)) + 1 for places in np.nonzero(mask))))
    area = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1))) > 0
    sizes = []
    for image in images:
        # Sizes of gradients of logarithms: a contour looks alike under similar lights, and paint
        # under all.
        down, right = np.gradient(cv2.GaussianBlur(np.log(image.clip(0) + 0.05), (0, 0), _LOW_PASS))
        size = np.hypot(down, right)
        size = np.minimum(size, np.quantile(size[area], 0.95))
        size = np.where(area, size - cv2.GaussianBlur(size, (0, 0), 4), 0)
        sizes.append(size / max(float(np.linalg.norm(size)), 1e-12))
    features, sums = np.stack(sizes), ShiftedSums(mask, reach)
    directions = lights / np.maximum(np.linalg.norm(lights, axis=1, keepdims=True), 1e-12)
    pairs, shifts, weights = [], [], []
    for one, order in enumerate(np.argsort(-(directions @ directions.T), axis=1)):
        others = order[order != one][:_NEIGHBOURS]
        for other, match in zip(others, sums.of(features[others], features[one]), strict=True):
            row, column = np.unravel_index(int(match.argmax()), match.shape)
            pairs.append((int(other), one))
            shifts.append((int(column) - reach, int(row) - reach))
            weights.append(max(float(match.max()), 1e-3) ** 2)
    first, second = np.array(pairs).T
    between, found, given = np.array(shifts, np.float64), np.zeros((count, 2)), np.array(weights)
    incidence = np.zeros((len(pairs), count))
    incidence[np.arange(len(pairs)), second] = 1
    incidence[np.arange(len(pairs)), first] -= 1
    weight = given
    for _ in range(30):  # least absolute deviations, because some pairs do not match
        normal = incidence[:, 1:].T @ (weight[:, None] * incidence[:, 1:]) + 1e-9 * np.eye(
            count - 1
        )
        found[1:] = np.linalg.solve(normal, incidence[:, 1:].T @ (weight[:, None] * between))
        weight = given / np.maximum(np.linalg.norm(incidence @ found - between, axis=1), 0.5)
    return found


def _solve(
    pyramid: Sequence[tuple[Float32Array, Bools]],
    last: int,
    state: _State,
    parameters: int,
    prior: float,
) -> tuple[_Level, _State]:
    """Return the finest level that was solved, and the state in pixels of the images."""
    for number in reversed(range(last, len(pyramid))):
        images, mask = pyramid[number]
        scale = np.diag((2.0**number, 2.0**number, 1.0))
        level = _Level(
            images,
            mask,
            np.linalg.inv(scale) @ state.transforms @ scale,
            state.lights,
            parameters,
            prior,
        )
        level.minimise()
        state = _State(scale @ level.transforms @ np.linalg.inv(scale), level.lights)
    return level, state


class _Features(NamedTuple):
    """Features of a level, each (F, P): high-pass filtered images, their gradients, brightness, and
    known pixels.
    """

    values: Float32Array
    right: Float32Array
    down: Float32Array
    raw: Float32Array
    known: Float32Array


class _Fit(NamedTuple):
    """The matte model of a state: weights (F, P), a root of b's covariance (3, 3, P), b (3, P),
    residuals (F, P).
    """

    lit: Floats  # the weights before the robust fit
    weights: Floats
    root: Float64Array
    surface: Float64Array
    left: Float64Array
    scale: Float64Array  # (F, P), the residual at which an observation has half of its weight
    cost: float


@dataclass(eq=False)
class _Level:
    """Images (F, H, W) of a pyramid, the object's mask (H, W) in the first one, and the state that
    is improved.
    """

    images: Float32Array
    mask: Bools
    transforms: Float64Array
    lights: Float64Array
    parameters: int
    prior: float  # weight of the given lights
    data: _Features = field(init=False)
    scale: Float64Array = field(init=False)

    def __post_init__(self) -> None:
        import cv2

        # with the outline
        rows, columns = np.nonzero(cv2.dilate(self.mask.astype(np.uint8), np.ones((5, 5))))
        stride = int(np.ceil(len(rows) * len(self.images) / _MOST_OBSERVATIONS))
        self._at = rows[::stride], columns[::stride]
        middle = columns.mean(), rows.mean()
        self._radius = max(1.0, 0.5 * max(np.ptp(columns), np.ptp(rows)))
        self._to_unit = (
            np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, self._radius]]) / self._radius
        )
        x, y = (self._at[1] - middle[0]) / self._radius, (self._at[0] - middle[1]) / self._radius
        one, zero = np.ones_like(x), np.zeros_like(x)
        # The motion of a pixel by each parameter, and the same as matrices.
        self._fields = (
            np.stack((one, zero, -y, x, x, y, x * x, x * y))[: self.parameters].astype(np.float32),
            np.stack((zero, one, x, y, -y, x, x * y, y * y))[: self.parameters].astype(np.float32),
        )
        self._given = self.lights.copy()
        self.data = self._features(self.transforms)

    def minimise(self) -> None:
        """Improve transforms and lights by damped Gauss-Newton steps (Levenberg and Marquardt)."""
        damping = 1.0
        for _ in range(_STEPS):
            fit = self._fit(self.data, self.lights)
            self.scale = fit.scale
            matrix, gradient, unit = self._equations(fit)
            for _ in range(_TRIALS):
                transforms, lights, motion = self._moved(matrix, gradient, unit * damping)
                data = self._features(transforms)
                cost = self.cost(data, lights, fit.scale)
                if cost < fit.cost:
                    break
                damping = max(damping, 1e-3) * 8
            if cost >= fit.cost:
                return
            self.transforms, self.lights, self.data, damping = transforms, lights, data, damping / 4
            if motion < 0.005 or cost > (1 - 1e-3 / len(self.images)) * fit.cost:
                return

    def correlations(self) -> Float64Array:
        """Return the correlation (F,) of each image with its prediction from the others, over the
        lit pixels.
        """
        fit = self._fit(self.data, self.lights)
        values = self.data.values.astype(np.float64)
        leverage = fit.weights * sum((self.lights @ axis) ** 2 for axis in fit.root)
        # the residual without the image itself
        predicted = values - fit.left / np.maximum(1 - leverage, 1e-3)
        sums = (
            (fit.lit * a * b).sum(axis=1)
            for a, b in ((values, predicted), (values, values), (predicted,) * 2)
        )
        products, squares, others = sums
        return np.asarray(products / np.sqrt(squares * others + 1e-30))

    def cost(self, data: _Features, lights: Float64Array, scale: Float64Array) -> float:
        return self._fit(data, lights, scale).cost

    def _features(self, transforms: Float64Array) -> _Features:
        import cv2

        size = self.mask.shape[::-1]
        found: list[list[Float32Array]] = [[] for _ in _Features._fields]
        ones = np.ones(self.mask.shape, np.float32)
        for image, transform in zip(self.images, transforms, strict=True):
            flags = cv2.WARP_INVERSE_MAP
            raw = cv2.warpPerspective(
                image,
                transform,
                size,
                flags=flags | cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
            known = cv2.warpPerspective(ones, transform, size, flags=flags | cv2.INTER_NEAREST)
            values = cv2.GaussianBlur(
                raw - cv2.GaussianBlur(raw, (0, 0), _HIGH_PASS), (0, 0), _LOW_PASS
            )
            down, right = np.gradient(values)
            for column, each in zip(found, (values, right, down, raw, known), strict=True):
                column.append(each[self._at])
        return _Features(*map(np.stack, found))

    def _fit(
        self, data: _Features, lights: Float64Array, scale: Float64Array | None = None
    ) -> _Fit:
        """Fit the matte model robustly, with Cauchy's weights.

        Residuals are weighed relative to the energy of their pixel's features, because most pixels
        have none.
        """
        raw, values = data.raw, data.values
        bright = max(1, len(raw) // 8)  # highlights
        dark = raw < _DARK * np.maximum(np.partition(raw, -bright, axis=0)[-bright], 1e-6)
        weights = data.known * np.where(dark, _SHADOW_WEIGHT, 1.0)
        shadow = dark & (raw - _matte(raw, weights, lights)[2] < 2 * _DARK * raw.max(axis=0))
        lit = weights = data.known * np.where(shadow, _SHADOW_WEIGHT, 1.0)
        for _ in range(3 if scale is None else 0):
            left = _matte(values, weights, lights)[2]
            sums = (weights * values**2).sum(axis=0), np.maximum(weights.sum(axis=0), 1e-6)
            energy = np.sqrt(sums[0] / sums[1]) + _SMALLEST_ENERGY
            # The median of each image: an image that is still far from the others must not look
            # like outliers.
            shares = _medians(np.where(weights > 0.3, np.abs(left) / energy, np.nan))
            found = _CUT * 1.4826 * np.maximum(shares, 1e-6)[:, None] * energy
            weights = lit / (1 + (left / found) ** 2)
        if scale is None:
            scale, weights = found, lit
        for _ in range(3):
            left = _matte(values, weights, lights)[2]
            weights = lit / (1 + (left / scale) ** 2)
        root, surface, left = _matte(values, weights, lights)
        cost = float((lit * np.log1p((left / scale) ** 2) * scale**2).sum() / max(lit.sum(), 1e-6))
        return _Fit(lit, weights, root, surface, left, scale, cost)

    def _equations(self, fit: _Fit) -> tuple[Float64Array, Float64Array, float]:
        """Return the normal equations of all images' parameters and lights, without b, and the
        weight of a prior.
        """
        weights, lights, count = fit.weights, self.lights, len(self.images)
        each = self.parameters + 3
        size = count * each
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        chunk = max(1, 2_000_000 // size)
        for start in range(0, len(self._at[0]), chunk):
            part = slice(start, start + chunk)
            weight = weights[:, None, part].astype(np.float32)
            slopes = np.empty((count, each, weight.shape[2]), np.float32)
            slopes[:, : self.parameters] = self.data.right[:, None, part] * self._fields[0][:, part]
            slopes[:, : self.parameters] += self.data.down[:, None, part] * self._fields[1][:, part]
            slopes[:, self.parameters :] = -fit.surface[:, part]
            gradient += (slopes * weight * fit.left[:, None, part]).sum(axis=2).ravel()
            own = (slopes * weight) @ slopes.transpose(0, 2, 1)
            for place in range(count):
                rows = slice(place * each, place * each + each)
                matrix[rows, rows] += own[place]
            for axis in range(3):
                share = (lights @ fit.root[axis, :, part])[:, None] * weight
                by_surface = (slopes * share.astype(np.float32)).reshape(size, -1)
                matrix -= by_surface @ by_surface.T
        unit = _CORRELATED * float((weights * fit.left**2).sum() / max(weights.sum(), 1e-6))
        for place, given in enumerate(self._given):
            length = max(float(np.linalg.norm(given)), 1e-6)
            along = np.outer(given, given) / length**2
            precision = (np.eye(3) - along) / (_LIGHT_SIGMA * length) ** 2 + along / (
                _BRIGHTNESS_SIGMA * length
            ) ** 2
            rows = slice(place * each + self.parameters, place * each + each)
            matrix[rows, rows] += self.prior * unit * precision
            gradient[rows] += self.prior * unit * precision @ (lights[place] - given)
        return matrix, gradient, unit

    def _moved(
        self, matrix: Float64Array, gradient: Float64Array, damping: float
    ) -> tuple[Float64Array, Float64Array, float]:
        """Return transforms and lights after a step, and the largest motion.
        The first image stays.
        """
        count, each, free = len(self.images), self.parameters + 3, slice(self.parameters, None)
        # Motions relative to their mean are damped: the others together move against the first
        # image as one image does.
        motion = np.kron(np.eye(count) - 1 / count, np.diag(np.arange(each) < self.parameters))
        damped = (
            matrix
            + damping * motion
            + np.eye(len(matrix)) * (1e-9 * np.trace(matrix) / len(matrix) + 1e-12)
        )
        step = np.zeros(len(gradient))
        step[free] = -np.linalg.solve(damped[free, free], gradient[free])
        steps = step.reshape(count, each)
        limit = max(2.0, 0.1 * self._radius)
        moves = steps[:, : self.parameters]
        largest = np.abs(moves).max(axis=1, keepdims=True, initial=1e-12)
        moves = moves * np.minimum(1, limit / largest)
        small = np.eye(3) + np.tensordot(moves / self._radius, _GENERATORS[: self.parameters], 1)
        transforms = self.transforms @ np.linalg.inv(self._to_unit) @ small @ self._to_unit
        return (
            transforms / transforms[:, 2:, 2:],
            self.lights + steps[:, self.parameters :],
            float(np.abs(moves).max(initial=0)),
        )


_GENERATORS = np.array(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [-1, 0, 0]],
        [[0, 0, 0], [0, 0, 0], [0, -1, 0]],
    ],
    np.float64,
)
"""Small motions of points of the plane as matrices: shifts, rotation, scale, two shears, and two of
perspective.
"""


def _medians(shares: Float64Array) -> Float64Array:
    """Return the medians (F,) of shares (F, P) without NaN; an image of NaN alone gets the median
    of all.
    """
    usual = float(np.nanmedian(shares)) if not np.isnan(shares).all() else 1.0
    return np.array([np.nanmedian(row) if not np.isnan(row).all() else usual for row in shares])


def _matte(
    values: Floats, weights: Floats, lights: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return a root (3, 3, P) of the covariance of b, b (3, P), and the residuals (F, P) of values
    (F, P) = l . b.
    """
    x, y, z = lights.T
    xx, yy, zz, *mixed = np.stack((x * x, y * y, z * z, x * y, x * z, y * z)) @ weights
    ridge = _RIDGE * weights.sum(axis=0) / 3 * float((lights**2).sum(axis=1).mean())
    xx, yy, zz, xy, xz, yz = inverse_3x3((xx + ridge, yy + ridge, zz + ridge, *mixed), 1e-9)
    covariance = np.stack((xx, xy, xz, xy, yy, yz, xz, yz, zz), axis=-1).reshape(-1, 3, 3)
    surface = np.einsum("pij,jp->ip", covariance, lights.T @ (weights * values))
    root = np.linalg.cholesky(covariance)  # covariance = root root'
    return root.transpose(2, 1, 0), surface, values - lights @ surface
