"""Positions of near lamps from two or more mirror balls, by triangulation.

Each ball gives a ray: from the highlight on its surface in the direction of the lamp. The centres of the balls lie on
the plane z = 0, which the object's mean plane should be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.balls import BallCalibration

LARGEST_SPREAD = 0.2
"""Largest standard deviation of a position, as a share of the lamp's distance. Beyond it the rays are nearly parallel,
and the lamp may be at any distance."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LampPositions:
    """The positions of F lamps; x right, y up, z to the camera, from the middle of the image on the balls' plane.

    Args:
        positions: (F, 3).
        spread: (F,), the standard deviation of each position along its most uncertain direction.
        pixel_size: the width of a pixel in the unit of the positions; 1 if that is a pixel.
    """

    positions: Floats
    spread: Floats
    pixel_size: float

    @property
    def distances(self) -> Floats:
        return np.asarray(np.linalg.norm(self.positions, axis=1))

    @property
    def known(self) -> bool:
        """Whether every lamp has a position in front of the balls that the rays determine well."""
        return bool(
            (self.positions[:, 2] > 0).all() and (self.spread <= LARGEST_SPREAD * self.distances).all()
        )


def triangulate_lamps(
    balls: Sequence[BallCalibration], *, ball_diameter: float | None = None
) -> LampPositions | None:
    """Return the positions of the lamps from balls that one camera photographed; None for balls at one place.

    Args:
        balls: at least two balls, or one at two places.
        ball_diameter: of each ball, in the unit of the result. None leaves positions in pixels.
    """
    circles = [ball.circle for ball in balls]
    apart = max(math.hypot(circle.x - circles[0].x, circle.y - circles[0].y) for circle in circles)
    if apart < circles[0].radius or len({ball.shape for ball in balls}) > 1:
        return None
    height, width = balls[0].shape
    pixel_size = 1.0
    if ball_diameter is not None:
        pixel_size = ball_diameter / float(np.mean([2 * ball.circle.radius for ball in balls]))
    middle = np.array(((width - 1) / 2, (height - 1) / 2))
    starts = [
        np.array((ball.circle.x - middle[0], middle[1] - ball.circle.y, 0.0))
        + ball.circle.radius * ball.normals
        for ball in balls
    ]
    positions, spread = intersect_rays(np.array(starts), np.array([ball.directions for ball in balls]))
    return LampPositions(positions * pixel_size, spread * pixel_size, pixel_size)


def intersect_rays(starts: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Return the points (F, 3) nearest to B rays each, and their standard deviations (F,).

    The directions are taken to have equal random errors. Their size is estimated from how far all rays miss the points,
    so three lights or more are needed for a fair estimate.

    Args:
        starts, directions: (B, F, 3), unit directions, B at least 2.
    """
    # Projections across each ray: their sum is singular for parallel rays.
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    weights = np.ones(starts.shape[:2])
    for _ in range(
        3
    ):  # an error of direction counts in proportion to the distance, which is not known at first
        weighted = across * weights[..., None, None]
        right_side = np.einsum("bfij,bfj->fi", weighted, starts)
        inverse = np.linalg.pinv(weighted.sum(axis=0), hermitian=True)
        points = np.einsum("fij,fj->fi", inverse, right_side)
        misses = np.einsum("bfij,bfj->bfi", across, points - starts)
        distances = np.maximum(np.linalg.norm(points - starts, axis=2), 1e-12)
        weights = distances**-2.0
    freedom = starts.shape[1] * (2 * len(starts) - 3)
    variance = (weights * np.square(misses).sum(axis=2)).sum() / freedom
    spread = np.sqrt(variance * np.linalg.eigvalsh(inverse)[:, -1])
    return points, spread
