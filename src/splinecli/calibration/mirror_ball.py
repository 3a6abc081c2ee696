"""The highlight of a lamp in a mirror ball, and the light direction that follows from it.

The ball's normal n at the highlight halves the angle between the light direction l and the viewing direction
v = (0, 0, 1), so l = 2 (n.v) n - v. A common mistake is to use n itself as the light direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.circle import Circle
from splinecli.errors import InputError

HIGHLIGHT_LEVEL = 0.7
"""A highlight is the patch above this share of its brightest value, after a slight blur."""

MIN_CONTRAST = 4.0
"""Smallest ratio of the highlight to the median of the ball."""

_MAX_WIDTH = 0.3  # of the diameter; a wider patch is a window or an overexposed ball, not a lamp


@dataclass(frozen=True)
class Highlight:
    """The image of a lamp in a mirror ball.

    Args:
        x, y: the centroid, in pixels of the image.
        n_pixels: the number of its pixels.
        saturated: share of them that is saturated, 0 to 1.
    """

    x: float
    y: float
    n_pixels: int
    saturated: float


def find_highlight(image: NDArray[Any], circle: Circle, *, full_scale: float | None = None) -> Highlight:
    """Return the highlight of the lamp in the ball: the weighted centroid of its brightest patch.

    Args:
        image: (H, W), linear gray values.
        circle: the outline of the ball.
        full_scale: the value at which pixels saturate. None for images that do not saturate.

    Raises:
        InputError: the ball shows no highlight, or its brightest patch is too wide for a lamp.
    """
    inside = circle.inside(image.shape)
    values = np.where(inside, image, 0).astype(np.float32)
    # The blur removes bright single pixels, which are dust or noise.
    smooth = cv2.GaussianBlur(values, (0, 0), max(0.8, circle.radius / 200)) * inside
    brightest, median = float(smooth.max()), float(np.median(values[inside]))
    if brightest <= MIN_CONTRAST * median or brightest <= 0:
        raise InputError(
            "found no highlight in the ball",
            hint="Is this a folder of images of a mirror ball? If so, take the images with all other lights off: the"
            " lamp must be by far the brightest spot in the ball",
        )
    _, labels = cv2.connectedComponents((smooth >= HIGHLIGHT_LEVEL * brightest).astype(np.uint8))
    # Of several patches, take the one with the most light rather than the one with the brightest pixel.
    light = np.bincount(labels.ravel(), weights=smooth.ravel())
    light[0] = 0
    core = labels == light.argmax()
    y, x = np.nonzero(core)
    width = max(np.ptp(x), np.ptp(y))
    if width > _MAX_WIDTH * 2 * circle.radius:
        raise InputError(
            f"the brightest patch in the ball is {width} pixels wide, too wide for a lamp",
            hint="Shorten the exposure, or cover windows and bright walls",
        )
    # In a saturated highlight all weights are nearly equal, so the centroid is the middle of its shape.
    weight = smooth[core].astype(np.float64) - 0.9 * HIGHLIGHT_LEVEL * brightest
    saturated = float((values[core] >= full_scale).mean()) if full_scale is not None else 0.0
    return Highlight(
        float(np.average(x, weights=weight)), float(np.average(y, weights=weight)), int(core.sum()), saturated
    )


def light_direction(circle: Circle, highlight: Highlight) -> NDArray[np.float64]:
    """Return the unit vector (3,) towards the lamp: x right, y up, z to the camera.

    Raises:
        InputError: the highlight is so near the rim that the lamp is level with the ball or behind it.
    """
    normal = circle.normals(np.array([highlight.x]), np.array([highlight.y]))[0]
    if not np.isfinite(normal).all() or 2 * normal[2] ** 2 <= 1:
        raise InputError(
            "the highlight is near the rim of the ball: the lamp is level with the ball or behind it",
            hint="Place all lights on the camera's side of the object",
        )
    direction: NDArray[np.float64] = 2 * normal[2] * normal - (0.0, 0.0, 1.0)
    return direction
