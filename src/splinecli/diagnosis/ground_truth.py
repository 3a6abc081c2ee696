"""A ground truth in another frame than the images, or shifted against them."""

import numpy as np

from splinecli import capture_warnings as codes
from splinecli.capture.lights.light_frames import PLANE_FRAMES, LightFrame
from splinecli.capture.sample import Sample
from splinecli.capture_warnings import CaptureWarning
from splinecli.diagnosis.frame_evidence import rough_normals
from splinecli.maths import Bools, Doubles, Floats
from splinecli.maths.normals import angle_between_deg

MIN_ANGLE_DEG, MOST_LEFT = 20.0, 0.5
"""A ground truth is in another frame if its median angle to the rough normals is above the first, and another frame
leaves at most the second of it. On metals with interreflection, the angle reaches 30 degrees in the right frame."""

REACH = 0.15  # the largest shift that is looked for, as a share of the smaller side of the object
SHIFT_LEFT, SHIFT_FALL_DEG = 0.65, 1.5
"""A ground truth is shifted if a shift leaves at most this share of the median angle, and takes so much from it. It
must also leave less than this share of what a rotation leaves: lights that are all tilted turn the normals of a ball
nearly as a shift does."""

_FRAMES = [LightFrame((*frame.signs[:2], z), frame.exchanged) for z in (1, -1) for frame in PLANE_FRAMES]
_MOST_PIXELS = 4000  # of each comparison
_LEAST_OVERLAP = 0.5


def check_ground_truth(sample: Sample, light_directions: Doubles, truth: Floats | None) -> list[CaptureWarning]:
    """Warn of a ground truth (H, W, 3) that fits a sample under lights (F, 3) only in another frame, or when moved.

    It is that of the whole images: unit normals, or zero where there is none. None gives no warning.
    """
    if truth is None:
        return []
    truth = truth[:: sample.step, :: sample.step]
    known = sample.mask & truth.any(axis=2)
    if not known.any():
        return []
    normals = rough_normals(sample.observations, light_directions, sample.mask).normals
    angles = [float(np.median(angle_between_deg(normals[known], truth[known] @ frame.matrix.T))) for frame in _FRAMES]
    best = int(np.argmin(angles))
    if angles[0] <= MIN_ANGLE_DEG or angles[best] > MOST_LEFT * angles[0]:
        return _shifted(normals, truth, sample)
    frame = _FRAMES[best]
    code, lights = codes.GROUND_TRUTH_FRAME, ", or the light directions are in another frame than it"
    if frame.signs[2] < 0:
        code, lights = codes.GROUND_TRUTH_Z, ""
    text = (
        f"The ground truth is {angles[0]:.0f} degrees from normals that fit the images, but {angles[best]:.0f} degrees"
        f" with {frame.describe()}: it is probably in this frame{lights}, so the errors mean nothing."
    )
    # Either the ground truth or the normals are wrong by this angle.
    return [CaptureWarning(code, text, angles[0] if code == codes.GROUND_TRUTH_FRAME else None)]


def _shifted(normals: Doubles, truth: Floats, sample: Sample) -> list[CaptureWarning]:
    """Warn of a ground truth (h, w, 3) that fits normals (h, w, 3) much better when it is moved."""
    rows, columns = np.nonzero(sample.mask)
    reach = max(1, round(REACH * min(int(np.ptp(places)) + 1 for places in (rows, columns))))
    # Coarse to fine: the angle changes slowly with the shift.
    right, down, step = 0, 0, max(1, reach // 4)
    angles: dict[tuple[int, int], tuple[float, float]] = {}
    while step:
        around = range(-reach, reach + 1, step) if not angles else range(-step * 2, step * 2 + 1, step)
        middle = right, down
        for by_right in around:
            for by_down in around:
                moved = middle[0] + by_right, middle[1] + by_down
                angles.setdefault(moved, _angles_deg(normals, truth, moved))
        right, down = min(angles, key=lambda moved: angles[moved][0] - angles[moved][1])
        step //= 2
    after, before = angles[right, down]
    if (right, down) == (0, 0) or before - after < SHIFT_FALL_DEG or after > SHIFT_LEFT * before:
        return []
    known = normals.any(axis=2) & truth.any(axis=2)
    if after > SHIFT_LEFT * _rotated_angle_deg(normals[known], truth[known]):
        return []
    directions = ((right, "right", "left"), (down, "down", "up"))
    named = " and ".join(
        f"{abs(by) * sample.step} pixels {more if by > 0 else less}" for by, more, less in directions if by
    )
    text = (
        f"The ground truth is {before:.1f} degrees from normals that fit the images, but {after:.1f} degrees once"
        f" a shift of {named} is undone: it is probably shifted against the images, so the errors mean nothing."
    )
    return [CaptureWarning(codes.GROUND_TRUTH_SHIFTED, text)]


def _rotated_angle_deg(normals: Doubles, truth: Floats) -> float:
    """Return the median angle between normals (P, 3) and a truth after the best rotation (Kabsch 1976)."""
    left, _, right = np.linalg.svd(normals.T @ truth)
    rotation = left @ np.diag((1, 1, np.sign(np.linalg.det(left @ right)))) @ right
    return float(np.median(angle_between_deg(normals, truth @ rotation.T)))


def _angles_deg(normals: Doubles, truth: Floats, shift: tuple[int, int]) -> tuple[float, float]:
    """Return the median angles in degrees between normals and a truth that is moved back, and not moved."""
    height, width = normals.shape[:2]
    right, down = shift
    here = slice(max(0, -down), height - max(0, down)), slice(max(0, -right), width - max(0, right))
    there = slice(max(0, down), height - max(0, -down)), slice(max(0, right), width - max(0, -right))
    moved = truth[there]
    known: Bools = np.all([each.any(axis=2) for each in (normals[here], moved, truth[here])], axis=0)
    if np.count_nonzero(known) < max(1, _LEAST_OVERLAP * np.count_nonzero(normals.any(axis=2))):
        return 180.0, 0.0
    every = slice(None, None, -(-int(np.count_nonzero(known)) // _MOST_PIXELS))
    own = normals[here][known][every]
    after, before = (float(np.median(angle_between_deg(own, other[known][every]))) for other in (moved, truth[here]))
    return after, before
