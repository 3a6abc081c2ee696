"""Images that are shifted against the others, found by their shading and outline on objects without
fine detail.

A matte model is fitted to the other images under the given lights. Its residual in an image is
compared with its residual after the image is moved. The light of the image is free, so a wrong
direction or intensity is not mistaken for a shift: on a ball, moved shading and a moved lamp differ
only near the outline and by the shadow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.sample import Sample
from splinecli.maths import Bools, Float64Array
from splinecli.maths.robust import fit_robustly, inverse_3x3, multiply_symmetric

# Falls and residuals are shares of the image's brightness.
# the share of the residual that a shift leaves, in the whole image and most halves of it
_LEFT = 0.5
_MANY_IMAGES = 10
# of a pixel's bright value; a factor of the prediction, and an offset
_DARK, _HIGHLIGHT = (
    0.1,
    (1.15, 0.05),
)
_PASSES, _FITS = 2, 5
Complex128Array = NDArray[np.complex128]
Shift = tuple[int, int]  # right, down
_NO_SHIFT = 0.0, (0, 0)
# The residual of a shifted image is so many times the lower quartile of the images' residuals. If
# the model fits no image well, as on polished balls, it does not show which is shifted. Metals
# leave more than the second.
_UNUSUAL, _LARGEST = 2.0, 0.6


def shading_shifts(sample: Sample, light_directions: Float64Array) -> dict[int, Shift]:
    """Return the shifts in pixels of the sample of images that are shifted, by place, under lights
    (F, 3).
    """
    # Rows and columns of larger captures are left out.
    stride = int(np.ceil(np.sqrt(sample.observations.size / 200_000)))
    mask = sample.mask[::stride, ::stride]
    if len(light_directions) < 8 or np.count_nonzero(mask) < 300:
        return {}
    images = np.zeros((len(light_directions), *sample.mask.shape))
    images[:, sample.mask] = sample.observations.T
    images, mask = _cropped(images[:, ::stride, ::stride], mask)
    model = _MatteModel(images, mask, light_directions)
    n_images = len(images)
    halves = (range(n_images // 2), range(0, n_images, 2)) if n_images >= _MANY_IMAGES else ()
    together = []
    for half in halves:
        others = [place for place in range(n_images) if place not in half]
        of_half = _MatteModel(model.images, mask, light_directions, half)
        together.append((*of_half.find_common(others, of_half.usual_residual(half)), others))
    fall, shift, others = max(together, default=(0.0, (0, 0), []))
    # On a photographed ball, half of the images fitted better when moved by a sixth.
    farthest = 0.1 * min(int(np.ptp(places)) + 1 for places in np.nonzero(mask))
    for place in others if fall > 0 and max(map(abs, shift)) <= farthest else ():
        model.move(place, shift)
    usual = model.usual_residual(range(n_images))
    found = [
        (model.find(place, usual)[0], place)
        for place in range(n_images)
        if place not in model.shifts
    ]
    # An image that was moved back improves the model of the others.
    order = [place for fall, place in sorted(found, reverse=True) if fall > 0]
    for place in order * _PASSES:
        fall, shift = model.find(place, usual)
        if fall > 0 and shift != model.shifts.get(place):
            model.move(place, shift)
    return {place: (stride * right, stride * down) for place, (right, down) in model.shifts.items()}


def _cropped(images: Float64Array, mask: Bools) -> tuple[Float64Array, Bools]:
    rows, columns = (slice(places.min(), places.max() + 1) for places in np.nonzero(mask))
    return images[:, rows, columns], mask[rows, columns]


def moved_back(sample: Sample, shifts: Mapping[int, Shift]) -> tuple[Bools, Float64Array]:
    """Return which pixels (P,) all images show, moved back by shifts in pixels of the sample, and
    all values (P, F).
    """
    known, values = (
        np.ones(len(sample.observations), np.bool_),
        sample.observations.astype(np.float64),
    )
    image = np.zeros(sample.mask.shape)
    for place, shift in shifts.items():
        image[sample.mask] = sample.observations[:, place]
        values[:, place] = _moved(image, shift)[sample.mask]
        known &= _moved(sample.mask, shift)[sample.mask] > 0
    return known, values


class _Compared:
    """How a matte model fits an image: unmoved, and at all shifts, in shares of its brightness.

    Args:
        scaled: (3, H, W), scaled normals that were fitted without the image.
        good: (H, W), 1 where they are known; else 0.
        kept: (H, W), 1 in the pixels of the image that count; else 0.
        image: (H, W), zero elsewhere.
    """

    def __init__(
        self,
        scaled: Float64Array,
        good: Float64Array,
        kept: Float64Array,
        image: Float64Array,
        sums: _ShiftedSums,
    ) -> None:
        self.maps, self._sums = (scaled, good, kept, image), sums
        self._brightness = max(float(np.sqrt((image**2).sum() / kept.sum())), 1e-12)
        inside = (good * kept) > 0
        count = np.array(float(np.count_nonzero(inside)))
        seen, own = scaled[:, inside], image[inside]
        products, squares = (seen @ seen.T)[np.triu_indices(3)], own @ own
        self.still = float(_residual(count, products, seen @ own, squares)) / self._brightness
        if count <= 0.5 * min(good.sum(), kept.sum()):  # the overlap may be too small
            self.still = float(self.left[sums.reach, sums.reach])
        self._count = float(count)

    @cached_property
    def _enough(self) -> Bools:
        _, good, kept, _ = self.maps
        overlap = self._sums.of(good, kept)
        return np.asarray(overlap > 0.5 * overlap.max())

    @cached_property
    def _products(self) -> Float64Array:
        scaled = self.maps[0]
        return np.stack([scaled[i] * scaled[j] for i, j in zip(*np.triu_indices(3), strict=True)])

    @cached_property
    def left(self) -> Float64Array:
        """The residuals (h, w) of the image at all shifts; infinite where too little overlaps."""
        scaled, good, kept, image = self.maps
        mask_sums = self._sums.of(np.concatenate((good[None], self._products)), kept)
        sums = self._sums.of(scaled, image), self._sums.of(good, image**2)
        return self._shares(mask_sums, *sums)

    @cached_property
    def unmoved(self) -> Float64Array:
        """The residuals (h, w) without a shift, in the pixels that the moved image covers."""
        scaled, good, kept, image = self.maps
        terms = good[None], self._products, scaled * image, (good * image**2)[None]
        found = self._sums.of_mask(np.concatenate((kept * terms[0], kept * terms[1], *terms[2:])))
        return self._shares(found[:7], found[7:10], found[10])

    def _shares(
        self, of_normals: Float64Array, of_image: Float64Array, squares: Float64Array
    ) -> Float64Array:
        found = _residual(of_normals[0], of_normals[1:], of_image, squares)
        return np.where(self._enough, found / self._brightness, np.inf)

    def may_leave(self, most_left: float) -> Bools:
        """Return which shifts (h, w) may leave at most this share of the residual."""
        return np.asarray(self.left <= most_left * (1 + 1e-6) * self.most_unmoved)  # for rounding

    @cached_property
    def most_unmoved(self) -> Float64Array:
        """What `unmoved` does not exceed: fewer pixels have at most the same sum of squares."""
        _, good, kept, _ = self.maps
        count = np.maximum(self._sums.of_mask((good * kept)[None])[0], 1)
        return np.asarray(self.still * np.sqrt(self._count / count))


class _ShiftedSums:
    """Sums over the pixels x of first(x) second(x + shift), at all shifts (down, right) within
    reach, by Fourier transforms.
    """

    def __init__(self, mask: Bools, reach: int) -> None:
        from scipy.fft import next_fast_len

        self.reach = reach
        self._shape = [next_fast_len(side + reach, real=True) for side in mask.shape]
        self._around = np.arange(-reach, reach + 1)
        self._mask = self._transformed(mask.astype(np.float64))

    def of(self, first: Float64Array, second: Float64Array) -> Float64Array:
        """Return the sums (..., h, w) of maps (..., H, W) and one map (H, W)."""
        return self._sums(first, self._transformed(second))

    def of_mask(self, first: Float64Array) -> Float64Array:
        """Return the sums (..., h, w) of maps (..., H, W) and the mask."""
        return self._sums(first, self._mask)

    def _sums(self, first: Float64Array, second: Complex128Array) -> Float64Array:
        from scipy.fft import ifft, irfft

        rows = ifft(np.conj(self._transformed(first)) * second, axis=-2, overwrite_x=True)
        near = irfft(rows[..., self._around, :], self._shape[1], axis=-1)
        return np.asarray(near[..., self._around])

    def _transformed(self, maps: Float64Array) -> Complex128Array:
        from scipy.fft import fft, rfft

        return np.asarray(fft(rfft(maps, self._shape[1]), self._shape[0], axis=-2))


class _MatteModel:
    """Scaled normals of images (F, H, W), of which some were moved back by their shifts."""

    def __init__(
        self,
        images: Float64Array,
        mask: Bools,
        light_directions: Float64Array,
        fitted: Sequence[int] | None = None,
    ) -> None:
        self.images, self.mask, self.lights = images, mask, light_directions
        self.shifts: dict[int, Shift] = {}
        self._found: dict[int, _Compared | None] = {}  # of this fit
        # Shifts are compared up to this share of the smaller side of the object. Wrong models often
        # keep improving towards larger shifts.
        reach = max(2, round(0.2 * min(int(np.ptp(places)) + 1 for places in np.nonzero(mask))))
        self._sums = _ShiftedSums(mask, int(0.75 * reach))
        self._values = images[:, mask].T.copy()
        self._known = np.zeros(self._values.shape, np.bool_)
        self._known[:, slice(None) if fitted is None else list(fitted)] = True
        self._fit()

    def move(self, place: int, shift: Shift) -> None:
        """Move an image back by a shift from where it was photographed, and fit again."""
        self.shifts[place] = shift
        self._values[:, place] = _moved(self.images[place], shift)[self.mask]
        self._known[:, place] = _moved(self.mask, shift)[self.mask]
        self._fit()

    def _fit(self) -> None:
        self._found.clear()
        known = self._values * self._known
        # highlights: the brightest eighth of the images
        bright = int(self._known.any(axis=0).sum()) // 8
        self._top = np.maximum(np.partition(known, -1 - bright, axis=1)[:, -1 - bright], 1e-12)
        values = self._values / self._top[:, None]
        lit = np.where(values > _DARK, 1.0, 1e-3) * np.where(self._known, 1.0, 1e-4)
        self._normals, self._weights = fit_robustly(values, lit, self.lights, _FITS)
        self._left = values - self._normals @ self.lights.T
        x, y, z = self.lights.T
        products = self._weights @ np.stack((x * x, y * y, z * z, x * y, x * z, y * z), axis=1)
        self._covariance = inverse_3x3(
            tuple(products.T + np.array([[1e-6]] * 3 + [[0.0]] * 3)), 1e-6
        )

    def _without(self, place: int) -> Float64Array:
        """Return the scaled normals (P, 3) without an image (Sherman and Morrison); zero where they
        are implausible.
        """
        light, weights = self.lights[place], self._weights[:, place]
        turn = np.stack(multiply_symmetric(self._covariance, tuple(light)), axis=1)
        amount = weights * self._left[:, place] / np.maximum(1 - weights * (turn @ light), 0.05)
        normals = self._normals - turn * amount[:, None]
        # Where a bright value is 1, longer scaled normals are extrapolated from few lit images.
        return np.where(np.linalg.norm(normals, axis=1, keepdims=True) < 4.0, normals, 0.0)

    def _compared(self, place: int) -> _Compared | None:
        if place not in self._found:
            self._found[place] = self._compare(place)
        return self._found[place]

    def _compare(self, place: int) -> _Compared | None:
        """Return how the model fits an image at all shifts; None if it does not apply to this
        image.

        Shadows and highlights of the image are left out, but not pixels that are dark although the
        model predicts light.
        """
        normals, image = self._without(place), self.images[place][self.mask]
        predicted, values = np.maximum(normals @ self.lights[place], 0), image / self._top
        shadow = (values < _DARK) & (predicted < 2 * _DARK)
        kept = ~shadow & (values <= _HIGHLIGHT[0] * predicted + _HIGHLIGHT[1])
        if kept.mean() < 0.3:
            return None
        good, scaled = (
            self._map(np.asarray(normals.any(axis=1))),
            self._map(normals * self._top[:, None]),
        )
        return _Compared(scaled, good, self._map(kept), self._map(image * kept), self._sums)

    def usual_residual(self, places: Sequence[int]) -> float:
        """Return the lower quartile of the residuals of some images in their current positions."""
        found = [compared for compared in map(self._compared, places) if compared is not None]
        still = [compared.still for compared in found]
        return float(np.quantile(still, 0.25)) if still else np.inf

    def find(self, place: int, usual: float) -> tuple[float, Shift]:
        """Return the shift with the smallest residual, and the reduction;
        0 if it is not accepted.
        """
        compared = self._compared(place)
        if compared is None:
            return _NO_SHIFT
        # Gloss on a rendered sphere under eight lights reached 0.4.
        most_left = _LEFT if len(self.images) >= _MANY_IMAGES else 0.35
        if not (
            _may_be_moved(compared.most_unmoved, 0.03, usual)
            and compared.may_leave(most_left).any()
        ):
            return _NO_SHIFT
        fall, shift = _least(compared.left, compared.unmoved, 0.03, most_left, usual)
        return (
            (fall, shift)
            if fall and self._left_in_halves(*compared.maps, shift) <= _LEFT
            else _NO_SHIFT
        )

    def find_common(self, places: Sequence[int], usual: float) -> tuple[float, Shift]:
        """Return the same for images that may all have the same shift."""
        found = [compared for compared in map(self._compared, places) if compared is not None]
        if len(found) < len(places) / 2:
            return _NO_SHIFT
        most = np.median([each.most_unmoved for each in found], axis=0)
        if not _may_be_moved(most, 0.02, usual):
            return _NO_SHIFT
        most_left, fitting = 0.6, np.full(most.shape, len(found))
        for each in found:  # until no shift can fit half of the images
            fitting -= ~each.may_leave(most_left)
            if fitting.max() < len(found) / 2:
                return _NO_SHIFT
        with np.errstate(
            invalid="ignore", divide="ignore"
        ):  # medians, so that one shifted image does not decide
            shares = np.median([each.left / each.unmoved for each in found], axis=0)
        unmoved = np.median([each.unmoved for each in found], axis=0)
        known = np.isfinite(shares) & np.isfinite(unmoved)
        return _least(np.where(known, shares * unmoved, np.inf), unmoved, 0.02, most_left, usual)

    def _left_in_halves(
        self,
        scaled: Float64Array,
        good: Float64Array,
        kept: Float64Array,
        image: Float64Array,
        shift: Shift,
    ) -> float:
        """Return the median share that a shift leaves in the upper, lower, left and right half.

        Gloss looks shifted on the side of the highlight alone.
        """

        def residuals(image: Float64Array, kept: Float64Array) -> Float64Array:
            inside = (kept * good) > 0
            light = np.linalg.lstsq(scaled[:, inside].T, image[inside], rcond=None)[0]
            return np.where(inside, np.abs(image - np.tensordot(light, scaled, 1)), np.nan)

        after = residuals(_moved(image, shift), _moved(kept, shift))
        before = residuals(image, kept * _moved(self.mask, shift))
        largest = 3 * np.nanmean(before)
        shares = []
        for places, middle in zip(
            np.indices(image.shape), map(np.median, np.nonzero(self.mask)), strict=True
        ):
            for half in (places <= middle, places > middle):
                found = [each[half & ~np.isnan(each)].clip(max=largest) for each in (after, before)]
                if all(map(len, found)):
                    shares.append(found[0].mean() / max(found[1].mean(), 1e-12))
        return float(np.median(shares)) if shares else np.inf

    def _map(self, values: Float64Array | Bools) -> Float64Array:
        """Return values (P,) or (P, K) on a map (H, W) or (K, H, W), zero outside the mask."""
        array = np.zeros((*values.shape[1:], *self.mask.shape))
        array[..., self.mask] = values.T
        return array


def _may_be_moved(most_unmoved: Float64Array, least_fall: float, usual: float) -> bool:
    """Return whether _least may accept a shift, from bounds (h, w) of the unmoved residuals.

    This saves most of the Fourier transforms of a still capture.
    """
    most = most_unmoved.max() * (1 + 1e-6)  # for rounding
    return bool(most >= max(least_fall, _UNUSUAL * usual) and _UNUSUAL * usual <= _LARGEST)


def _least(
    left: Float64Array, unmoved: Float64Array, least_fall: float, most_left: float, usual: float
) -> tuple[float, Shift]:
    """Return the fall of the residual at the shift with the smallest remaining share; residuals are
    (h, w).
    """
    reach = len(left) // 2
    with np.errstate(invalid="ignore"):
        counts = (
            (unmoved - left >= least_fall) & (unmoved <= _LARGEST) & (unmoved >= _UNUSUAL * usual)
        )
    shares = np.full(left.shape, np.inf)
    shares[counts] = left[counts] / unmoved[counts]
    row, column = np.unravel_index(int(shares.argmin()), shares.shape)
    if shares[row, column] > most_left or row == column == reach:
        return _NO_SHIFT
    return float(unmoved[row, column] - left[row, column]), (int(column) - reach, int(row) - reach)


def _residual(
    count: Float64Array, products: Float64Array, sums: Float64Array, squares: Float64Array
) -> Float64Array:
    """Return root mean square residuals at each shift (h, w) of a fit with the best light.

    From the sums over pixels of scaled normals times each other (6, h, w), and of images times
    these (3, h, w).
    """
    matrices = np.moveaxis(products[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]], (0, 1), (-2, -1))
    trace = np.trace(matrices, axis1=-2, axis2=-1)
    matrices = matrices + (1e-6 * trace + 1e-12)[..., None, None] * np.eye(3)
    sides = np.moveaxis(sums, 0, -1)
    explained = (sides * np.linalg.solve(matrices, sides[..., None])[..., 0]).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(squares - explained, 0) / np.maximum(count, 1)))


def _moved(image: Float64Array | Bools, shift: Shift) -> Float64Array:
    """Return image(x + shift) on the same map; zero where x + shift is outside."""
    moved = np.zeros(image.shape)
    places = list(zip(shift[::-1], image.shape, strict=True))
    to, source = (
        tuple(slice(max(0, by * sign), min(side, side + by * sign)) for by, side in places)
        for sign in (-1, 1)
    )
    moved[to] = image[source]
    return moved
