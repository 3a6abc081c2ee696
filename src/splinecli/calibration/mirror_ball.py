"""Where a mirror ball shows the lamp, and so where the lamp is.

The ball's normal n at the highlight halves the angle between the light l and the viewing direction v = (0, 0, 1), so
l = 2 (n.v) n - v. A common mistake is to take n itself for the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.circle import Circle
from splinecli.errors import InputError

CORE = 0.7
"""A highlight is what is brighter than this share of its brightest value, after a slight blur."""

LEAST_CONTRAST = 4.0
"""Times that the highlight has to be brighter than the ball is in the median."""

_WIDEST = 0.3  # of the radius: a wider patch is a window or an overexposed ball, not a lamp


@dataclass(frozen=True)
class Highlight:
    """Centroid (x, y) in pixels of the picture, the number of pixels, and the share of them that is saturated."""

    x: float
    y: float
    n_pixels: int
    saturated: float


def find_highlight(picture: NDArray[Any], circle: Circle, *, full_scale: float | None = None) -> Highlight:
    """The lamp's image in the ball: the intensity centroid of its brightest patch.

    Args:
        picture: linear values (H, W), gray.
        full_scale: the value at which pixels saturate; None where nothing does.

    Raises:
        InputError: the ball shows no highlight, or none that can be a lamp.
    """
    inside = circle.inside(picture.shape)
    values = np.where(inside, picture, 0).astype(np.float32)
    # Sparkles of single pixels are dust or noise.
    smooth = cv2.GaussianBlur(values, (0, 0), max(0.8, circle.radius / 200)) * inside
    brightest, usual = float(smooth.max()), float(np.median(values[inside]))
    if brightest <= LEAST_CONTRAST * usual or brightest <= 0:
        raise InputError(
            "found no highlight in the ball",
            hint="The lamp's image has to be its brightest spot by far; photograph it with other lights off",
        )
    _, labels = cv2.connectedComponents((smooth >= CORE * brightest).astype(np.uint8))
    # Of several patches the one with the most light, not with the one brightest pixel.
    light = np.bincount(labels.ravel(), weights=smooth.ravel())
    light[0] = 0
    core = labels == light.argmax()
    y, x = np.nonzero(core)
    if max(np.ptp(x), np.ptp(y)) > _WIDEST * 2 * circle.radius:
        raise InputError(
            f"the brightest patch in the ball is {max(np.ptp(x), np.ptp(y))} pixels wide, too wide for a lamp",
            hint="Shorten the exposure, or shade windows and walls",
        )
    # Where the core is saturated all its pixels count alike: the middle of its shape.
    weight = smooth[core].astype(np.float64) - 0.9 * CORE * brightest
    saturated = float((values[core] >= full_scale).mean()) if full_scale is not None else 0.0
    return Highlight(
        float(np.average(x, weights=weight)), float(np.average(y, weights=weight)), int(core.sum()), saturated
    )


def light_direction(circle: Circle, highlight: Highlight) -> NDArray[np.float64]:
    """Unit direction (3,) towards the lamp: x right, y up, z to the camera.

    Raises:
        InputError: the highlight lies where the ball mirrors what is behind it.
    """
    normal = circle.normals(np.array([highlight.x]), np.array([highlight.y]))[0]
    if not np.isfinite(normal).all() or 2 * normal[2] ** 2 <= 1:
        raise InputError(
            "the highlight lies near the ball's rim: its lamp stands level with the ball or behind it",
            hint="Lights have to stand on the camera's side of the object",
        )
    direction: NDArray[np.float64] = 2 * normal[2] * normal - (0.0, 0.0, 1.0)
    return direction
