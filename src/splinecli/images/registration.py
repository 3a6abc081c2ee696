"""Find images that are shifted relative to the others.

Under a fixed camera, the other images predict each image of a matte object under its own light, up
to highlights and shadows. The prediction is compared with the image at all shifts in two ways. Fine
detail gives the shift of most objects exactly, and is not misled by gloss. Objects without detail
are found by their shading and outline: the residual of the shifted image is computed with the light
free, so a wrong light is not mistaken for a shift. On a ball, moved shading and a moved lamp differ
only near the outline and by the shadow.

A shift is real if the image fits much better with it, in all parts of the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Bools, Float32Array, Float64Array, Floats
from splinecli.maths.robust import fit_robustly, inverse_3x3, multiply_symmetric

Complex128Array = NDArray[np.complex128]
Shift = tuple[int, int]  # right, down

_MANY_IMAGES = 10  # fewer predict polished metals so badly that unmoved images are found
_FEWEST = 8
_DETAIL_PIXELS, _SHADING_PIXELS = 1000, 300  # fewer are not judged
_DETAIL_REACH = 8  # the largest shift of detail, in pixels
# By how much a shift must increase the correlation of detail, and to how much. In unmoved captures,
# the predicted detail of all images was in its place, apart from polished metals.
_LEAST_GAIN, _LEAST_PEAK = 0.1, 0.15
# Images are still if correlations farther than two pixels from the peak are lower by so much, and
# the peak of each is so near its place, as all are in root mean square. In unmoved captures, real
# and rendered, single images reached 0.3 pixels.
_CLEAR, _MOST_STILL, _USUAL_STILL = 0.15, 0.5, 0.2
_MOST_VALUES = 2_000_000
_SHORTEST = 0.8  # pixels; a tripod sinks by half a pixel
# The share of the residual that a shift leaves, in the whole image and most halves of it. Gloss on
# a rendered sphere under eight lights reached 0.4.
_LEFT, _LEFT_OF_FEW, _LEFT_OF_HALF = 0.5, 0.35, 0.6
_LEAST_FALL, _LEAST_COMMON_FALL = 0.03, 0.02  # of a residual, as a share of the brightness
# The residual of a shifted image is so many times the lower quartile of the images' residuals. If
# the model fits no image well, as on polished balls, it does not show which is shifted. Metals
# leave more than the second.
_UNUSUAL, _LARGEST = 2.0, 0.6
_DARK = 0.1  # of a pixel's bright value
_HIGHLIGHT = 1.15, 0.05  # a factor of the prediction, and an offset
_PASSES, _FITS = 2, 5
_NO_SHIFT = 0.0, (0, 0)


def shifts_of_detail(images: Float64Array, mask: Bools, lights: Float64Array) -> dict[int, Shift]:
    """Return the shifts (right, down) of images whose fine detail is elsewhere than in the others.

    See shifts_of_shading for the arguments.
    """
    import cv2

    # 1 at pixels that stay in the mask under every shift, 0 elsewhere
    around = np.ones((2 * _DETAIL_REACH + 1,) * 2, np.uint8)
    border: Any = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}
    inner = np.asarray(cv2.erode(mask.astype(np.float32), around, **border), np.float32)
    if len(images) < _MANY_IMAGES or np.count_nonzero(inner) < _DETAIL_PIXELS:
        return {}
    model, detail = _MatteModel(images, mask, lights), _Detail(mask)

    def shifts() -> dict[int, Shift]:
        shift_of = {
            place: _shift_of_detail(
                detail.of(image[mask]), detail.of(model.predicted(place)), inner
            )
            for place, image in enumerate(images)
        }
        return {place: shift for place, shift in shift_of.items() if shift is not None}

    found = shifts()
    # A shifted image also disturbs the prediction of others. Five others or more predict an image;
    # then those that are shifted improve the prediction, once they are moved back.
    for places in (set(found), set()) if 0 < len(found) <= len(images) - 5 else ():
        model.fit(
            {} if places else found, [each for each in range(len(images)) if each not in places]
        )
        found = shifts()
    return found


def are_still(images: Floats, mask: Bools, lights: Float64Array) -> bool:
    """Return whether the detail of every image (H, W) is where the others predict it, beyond doubt.

    See shifts_of_shading for the arguments; pixels beside the mask are used, too. Of large
    captures, four parts in full resolution are compared, so that rotations show as well.
    """
    half = int(np.sqrt(_MOST_VALUES / len(images))) // 2
    fits = max(mask.shape) <= 2 * half
    shares, half = ((50,), half) if fits else ((25, 75), half // 2)
    rows, columns = (np.percentile(places, shares).astype(int) for places in np.nonzero(mask))
    for row, column in product(rows, columns):
        part = slice(max(0, row - half), row + half), slice(max(0, column - half), column + half)
        if not _is_still(np.asarray(images[:, *part], np.float64), mask[part], lights):
            return False
    return True


def _is_still(images: Float64Array, mask: Bools, lights: Float64Array) -> bool:
    import cv2

    if min(mask.shape) <= 2 * _DETAIL_REACH or np.count_nonzero(mask) < _DETAIL_PIXELS:
        return False
    around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * _DETAIL_REACH + 1,) * 2)) > 0
    model, detail = _MatteModel(images, around, lights), _Detail(around)
    middle = slice(_DETAIL_REACH - 2, _DETAIL_REACH + 3)
    distances = []
    for place, image in enumerate(images):
        expected = detail.of(model.predicted(place))
        found, _, exact = _search(detail.of(image[around]), expected, mask.astype(np.float32))
        top = found.max()
        found[middle, middle] = -1
        if top - found.max() < _CLEAR:
            return False
        distances.append(np.hypot(*exact))
    return max(distances) < _MOST_STILL and float(np.mean(np.square(distances))) < _USUAL_STILL**2


def moved(image: Float64Array | Bools, shift: Shift) -> Float64Array:
    """Return image(x + shift) on the same map (H, W); zero where x + shift is outside."""
    found = np.zeros(image.shape)
    places = list(zip(shift[::-1], image.shape, strict=True))
    to, source = (
        tuple(slice(max(0, by * sign), min(side, side + by * sign)) for by, side in places)
        for sign in (-1, 1)
    )
    found[to] = image[source]
    return found


def _shift_of_detail(
    detail: Float32Array, expected: Float32Array, inner: Float32Array
) -> Shift | None:
    """Return the shift at which the detail of an image agrees with what is expected, or None."""
    weighted = inner * detail
    energy = (weighted * detail).sum() * (inner * expected * expected).sum()
    # correlations are at most 1
    if (weighted * expected).sum() > (1.001 - _LEAST_GAIN) * np.sqrt(energy):
        return None
    correlations, (right, down), exact = _search(detail, expected, inner)
    top = correlations.max()
    at_edge = max(abs(right), abs(down)) == _DETAIL_REACH  # the peak may be beyond
    gain = top - correlations[_DETAIL_REACH, _DETAIL_REACH]
    if at_edge or top < _LEAST_PEAK or gain < _LEAST_GAIN or np.hypot(*exact) < _SHORTEST:
        return None
    # A moved camera shifts the whole picture. The highlights of a polished relief move in different
    # directions.
    for half in _halves(inner > 0):
        _, of_half, _ = _search(detail, expected, inner * half)
        if max(abs(of_half[0] - right), abs(of_half[1] - down)) > 1:
            return None
    return right, down


def _halves(mask: Bools) -> list[Bools]:
    """Return the upper, lower, left and right half (H, W) of a mask."""
    found = []
    for places, middle in zip(
        np.indices(mask.shape), map(np.median, np.nonzero(mask)), strict=True
    ):
        found += [np.asarray(places <= middle), np.asarray(places > middle)]
    return found


def _search(
    detail: Float32Array, expected: Float32Array, inner: Float32Array
) -> tuple[Float32Array, Shift, tuple[float, float]]:
    """Return the correlations of two images (H, W) at shifts down and right up to _DETAIL_REACH,
    and where they are largest: in whole pixels, and between these.
    """
    import cv2

    most = slice(_DETAIL_REACH, -_DETAIL_REACH)
    template, weights = (np.ascontiguousarray(part[most, most]) for part in (expected, inner))
    matched = cv2.matchTemplate(detail, template, cv2.TM_CCORR_NORMED, mask=weights)
    found = np.nan_to_num(np.asarray(matched, np.float32), posinf=0, neginf=0)
    row, column = map(int, np.unravel_index(found.argmax(), found.shape))
    right, down = column - _DETAIL_REACH, row - _DETAIL_REACH
    around = np.pad(found, 1, mode="edge")[row : row + 3, column : column + 3]
    return found, (right, down), (right + _top(*around[1]), down + _top(*around[:, 1]))


def _top(before: float, middle: float, after: float) -> float:
    """Return the position of the peak of the parabola through three values, relative to the middle,
    largest one.
    """
    return float(after - before) / 2 / max(float(2 * middle - before - after), 1e-9)


class _Detail:
    """The fine detail of images over their local contrast, in a mask (H, W)."""

    def __init__(self, mask: Bools) -> None:
        self._mask, self._inside = mask, mask.astype(np.float32)
        # Standard deviations of the blur that is not detail, and of the local contrast
        self._weights = {
            deviation: np.maximum(self._blur(self._inside, deviation), 1e-3)
            for deviation in (1.5, 4.0)
        }

    def of(self, values: Float64Array) -> Float32Array:
        """Return the detail of values (P,) on a map (H, W), zero outside the mask."""
        image = np.zeros(self._mask.shape, np.float32)
        image[self._mask] = np.sqrt(np.maximum(values, 0))
        detail = (image - self._blur(image, 1.5) / self._weights[1.5]) * self._inside
        contrast = self._blur(np.abs(detail), 4.0) / self._weights[4.0]
        # Detail fades out below this share of the mean contrast.
        least = 0.05 * np.abs(detail[self._mask]).mean() + np.float32(1e-12)
        # limits the weight of highlights
        return np.asarray((detail / (contrast + least)).clip(-4.0, 4.0), np.float32)

    def _blur(self, array: Float32Array, deviation: float) -> Float32Array:
        import cv2

        return np.asarray(cv2.GaussianBlur(array, (0, 0), deviation))


def shifts_of_shading(images: Float64Array, mask: Bools, lights: Float64Array) -> dict[int, Shift]:
    """Return the shifts (right, down) in pixels of the images that are shifted, by place.

    Args:
        images: (F, H, W), of which the pixels in the mask (H, W) are used.
        lights: (F, 3), a basis of what the images of a matte surface can be: the directions times
            intensities, or three factors of the images.
    """
    # Shading varies slowly, so rows and columns of larger captures are left out.
    stride = int(np.ceil(np.sqrt(len(images) * np.count_nonzero(mask) / 200_000)))
    images, mask = images[:, ::stride, ::stride], mask[::stride, ::stride]
    if len(images) < _FEWEST or np.count_nonzero(mask) < _SHADING_PIXELS:
        return {}
    rows, columns = (slice(places.min(), places.max() + 1) for places in np.nonzero(mask))
    images, mask = images[:, rows, columns], mask[rows, columns]
    model, every = _MatteModel(images, mask, lights), range(len(images))
    halves = (every[: len(images) // 2], every[::2]) if len(images) >= _MANY_IMAGES else ()
    together = []
    for half in halves:
        others = [place for place in every if place not in half]
        of_half = _MatteModel(images, mask, lights, half)
        together.append((*of_half.find_common(others, of_half.usual_residual(half)), others))
    fall, shift, others = max(together, default=(0.0, (0, 0), []))
    # On a photographed ball, half of the images fitted better when moved by a sixth.
    farthest = 0.1 * min(int(np.ptp(places)) + 1 for places in np.nonzero(mask))
    if fall > 0 and max(map(abs, shift)) <= farthest:
        model.fit(dict.fromkeys(others, shift), every)
    usual = model.usual_residual(every)
    found = [(model.find(place, usual)[0], place) for place in every if place not in model.shifts]
    # An image that was moved back improves the model of the others.
    order = [place for fall, place in sorted(found, reverse=True) if fall > 0]
    for place in order * _PASSES:
        fall, shift = model.find(place, usual)
        if fall > 0 and shift != model.shifts.get(place):
            model.fit({**model.shifts, place: shift}, every)
    return {place: (stride * right, stride * down) for place, (right, down) in model.shifts.items()}


class _MatteModel:
    """Scaled normals of images (F, H, W), of which some were moved back by their shifts."""

    def __init__(
        self,
        images: Floats,
        mask: Bools,
        lights: Float64Array,
        fitted: Sequence[int] | None = None,
    ) -> None:
        self.images, self.mask = images, mask
        # any basis of the lights gives the same images
        self.lights = np.linalg.qr(lights)[0] * np.sqrt(len(lights))
        # Shifts are compared up to this share of the smaller side of the object. Wrong models often
        # keep improving towards larger shifts.
        reach = max(2, round(0.2 * min(int(np.ptp(places)) + 1 for places in np.nonzero(mask))))
        self._sums = ShiftedSums(mask, int(0.75 * reach))
        self.fit({}, range(len(images)) if fitted is None else fitted)

    def fit(self, shifts: Mapping[int, Shift], fitted: Sequence[int]) -> None:
        """Fit some of the images, of which those with shifts are moved back by them."""
        self.shifts, self._found = dict(shifts), dict[int, _Compared | None]()
        values = self.images[:, self.mask].T.copy()
        known = np.zeros(values.shape, np.bool_)
        known[:, list(fitted)] = True
        for place, shift in shifts.items():
            values[:, place] = moved(self.images[place], shift)[self.mask]
            known[:, place] = moved(self.mask, shift)[self.mask]
        # highlights: the brightest eighth of the images
        bright = -1 - int(known.any(axis=0).sum()) // 8
        top = np.partition(values * known, bright, axis=1)[:, bright]
        self.top = np.maximum(top, 1e-12)
        values = values / self.top[:, None]
        lit = np.where(values > _DARK, 1.0, 1e-3) * np.where(known, 1.0, 1e-4)
        self._normals, self._weights = fit_robustly(values, lit, self.lights, _FITS)
        self._left = values - self._normals @ self.lights.T
        x, y, z = self.lights.T
        products = self._weights @ np.stack((x * x, y * y, z * z, x * y, x * z, y * z), axis=1)
        self._covariance = inverse_3x3(
            tuple(products.T + np.array([[1e-6]] * 3 + [[0.0]] * 3)), 1e-6
        )

    def without(self, place: int) -> Float64Array:
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
        """Return how the model fits an image at all shifts; None if it does not apply to this
        image.

        Shadows and highlights of the image are left out, but not pixels that are dark although the
        model predicts light.
        """
        if place not in self._found:
            normals, image = self.without(place), self.images[place][self.mask]
            predicted, values = np.maximum(normals @ self.lights[place], 0), image / self.top
            shadow = (values < _DARK) & (predicted < 2 * _DARK)
            kept = ~shadow & (values <= _HIGHLIGHT[0] * predicted + _HIGHLIGHT[1])
            arrays = normals * self.top[:, None], normals.any(axis=1), kept, image * kept
            applies = kept.mean() >= 0.3
            maps = tuple(map(self._map, arrays))
            self._found[place] = _Compared(maps, self._sums) if applies else None
        return self._found[place]

    def predicted(self, place: int) -> Float64Array:
        """Return the values (P,) of an image that the others predict."""
        return np.asarray(np.maximum(self.without(place) @ self.lights[place], 0) * self.top)

    def usual_residual(self, places: Sequence[int]) -> float:
        """Return the lower quartile of the residuals of some images in their current positions."""
        still = [each.still for each in map(self._compared, places) if each is not None]
        return float(np.quantile(still, 0.25)) if still else np.inf

    def find(self, place: int, usual: float) -> tuple[float, Shift]:
        """Return the shift with the smallest residual, and the reduction;
        0 if it is not accepted.
        """
        compared = self._compared(place)
        if compared is None or not _may_be_moved(compared.still, _LEAST_FALL, usual):
            return _NO_SHIFT
        most_left = _LEFT if len(self.images) >= _MANY_IMAGES else _LEFT_OF_FEW
        fall, shift = _least(*compared.residuals, _LEAST_FALL, most_left, usual)
        real = fall > 0 and self._left_in_halves(compared.maps, shift) <= _LEFT
        return (fall, shift) if real else _NO_SHIFT

    def find_common(self, places: Sequence[int], usual: float) -> tuple[float, Shift]:
        """Return the same for images that may all have the same shift."""
        found = [compared for compared in map(self._compared, places) if compared is not None]
        if len(found) < len(places) / 2:
            return _NO_SHIFT
        # medians, so that one shifted image does not decide
        if not _may_be_moved(np.median([each.still for each in found]), _LEAST_COMMON_FALL, usual):
            return _NO_SHIFT
        left, unmoved = (
            np.stack(each) for each in zip(*(each.residuals for each in found), strict=True)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            shares, usual_unmoved = np.median(left / unmoved, axis=0), np.median(unmoved, axis=0)
        known = np.isfinite(shares) & np.isfinite(usual_unmoved)
        common = np.where(known, shares * usual_unmoved, np.inf)
        return _least(common, usual_unmoved, _LEAST_COMMON_FALL, _LEFT_OF_HALF, usual)

    def _left_in_halves(self, maps: tuple[Float64Array, ...], shift: Shift) -> float:
        """Return the median share that a shift leaves in the upper, lower, left and right half.

        Gloss looks shifted on the side of the highlight alone.
        """

        scaled, good, kept, image = maps

        def residuals(image: Float64Array, kept: Float64Array) -> Float64Array:
            inside = (kept * good) > 0
            light = np.linalg.lstsq(scaled[:, inside].T, image[inside], rcond=None)[0]
            return np.where(inside, np.abs(image - np.tensordot(light, scaled, 1)), np.nan)

        after = residuals(moved(image, shift), moved(kept, shift))
        before = residuals(image, kept * moved(self.mask, shift))
        largest = 3 * np.nanmean(before)
        shares = []
        for half in _halves(self.mask):
            found = [each[half & ~np.isnan(each)].clip(max=largest) for each in (after, before)]
            if all(map(len, found)):
                shares.append(found[0].mean() / max(found[1].mean(), 1e-12))
        return float(np.median(shares)) if shares else np.inf

    def _map(self, values: Float64Array | Bools) -> Float64Array:
        """Return values (P,) or (P, K) on a map (H, W) or (K, H, W), zero outside the mask."""
        array = np.zeros((*values.shape[1:], *self.mask.shape))
        array[..., self.mask] = values.T
        return array


class _Compared:
    """How a matte model fits an image: unmoved, and at all shifts, in shares of its brightness.

    Args:
        maps: Scaled normals (3, H, W) that were fitted without the image; (H, W), 1 where they are
            known and else 0; (H, W), 1 in the pixels of the image that count; the image (H, W),
            zero elsewhere.
    """

    def __init__(self, maps: tuple[Float64Array, ...], sums: ShiftedSums) -> None:
        self.maps, self._sums = maps, sums
        scaled, good, kept, image = maps
        self._brightness = max(float(np.sqrt((image**2).sum() / kept.sum())), 1e-12)
        inside = (good * kept) > 0
        seen, own = scaled[:, inside], image[inside]
        count = inside.sum()
        weights = np.array([count, *(seen @ seen.T)[np.triu_indices(3)]])
        self.still = float(_residual(weights, seen @ own, own @ own)) / self._brightness
        if count <= 0.5 * min(good.sum(), kept.sum()):  # the overlap may be too small
            self.still = float(self.residuals[0][sums.reach, sums.reach])

    @cached_property
    def residuals(self) -> tuple[Float64Array, Float64Array]:
        """The residuals (h, w) of the image at all shifts, infinite where too little overlaps; and
        without a shift, in the pixels that the moved image covers.
        """
        scaled, good, kept, image = self.maps
        of, of_mask = self._sums.of, self._sums.of_mask
        products = np.stack(
            [scaled[i] * scaled[j] for i, j in zip(*np.triu_indices(3), strict=True)]
        )
        weights = np.concatenate((good[None], products))
        found = (
            _residual(of(weights, kept), of(scaled, image), of(good, image**2)),
            _residual(of_mask(kept * weights), of_mask(scaled * image), of_mask(good * image**2)),
        )
        overlap = of(good, kept)
        enough = overlap > 0.5 * overlap.max()
        left, unmoved = (np.where(enough, each / self._brightness, np.inf) for each in found)
        return left, unmoved


class ShiftedSums:
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


def _may_be_moved(still: float, least_fall: float, usual: float) -> bool:
    """Return whether _least may accept a shift of an image with this residual.

    This saves most of the Fourier transforms of a still capture.
    """
    # The half of the pixels that overlap at least has at most the same sum of squares.
    largest = np.sqrt(2) * still
    return bool(largest >= max(least_fall, _UNUSUAL * usual) and _UNUSUAL * usual <= _LARGEST)


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


def _residual(weights: Float64Array, sums: Float64Array, squares: Float64Array) -> Float64Array:
    """Return root mean square residuals at each shift (h, w) of a fit with the best light.

    From the number of pixels and the sums of scaled normals times each other (7, h, w), and the
    sums of images times these (3, h, w).
    """
    count, products = weights[0], weights[1:]
    matrices = np.moveaxis(products[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]], (0, 1), (-2, -1))
    trace = np.trace(matrices, axis1=-2, axis2=-1)
    matrices = matrices + (1e-6 * trace + 1e-12)[..., None, None] * np.eye(3)
    sides = np.moveaxis(sums, 0, -1)
    explained = (sides * np.linalg.solve(matrices, sides[..., None])[..., 0]).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(squares - explained, 0) / np.maximum(count, 1)))
