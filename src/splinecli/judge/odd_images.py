"""An image that contradicts the others, and a ground truth that does not fit.

One image that contradicts the others: its lamp was moved or failed, its exposure differs, a shadow
fell on it. Each image is left out in turn. If the residual nearly vanishes without one image, and
remains without any other, this one is odd. So is an image that the factors of rank 3 explain far
less well than all others. Thresholds are chosen as in light_check.py, after one image was dimmed,
exchanged or half in shadow, or one light was moved by 40 degrees.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splinecli.capture.light_rows import PLANE_FRAMES, LightFrame
from splinecli.capture.sample import Sample
from splinecli.lights.light_fit import Factors
from splinecli.lights.rough_normals import rough_normals
from splinecli.maths import Float64Array, Floats
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
        f" {after:.1f} degrees once a shift of {named} is undone: it or some of the images are"
        " probably shifted, so the errors mean nothing."
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
