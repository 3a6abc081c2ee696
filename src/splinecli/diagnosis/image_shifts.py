"""Images that are shifted against the others, because the camera moved.

Under a fixed camera, the images of a matte object are a matrix of rank 3 (see light_fit). So each image can be
predicted from the others whatever its light, and its fine detail lies where the prediction has it. Where it lies
elsewhere, the image is shifted: the peak of the normalised cross-correlation tells by how much.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from splinecli.capture.sample import Sample
from splinecli.maths import Bools, Singles

LARGEST = 8  # largest shift that is looked for, in pixels of the sample

LEAST_CORRELATION, LEAST_GAIN = 0.2, 0.2
"""A shift counts if detail correlates so well at it, and so much better than without it. Of right captures of ten
images and more, a polished metal reached 0.44 and 0.17."""

LEAST_SHIFT = 0.8  # The shortest shift that counts, in pixels of the sample. A tripod sinks by half a pixel.
LEAST_IMAGES = 10  # fewest images: from fewer, polished metals are predicted so badly that right ones would be named
LEAST_PIXELS = 1000  # fewest pixels that must stay in the mask under every shift
_MIN_PREDICTORS = 5  # an image is predicted from three factors of four others or more
_DETAIL, _CONTRAST = 1.5, 4.0  # standard deviations of blurs in pixels: finer detail, local contrast
_LIMIT = 4.0  # of detail, in local contrasts: highlights count no more
_FAINT = 0.05  # share of the mean contrast below which detail fades out


class ImageShift(NamedTuple):
    """An image whose detail lies `right` pixels to the right and `down` below where the other images have it."""

    place: int
    right: int
    down: int

    def __str__(self) -> str:
        """Return the shift as "2 right 1 up"."""
        directions = [(self.right, "right", "left"), (self.down, "down", "up")]
        return " ".join(f"{abs(by)} {more if by > 0 else less}" for by, more, less in directions if by)


def find_shifts(sample: Sample) -> list[ImageShift]:
    """Return the images of a sample that are shifted by a pixel of its grid or more, in pixels of the images."""
    values = np.sqrt(np.maximum(sample.observations, 0), dtype=np.float32)
    inner = _inner(sample.mask)
    if values.shape[1] < LEAST_IMAGES or np.count_nonzero(inner) < LEAST_PIXELS:
        return []
    values = values / np.maximum(values.mean(axis=0), 1e-9)

    def shifts_against(predictors: Sequence[int]) -> list[ImageShift]:
        predicted = enumerate(_predictions(values, predictors))
        shifts = ((place, _shift(values[:, place], image, sample.mask, inner)) for place, image in predicted)
        return [ImageShift(place, *(sample.step * by for by in shift)) for place, shift in shifts if shift is not None]

    found = shifts_against(range(values.shape[1]))
    still = sorted({*range(values.shape[1])} - {shift.place for shift in found})
    # A shifted image also disturbs the prediction of others.
    return shifts_against(still) if found and len(still) >= _MIN_PREDICTORS else found


def _predictions(values: Singles, predictors: Sequence[int]) -> Iterator[Singles]:
    """Yield for each image of (P, F) what the three strongest factors of the predictors explain of it, (P,)."""
    products = values.T @ values
    for place in range(len(products)):
        others = [other for other in predictors if other != place]  # no image predicts itself
        strengths, directions = np.linalg.eigh(products[np.ix_(others, others)])
        weights = np.zeros((len(products), 3), np.float32)
        weights[others] = directions[:, -3:] / np.sqrt(np.maximum(strengths[-3:], 1e-12))
        factors = values @ weights
        yield np.asarray(factors @ (factors.T @ values[:, place]), np.float32)


def _shift(image: Singles, predicted: Singles, mask: Bools, inner: Singles) -> tuple[int, int] | None:
    """Return the shift (right, down) in pixels of the mask's grid at which the detail of two images agrees; or None."""
    detail, expected = _detail(image, mask), _detail(predicted, mask)
    correlations = _correlations(detail, expected, inner)
    right, down = _peak(correlations)
    peak, unmoved = correlations[LARGEST + down, LARGEST + right], correlations[LARGEST, LARGEST]
    at_edge = max(abs(right), abs(down)) == LARGEST  # the peak may lie beyond
    if at_edge or peak < LEAST_CORRELATION or peak - unmoved < LEAST_GAIN:
        return None
    around = correlations[LARGEST + down - 1 :, LARGEST + right - 1 :][:3, :3]
    if np.hypot(right + _top(*around[1]), down + _top(*around[:, 1])) < LEAST_SHIFT:
        return None
    # A camera moves the whole picture. The highlights of a polished relief move here in one way, there in another.
    for half in _halves(inner):
        of_half = _peak(_correlations(detail, expected, half))
        if max(abs(of_half[0] - right), abs(of_half[1] - down)) > 1:
            return None
    return right, down


def _correlations(detail: Singles, expected: Singles, inner: Singles) -> Singles:
    """Return the correlations of two images (H, W) at shifts down and right from -LARGEST to LARGEST."""
    import cv2

    most = slice(LARGEST, -LARGEST)
    template, weights = (np.ascontiguousarray(part[most, most]) for part in (expected, inner))
    found = cv2.matchTemplate(detail, template, cv2.TM_CCORR_NORMED, mask=weights)
    return np.nan_to_num(np.asarray(found, np.float32), posinf=0, neginf=0)


def _peak(correlations: Singles) -> tuple[int, int]:
    down, right = np.unravel_index(correlations.argmax(), correlations.shape)
    return int(right) - LARGEST, int(down) - LARGEST


def _halves(inner: Singles) -> Iterator[Singles]:
    """Yield the left, right, upper and lower half of the pixels of a map (H, W)."""
    for places, middle in zip(np.indices(inner.shape), map(np.median, np.nonzero(inner)), strict=True):
        yield inner * (places <= middle)
        yield inner * (places > middle)


def _top(before: float, middle: float, after: float) -> float:
    """Return where the parabola through three values has its top, from the middle one, which is the largest."""
    return float(after - before) / 2 / max(float(2 * middle - before - after), 1e-9)


def _detail(values: Singles, mask: Bools) -> Singles:
    """Return values (P,) without their blur, over the local contrast, on a map (H, W); zero outside the mask."""
    import cv2

    inside = mask.astype(np.float32)

    def blur(array: Singles, deviation: float) -> Singles:
        weight = cv2.GaussianBlur(inside, (0, 0), deviation)
        return np.asarray(cv2.GaussianBlur(array, (0, 0), deviation) / np.maximum(weight, 1e-3), np.float32)

    image = np.zeros(mask.shape, np.float32)
    image[mask] = values
    detail = (image - blur(image, _DETAIL)) * inside
    contrast = blur(np.abs(detail), _CONTRAST)
    detail /= contrast + _FAINT * np.abs(detail[mask]).mean() + np.float32(1e-12)
    return np.asarray(detail.clip(-_LIMIT, _LIMIT), np.float32)


def _inner(mask: Bools) -> Singles:
    """Return 1 at pixels that stay in the mask under every shift that is looked for, 0 elsewhere."""
    import cv2

    shifts = np.ones((2 * LARGEST + 1, 2 * LARGEST + 1), np.uint8)
    return np.asarray(cv2.erode(mask.astype(np.float32), shifts, borderType=cv2.BORDER_CONSTANT, borderValue=0))
