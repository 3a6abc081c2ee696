"""A mask made from the images: the largest area that is brighter than the background."""

import numpy as np

from splinecli.errors import InputError
from splinecli.maths.arrays import Bools, Singles

_SMALLEST, _LARGEST = 0.005, 0.98  # smallest and largest share of the picture that an object can cover


def find_object(brightness: Singles) -> Bools:
    """Return the mask (H, W) of an object before a darker background.

    Otsu's threshold ("A threshold selection method from gray-level histograms", 1979) is taken of lightness, the cube
    root of brightness, in which dark parts of an object are closer to its bright parts than to the background. The mask
    is the largest connected area above it, with its holes filled. This fails if the background is as bright as
    the object.

    Args:
        brightness: (H, W), linear: the mean over all lights.

    Raises:
        InputError: nearly nothing is brighter than the background, or nearly everything is.
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
    outline, _ = cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    mask = cv2.drawContours(np.zeros(brightness.shape, np.uint8), outline, -1, 1, cv2.FILLED) > 0
    share = float(mask.mean())
    if not largest or not _SMALLEST <= share <= _LARGEST:
        problem = f"no mask was found: the area brighter than the background covers {100 * share:.1f} % of the picture"
        raise InputError(problem, hint="Paint a mask, white on the object, and pass it with --mask FILE")
    return np.asarray(mask)
