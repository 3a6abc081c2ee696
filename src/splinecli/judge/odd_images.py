"""Images that contradict the others, or are shifted because the camera moved, and a ground truth
that does not fit.

One image that contradicts the others: its lamp was moved or failed, its exposure differs, a shadow
fell on it. Each image is left out in turn. If the residual nearly vanishes without one image, and
remains without any other, this one is odd. So is an image that the factors of rank 3 explain far
less well than all others. Thresholds are chosen as in light_check.py, after one image was dimmed,
exchanged or half in shadow, or one light was moved by 40 degrees.

Shifted images: under a fixed camera, the images of a matte object are a matrix of rank 3 (see
light_fit). So each image can be predicted from the others under any light, and its fine detail is
where the prediction has it. If it is elsewhere, the image is shifted: the peak of the normalised
cross-correlation gives the distance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from splinecli.capture.light_rows import PLANE_FRAMES, LightFrame
from splinecli.capture.sample import Sample
from splinecli.lights.light_fit import Factors
from splinecli.lights.rough_normals import rough_normals
from splinecli.maths import Bools, Float32Array, Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning


@dataclass(frozen=True)
class OddImage:
    """An image that contradicts the others."""

    place: int
    # residual of the lights or the factors without it, as a share of the residual of all images
    left: float
    # as a share of the predicted brightness; None if it is not the fault, or the light's intensity
    # is unknown
    brightness: float | None = None


def find_odd_image(factors: Factors, light_directions: Float64Array) -> OddImage | None:
    """Return the image that contradicts the others under lights (F, 3), or None."""
    if len(light_directions) < 10:  # a correct image may seem odd by chance
        return None
    kinds = [factors] if factors.intensities_known else []
    for compared in (*kinds, factors.with_free_intensities()):
        shares = _shares_left(compared, light_directions)
        first, second = np.argsort(shares)[:2]
        # Largest residual without the odd image, and smallest one without any other, as shares of
        # all images' residual.
        alone = shares[first] < 0.35 and shares[second] > 0.75
        if (
            alone and factors.residual < 0.2
        ):  # with more, as on metals, residuals of lights are not conclusive
            brightness = _brightness(compared, light_directions, int(first))
            return OddImage(int(first), float(shares[first]), brightness)
    residuals = factors.image_residuals / np.maximum(np.linalg.norm(factors.matrix, axis=0), 1e-12)
    second, first = np.argsort(residuals)[-2:]
    left = float(np.linalg.norm(np.delete(factors.image_residuals, first)))
    # An odd image's residual is above the first, as a share of its brightness, and this many times
    # any other's.
    if residuals[first] > max(0.25, 2.5 * residuals[second]) and left < min(
        0.15, 0.6 * factors.residual
    ):
        return OddImage(int(first), left / factors.residual)
    return None


def _shares_left(factors: Factors, light_directions: Float64Array) -> Float64Array:
    """Return the root mean square residuals (F,) without each image, as shares of all images'
    residual.
    """
    n_lights = len(light_directions)
    misfit = factors.misfits(light_directions[None])[0]
    if misfit < 0.04:  # of lights, one of whose images is odd, as a share of the brightness
        return np.ones(n_lights)
    without = np.repeat(light_directions[None], n_lights, axis=0)
    diagonal = np.arange(n_lights)
    without[diagonal, diagonal] = 0  # then all of this image is residual
    left = factors.misfits(without) ** 2 - (factors.matrix**2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(left, 0) * n_lights / (n_lights - 1)) / misfit)


def _brightness(factors: Factors, light_directions: Float64Array, place: int) -> float | None:
    """Return the brightness of an image as a share of the others' prediction; None if it is not
    only scaled.
    """
    if not factors.intensities_known:
        return None
    others = np.delete(np.arange(len(light_directions)), place)
    fit = np.linalg.lstsq(light_directions[others], factors.matrix[:, others].T, rcond=None)[0]
    predicted, found = light_directions[place] @ fit, factors.matrix[:, place]
    brightness = float(found @ predicted / max(predicted @ predicted, 1e-12))
    misfit = np.linalg.norm(found - brightness * predicted) / max(
        float(np.linalg.norm(found)), 1e-12
    )
    # Largest residual, as a share of an odd image, at which it is considered the same image at
    # another brightness.
    return brightness if brightness > 0 and misfit < 0.3 else None


_LARGEST_SHIFT = 8  # the largest shift that is looked for, in pixels of the sample
# By how much a shift increases the correlation of details. In captures without shifts, of ten
# images and more, a polished metal reached a correlation of 0.44, and an increase of 0.17.
_LEAST_GAIN = 0.2


class ImageShift(NamedTuple):
    """An image whose detail is `right` pixels to the right of, and `down` pixels below, its place
    in the others.
    """

    place: int
    right: int
    down: int

    def __str__(self) -> str:
        """Return the shift as "2 right 1 up"."""
        directions = [(self.right, "right", "left"), (self.down, "down", "up")]
        return " ".join(
            f"{abs(by)} {more if by > 0 else less}" for by, more, less in directions if by
        )


def find_shifts(sample: Sample) -> list[ImageShift]:
    """Return the images of a sample that are shifted by a pixel of its grid or more, in pixels of
    the images.
    """
    import cv2

    values = np.sqrt(np.maximum(sample.observations, 0), dtype=np.float32)
    # 1 at pixels that stay in the mask under every shift that is looked for, 0 elsewhere
    around = np.ones((2 * _LARGEST_SHIFT + 1, 2 * _LARGEST_SHIFT + 1), np.uint8)
    eroded = cv2.erode(
        sample.mask.astype(np.float32), around, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    inner = np.asarray(eroded, np.float32)
    # From fewer images, polished metals are predicted so badly that right images are named.
    if values.shape[1] < 10 or np.count_nonzero(inner) < 1000:
        return []
    values = values / np.maximum(values.mean(axis=0), 1e-9)
    detail = _Detail(sample.mask)

    def shifts_against(predictors: Sequence[int]) -> list[ImageShift]:
        images = zip(values.T, _predictions(values, predictors).T, strict=True)
        shifts = enumerate(
            _shift(detail.of(image), detail.of(predicted), inner) for image, predicted in images
        )
        return [
            ImageShift(place, *(sample.step * by for by in shift))
            for place, shift in shifts
            if shift is not None
        ]

    found = shifts_against(range(values.shape[1]))
    still = sorted({*range(values.shape[1])} - {shift.place for shift in found})
    # A shifted image also disturbs the prediction of others. Four others or more predict an image.
    return shifts_against(still) if found and len(still) >= 5 else found


def _predictions(values: Float32Array, predictors: Sequence[int]) -> Float32Array:
    """Return the predictions (P, F) of each image of (P, F) by the three strongest factors of the
    other predictors.
    """
    products = values.T @ values
    coefficients = np.zeros_like(products)
    for place in range(len(products)):
        others = [other for other in predictors if other != place]  # no image predicts itself
        eigenvalues, directions = np.linalg.eigh(products[np.ix_(others, others)])
        weights = directions[:, -3:] / np.sqrt(np.maximum(eigenvalues[-3:], 1e-12))
        coefficients[others, place] = weights @ (weights.T @ products[others, place])
    return np.asarray(values @ coefficients)


def _shift(
    detail: Float32Array, expected: Float32Array, inner: Float32Array
) -> tuple[int, int] | None:
    """Return the shift (right, down) in pixels of the mask's grid at which the detail of an image
    agrees with what is expected; or None.
    """
    weighted = inner * detail
    energy = (weighted * detail).sum() * (inner * expected * expected).sum()
    # correlations are at most 1
    if (weighted * expected).sum() > (1.001 - _LEAST_GAIN) * np.sqrt(energy):
        return None
    correlations = _correlations(detail, expected, inner)
    right, down = _peak(correlations)
    peak, unmoved = (
        correlations[_LARGEST_SHIFT + down, _LARGEST_SHIFT + right],
        correlations[(_LARGEST_SHIFT,) * 2],
    )
    at_edge = max(abs(right), abs(down)) == _LARGEST_SHIFT  # the peak may be beyond
    # A shift is accepted if detail correlates so well at it, and so much better than without it.
    if at_edge or peak < 0.2 or peak - unmoved < _LEAST_GAIN:
        return None
    around = correlations[_LARGEST_SHIFT + down - 1 :, _LARGEST_SHIFT + right - 1 :][:3, :3]
    # The shortest shift that is accepted, in pixels of the sample. A tripod sinks by half a pixel.
    if np.hypot(right + _top(*around[1]), down + _top(*around[:, 1])) < 0.8:
        return None
    # A moved camera shifts the whole picture. The highlights of a polished relief move in different
    # directions.
    for places, middle in zip(
        np.indices(inner.shape), map(np.median, np.nonzero(inner)), strict=True
    ):
        for half in (inner * (places <= middle), inner * (places > middle)):
            of_half = _peak(_correlations(detail, expected, half))
            if max(abs(of_half[0] - right), abs(of_half[1] - down)) > 1:
                return None
    return right, down


def _correlations(
    detail: Float32Array, expected: Float32Array, inner: Float32Array
) -> Float32Array:
    """Return the correlations of two images (H, W) at shifts down and right up to
    _LARGEST_SHIFT.
    """
    import cv2

    most = slice(_LARGEST_SHIFT, -_LARGEST_SHIFT)
    template, weights = (np.ascontiguousarray(part[most, most]) for part in (expected, inner))
    found = cv2.matchTemplate(detail, template, cv2.TM_CCORR_NORMED, mask=weights)
    return np.nan_to_num(np.asarray(found, np.float32), posinf=0, neginf=0)


def _peak(correlations: Float32Array) -> tuple[int, int]:
    down, right = np.unravel_index(correlations.argmax(), correlations.shape)
    return int(right) - _LARGEST_SHIFT, int(down) - _LARGEST_SHIFT


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

    def of(self, values: Float32Array) -> Float32Array:
        """Return the detail of values (P,) on a map (H, W), zero outside the mask."""
        image = np.zeros(self._mask.shape, np.float32)
        image[self._mask] = values
        detail = (image - self._blur(image, 1.5) / self._weights[1.5]) * self._inside
        contrast = self._blur(np.abs(detail), 4.0) / self._weights[4.0]
        # Detail fades out below this share of the mean contrast.
        least = 0.05 * np.abs(detail[self._mask]).mean() + np.float32(1e-12)
        # limits the weight of highlights
        return np.asarray((detail / (contrast + least)).clip(-4.0, 4.0), np.float32)

    def _blur(self, array: Float32Array, deviation: float) -> Float32Array:
        import cv2

        return np.asarray(cv2.GaussianBlur(array, (0, 0), deviation))


_FRAMES = [
    LightFrame((*frame.signs[:2], z), frame.exchanged) for z in (1, -1) for frame in PLANE_FRAMES
]


def check_ground_truth(
    sample: Sample, light_directions: Float64Array, truth: Floats | None
) -> list[CaptureWarning]:
    """Warn about a ground truth (H, W, 3) that fits a sample under lights (F, 3) only in another
    frame, or when moved.

    It covers the whole images: unit normals, or zero without ground truth. None gives no warning.
    """
    if truth is None:
        return []
    truth = truth[:: sample.step, :: sample.step]
    known = sample.mask & truth.any(axis=2)
    if not known.any():
        return []
    normals = rough_normals(sample.observations, light_directions, sample.mask).normals

    def angle_in_deg(frame: LightFrame) -> float:
        return float(np.median(angle_between_deg(normals[known], truth[known] @ frame.matrix.T)))

    # Metals reach 30 degrees in the right frame; another frame leaves at most half of the angle.
    angles = [angle_in_deg(_FRAMES[0])]
    if angles[0] > 20.0:
        angles += map(angle_in_deg, _FRAMES[1:])
    best = int(np.argmin(angles))
    if angles[0] <= 20.0 or angles[best] > 0.5 * angles[0]:
        return _shifted(normals, truth, sample)
    frame = _FRAMES[best]
    kind, lights = (
        codes.GROUND_TRUTH_FRAME,
        ", or the light directions are in another frame than it",
    )
    if frame.signs[2] < 0:
        kind, lights = codes.GROUND_TRUTH_Z, ""
    text = (
        f"The ground truth is {angles[0]:.0f} degrees from normals that fit the images, but"
        f" {angles[best]:.0f} degrees with {frame.describe()}: it is probably in this"
        f" frame{lights}, so the errors mean nothing."
    )
    # Either the ground truth or the normals are wrong by this angle.
    return [CaptureWarning(kind, text, angles[0] if kind == codes.GROUND_TRUTH_FRAME else None)]


def _shifted(normals: Float64Array, truth: Floats, sample: Sample) -> list[CaptureWarning]:
    """Warn about a ground truth (h, w, 3) that fits normals (h, w, 3) much better once moved."""
    rows, columns = np.nonzero(sample.mask)
    reach = max(1, round(0.15 * min(int(np.ptp(places)) + 1 for places in (rows, columns))))
    # Coarse to fine: the angle changes slowly with the shift.
    right, down, step = 0, 0, max(1, reach // 4)
    angles: dict[tuple[int, int], tuple[float, float]] = {}
    angles_deg = _moved_angles(normals, truth)
    while step:
        around = (
            range(-reach, reach + 1, step) if not angles else range(-step * 2, step * 2 + 1, step)
        )
        middle = right, down
        for by_right in around:
            for by_down in around:
                moved = middle[0] + by_right, middle[1] + by_down
                if moved not in angles:
                    angles[moved] = angles_deg(moved)
        right, down = min(angles, key=lambda moved: angles[moved][0] - angles[moved][1])
        step //= 2
    after, before = angles[right, down]
    # A shift leaves less of the angle, also after a rotation, because on balls they are similar.
    most_left = 0.65
    if (right, down) == (0, 0) or before - after < 1.5 or after > most_left * before:
        return []
    known = normals.any(axis=2) & truth.any(axis=2)
    # The median angle after the best rotation (Kabsch 1976)
    left, _, right_vectors = np.linalg.svd(normals[known].T @ truth[known])
    rotation = left @ np.diag((1, 1, np.sign(np.linalg.det(left @ right_vectors)))) @ right_vectors
    if after > most_left * float(
        np.median(angle_between_deg(normals[known], truth[known] @ rotation.T))
    ):
        return []
    directions = ((right, "right", "left"), (down, "down", "up"))
    named = " and ".join(
        f"{abs(by) * sample.step} pixels {more if by > 0 else less}"
        for by, more, less in directions
        if by
    )
    text = (
        f"The ground truth is {before:.1f} degrees from normals that fit the images, but"
        f" {after:.1f} degrees once a shift of {named} is undone: it is probably shifted against"
        " the images, so the errors mean nothing."
    )
    return [CaptureWarning(codes.GROUND_TRUTH_SHIFTED, text)]


def _moved_angles(
    normals: Float64Array, truth: Floats
) -> Callable[[tuple[int, int]], tuple[float, float]]:
    """Return a function of a shift (right, down): the median angles in degrees between normals
    (h, w, 3) and a truth that is moved back, and not moved, in the same pixels.
    """
    height, width = normals.shape[:2]
    truth = unit(truth.astype(np.float64))
    own_known, truth_known = (np.asarray(each.any(axis=2)) for each in (normals, truth))
    both, least = own_known & truth_known, max(1, 0.5 * np.count_nonzero(own_known))
    unmoved = np.einsum("hwc,hwc->hw", normals, truth)

    def angles_deg(shift: tuple[int, int]) -> tuple[float, float]:
        right, down = shift
        here, there = (
            (slice(max(0, -y), height - max(0, y)), slice(max(0, -x), width - max(0, x)))
            for x, y in ((right, down), (-right, -down))
        )
        places = np.flatnonzero(both[here] & truth_known[there])
        if len(places) < least:
            return 180.0, 0.0
        places = places[:: -(-len(places) // 4000)]  # to save time
        rows, columns = np.divmod(places, width - abs(right))
        cosines = np.einsum("pc,pc->p", normals[here][rows, columns], truth[there][rows, columns])
        # The median of the angles is the angle of the median, up to rounding.
        after, before = (
            float(np.degrees(np.arccos(np.median(each).clip(-1, 1))))
            for each in (cosines, unmoved[here][rows, columns])
        )
        return after, before

    return angles_deg
