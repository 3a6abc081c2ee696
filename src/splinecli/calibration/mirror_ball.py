"""The highlight of a lamp in a mirror ball, and the light direction that follows from it.

The ball's normal n at the highlight halves the angle between the light direction l and the direction v to the camera,
so l = 2 (n.v) n - v. A common mistake is to use n itself as the light direction. The camera is at the origin, and the
unit of length is the radius of the ball. x is right, y up, z towards the camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from splinecli.calibration.circle import Circle
from splinecli.calibration.view import unit_rays
from splinecli.errors import InputError
from splinecli.maths import Array, Doubles
from splinecli.surface.pixel_grid import ray_basis

HIGHLIGHT_LEVEL = 0.7  # a highlight is the patch above this share of its brightest value, after a slight blur
MIN_CONTRAST = 4.0  # smallest ratio of the highlight to the median of the ball
_MAX_WIDTH = 0.3  # of the diameter; a wider patch is a window or an overexposed ball, not a lamp


@dataclass(frozen=True)
class Highlight:
    """The image of a lamp in a mirror ball."""

    x: float  # of the centroid, in pixels of the image
    y: float
    saturated: float  # share of its pixels that is saturated, 0 to 1


def find_highlight(image: Array, circle: Circle, *, full_scale: float | None = None) -> Highlight:
    """Return the highlight of the lamp in the ball: the weighted centroid of its brightest patch.

    Args:
        image: (H, W), linear gray values.
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
        problem = f"the brightest patch in the ball is {width} pixels wide, too wide for a lamp"
        raise InputError(problem, hint="Shorten the exposure, or cover windows and bright walls")
    # In a saturated highlight all weights are nearly equal, so the centroid is the middle of its shape.
    weight = smooth[core].astype(np.float64) - 0.9 * HIGHLIGHT_LEVEL * brightest
    saturated = float((values[core] >= full_scale).mean()) if full_scale is not None else 0.0
    return Highlight(float(np.average(x, weights=weight)), float(np.average(y, weights=weight)), saturated)


def ball_centre(outline: Doubles, matrix: Doubles) -> Doubles:
    """Return the centre (3,) of a ball whose outline a camera sees at image points (N, 2).

    Rays d that touch the ball, |d| = 1, form a cone: d.c = sqrt(|c|^2 - 1). For m = c / sqrt(|c|^2 - 1), this is
    linear. Written with m_z + 1, it is also exact for a camera that is far away.
    """
    x, y, _ = (np.column_stack((outline, np.ones(len(outline)))) @ ray_basis(matrix)).T
    equations = np.column_stack((x, y, np.ones(len(x))))
    right_side = (x * x + y * y) / (1 + np.hypot(np.hypot(x, y), 1))
    kept = np.ones(len(x), np.bool_)
    for _ in range(4):
        solution = np.linalg.lstsq(equations[kept], right_side[kept], rcond=None)[0]
        misses = np.abs(equations @ solution - right_side)
        kept = misses <= 4 * np.median(misses) + 1e-30
    mx, my, beyond = solution
    inverse = mx * mx + my * my + beyond * (2 + beyond)
    return np.asarray(np.array((mx, my, -1 - beyond)) / np.sqrt(max(inverse, 1e-30)))


def reflect(centre: Doubles, highlights: Doubles, matrix: Doubles) -> tuple[Doubles, Doubles]:
    """Return normals and light directions (F, 3) at the highlights (F, 2) of a ball; NaN beside the ball."""
    rays = unit_rays(highlights, matrix)
    across = centre - (rays @ centre)[:, None] * rays
    with np.errstate(invalid="ignore"):
        normals = -across - np.sqrt(1 - np.square(across).sum(axis=1, keepdims=True)) * rays
    return normals, rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals


def check_in_front(direction: Doubles, ray: Doubles) -> None:
    """Raise InputError for a light direction (3,) that is level with the ball or behind it, as the camera sees it."""
    if not direction @ ray < 0:
        problem = "the highlight is near the rim of the ball: the lamp is level with the ball or behind it"
        raise InputError(problem, hint="Place all lights on the camera's side of the object")
