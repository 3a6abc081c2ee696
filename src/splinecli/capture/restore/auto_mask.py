"""A mask from the photographs alone: what is brighter than the background, its largest part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError

_SMALLEST, _LARGEST = 0.005, 0.98
"""Shares of the picture; a mask beyond them has found no object."""


def find_object(brightness: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The mask (H, W) of what stands out from a darker background.

    Otsu's threshold ("A threshold selection method from gray-level histograms", 1979) on lightness, the cube root, by
    which dark parts of an object are nearer to its bright ones than to the background; then the largest connected
    part, its holes filled. It cannot tell an object from a background that is as bright.

    Args:
        brightness: (H, W), linear: the mean over all lights.

    Raises:
        InputError: next to nothing stands out, or nearly everything does.
    """
    import cv2

    smooth = cv2.medianBlur(np.ascontiguousarray(brightness, np.float32), 3)  # hot pixels
    top = float(np.quantile(smooth, 0.999))
    if top <= 0:
        raise InputError("no mask was found: the images are black")
    lightness = np.rint(255 * np.cbrt(np.clip(smooth / top, 0, 1))).astype(np.uint8)
    _, bright = cv2.threshold(lightness, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(bright, connectivity=4)
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])) if len(statistics) > 1 else 0
    outline, _ = cv2.findContours(
        (labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    mask = cv2.drawContours(np.zeros(brightness.shape, np.uint8), outline, -1, 1, cv2.FILLED) > 0
    share = float(mask.mean())
    if not largest or not _SMALLEST <= share <= _LARGEST:
        raise InputError(
            f"no mask was found: what is brighter than the background covers {100 * share:.1f} % of the picture",
            hint="Paint a mask, white on the object, and give it by --mask",
        )
    return np.asarray(mask)
