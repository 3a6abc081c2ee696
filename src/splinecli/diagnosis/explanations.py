"""A ground truth in another frame than the images and their lights."""

import numpy as np

from splinecli.capture import capture_warnings as codes
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.lights.light_frames import PLANE_FRAMES, LightFrame
from splinecli.capture.sample import Sample
from splinecli.diagnosis.frame_evidence import rough_normals
from splinecli.maths.arrays import Doubles, Floats
from splinecli.maths.normals import angle_between_deg

MIN_ANGLE_DEG, MOST_LEFT = 20.0, 0.5
"""A ground truth is in another frame if its median angle to the rough normals is above the first, and another frame
leaves at most the second of it. On metals with interreflection, the angle reaches 30 degrees in the right frame."""

_FRAMES = [LightFrame((*frame.signs[:2], z), frame.exchanged) for z in (1, -1) for frame in PLANE_FRAMES]


def check_ground_truth(sample: Sample, light_directions: Doubles, truth: Floats | None) -> list[CaptureWarning]:
    """Warn of a ground truth (H, W, 3) that fits a sample under lights (F, 3) only in another frame.

    It is that of the whole images: unit normals, or zero where there is none. None gives no warning.
    """
    if truth is None:
        return []
    truth = truth[:: sample.step, :: sample.step]
    known = sample.mask & truth.any(axis=2)
    if not known.any():
        return []
    normals = rough_normals(sample.observations, light_directions, sample.mask).normals[known]
    angles = [float(np.median(angle_between_deg(normals, truth[known] @ frame.matrix.T))) for frame in _FRAMES]
    best = int(np.argmin(angles))
    if angles[0] <= MIN_ANGLE_DEG or angles[best] > MOST_LEFT * angles[0]:
        return []
    frame = _FRAMES[best]
    code, lights = codes.GROUND_TRUTH_FRAME, ", or the light directions are in another frame than it"
    if frame.signs[2] < 0:
        code, lights = codes.GROUND_TRUTH_Z, ""
    text = (
        f"The ground truth is {angles[0]:.0f} degrees from normals that fit the images, but {angles[best]:.0f} degrees"
        f" with {frame.describe()}: it is probably in this frame{lights}, so the errors mean nothing."
    )
    return [CaptureWarning(code, text)]
