"""Find the mask of the object in the images, and detect a given mask that is inverted."""

from __future__ import annotations

import numpy as np

from splinecli.errors import InputError
from splinecli.maths import Bools, Float32Array

_DARK = 0.2  # brightness of a dark background, as a share of the object's
_ELSEWHERE = 0.1  # bright area outside the object, as a share of the object's


def surrounds_hole(mask: Bools) -> bool:
    """Return whether a mask (H, W) contains the border of the picture but not all of its middle."""
    border = np.concatenate((mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    return bool(border.mean() >= 0.95 and 0.05 <= 1 - mask.mean() < 1)


def looks_inverted(mask: Bools, brightness: Float32Array) -> bool:
    """Return whether a mask (H, W) surrounds a hole that is not dark in the brightness (H, W) of
    the picture.
    """
    return surrounds_hole(mask) and bool(
        np.median(brightness[~mask]) > 0.5 * np.median(brightness[mask])
    )


def find_object(brightness: Float32Array, *, is_requested: bool = True) -> Bools:
    """Return the mask (H, W) of an object in front of a darker background.

    Otsu's threshold ("A threshold selection method from gray-level histograms", 1979) is applied to
    the lightness, the cube root of the brightness, in which dark parts of an object are closer to
    its bright parts than to the background. The mask is the largest connected area above the
    threshold, with its holes filled. This fails if the background is as bright as the object. The
    brightness (H, W) is linear, the mean over all lights. Raises InputError if almost nothing or
    almost everything is brighter than the background. For a mask that was not requested, also
    raises it if the background is not dark, because the darker part of an object that fills the
    image would look the same, or if there are other bright areas, because the largest may be only a
    part of the object.
    """
    import cv2

    smooth = cv2.medianBlur(np.ascontiguousarray(brightness, np.float32), 3)  # removes hot pixels
    top = float(np.quantile(smooth, 0.999))
    if top <= 0:
        raise InputError("no mask was found, because the images are black")
    lightness = np.rint(255 * np.cbrt(np.clip(smooth / top, 0, 1))).astype(np.uint8)
    _, bright = cv2.threshold(lightness, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(bright, connectivity=4)
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])) if len(statistics) > 1 else 0
    outline, _ = cv2.findContours(
        (labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    mask = cv2.drawContours(np.zeros(brightness.shape, np.uint8), outline, -1, 1, cv2.FILLED) > 0
    share = float(mask.mean())
    if not largest or not 0.005 <= share <= 0.98:
        problem = (
            "no mask was found, because the area brighter than the background covers"
            f" {100 * share:.1f} % of the picture"
        )
        raise InputError(
            problem, hint="Paint a mask, white on the object, and pass it with --mask FILE"
        )
    ratio = float(np.median(smooth[~mask]) / max(np.median(smooth[mask]), 1e-12))
    if not is_requested and ratio > _DARK:
        raise InputError(
            f"no mask was found, because the background is not dark ({100 * ratio:.0f} %)"
        )
    if not is_requested and (bright[~mask] > 0).sum() > _ELSEWHERE * mask.sum():
        raise InputError("no mask was found, because several areas are bright")
    return np.asarray(mask)
