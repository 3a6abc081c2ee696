"""Positions of near lamps from two or more mirror balls, by triangulation.

Each ball gives a ray: from the highlight on its surface in the direction of the lamp. The balls' centres, which the
size of their outlines tells, lie near a plane z = const, which the object's mean plane should be.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splinecli.calibration.balls import BallCalibration
from splinecli.calibration.mirror_ball import ball_centre, reflect
from splinecli.calibration.view import View
from splinecli.maths import Doubles
from splinecli.surface.pixel_grid import focal_length, ray_basis

LARGEST_UNCERTAINTY = 0.4
"""Largest uncertainty of a position, as a share of the lamp's distance. Beyond it the rays are nearly parallel, and the
lamp may be at any distance."""

PIXEL_ERROR = 0.3  # standard deviation of highlights, and of the middle and the radius of outlines, in pixels

HEIGHT_SPREAD = 0.5
"""Usual difference between the heights of the balls' centres and their plane, in radii. It decides where the size of
the outlines does not: under a distant camera."""

CONFIDENCE = 0.95  # share of positions that are within their uncertainty

_DRAWS = 200


@dataclass(frozen=True, eq=False)
class LampPositions:
    """The positions of F lamps; x right, y up, z to the camera, from the middle of the image on the balls' plane."""

    positions: Doubles  # (F, 3)
    uncertainty: Doubles  # (F,), the distance within which the true position is with CONFIDENCE
    pixel_size: float  # the width of a pixel on the plane, in the unit of the positions; 1 if that is a pixel
    view: View

    @property
    def known(self) -> bool:
        """Whether every lamp has a position in front of the balls that the rays determine well."""
        most = LARGEST_UNCERTAINTY * np.linalg.norm(self.positions, axis=1)
        return bool((self.positions[:, 2] > 0).all() and (self.uncertainty <= most).all())


def triangulate_lamps(balls: Sequence[BallCalibration], *, ball_diameter: float | None = None) -> LampPositions | None:
    """Return the positions of the lamps from balls that one camera photographed; None for balls at one place.

    The uncertainty comes from repeating the computation with other pixels (PIXEL_ERROR), heights of the balls and
    cameras (View.draw). It is larger if the rays miss each other by more than this explains.

    Args:
        balls: at least two balls, or one at two places.
        ball_diameter: of each ball, in the unit of the result. None leaves positions in pixels.
    """
    circles = [ball.circle for ball in balls]
    apart = max(math.hypot(circle.x - circles[0].x, circle.y - circles[0].y) for circle in circles)
    if apart < circles[0].radius or len({ball.shape for ball in balls}) > 1:
        return None
    view = balls[0].view
    positions, pixel_size, miss = _positions(balls, view.matrix, ball_diameter)
    generator = np.random.default_rng(0)
    drawn = [_positions(balls, view.draw(generator), ball_diameter, generator) for _ in range(_DRAWS)]
    errors = np.array([np.linalg.norm(other - positions, axis=1) for other, _, _ in drawn])
    errors[np.isnan(errors)] = np.inf
    # Each draw adds as much to the misses as the pixels had added to those of the images, if PIXEL_ERROR is right.
    added = float(np.nanmedian([other for _, _, other in drawn])) - miss
    excess = math.sqrt(max(1.0, miss / added if added > 0 else 1.0))
    uncertainty = excess * np.quantile(errors, CONFIDENCE, axis=0, method="higher")
    return LampPositions(positions, uncertainty, pixel_size, view)


def _positions(
    balls: Sequence[BallCalibration], matrix: Doubles, diameter: float | None, errors: np.random.Generator | None = None
) -> tuple[Doubles, float, float]:
    """Return positions (F, 3), pixel size and the mean square angle by which the rays miss each other.

    `errors` draws errors of the pixels; None takes them as they are.
    """

    def error(*shape: int) -> Doubles:
        return np.zeros(shape) if errors is None else errors.normal(size=shape)

    centres = np.array([ball_centre(ball.circle.outline + PIXEL_ERROR * error(2), matrix) for ball in balls])
    depths = -centres[:, 2]
    shares = np.array([PIXEL_ERROR / ball.circle.radius for ball in balls])
    plane = float(depths.mean() * (1 + (shares * error(len(balls))).mean()))
    # The most probable depths, and their errors, given those from the outlines and HEIGHT_SPREAD.
    weights = HEIGHT_SPREAD**2 / (HEIGHT_SPREAD**2 + (shares * depths) ** 2)
    likely = plane + weights * (depths - depths.mean()) + np.sqrt(weights) * shares * depths * error(len(balls))
    centres *= (likely / depths)[:, None]
    height, width = balls[0].shape
    origin = np.array(((width - 1) / 2, (height - 1) / 2, 1.0)) @ ray_basis(matrix) * plane
    starts, towards = [], []
    for centre, ball in zip(centres, balls, strict=True):
        normals, directions = reflect(centre, ball.points + PIXEL_ERROR * error(*ball.points.shape), matrix)
        starts.append(centre - origin + normals)
        towards.append(directions)
    points, miss = intersect_rays(np.array(starts), np.array(towards))
    pixel = plane / focal_length(matrix)  # in radii of the balls
    unit = 1 / pixel if diameter is None else diameter / 2
    return points * unit, pixel * unit, miss


def intersect_rays(starts: Doubles, directions: Doubles) -> tuple[Doubles, float]:
    """Return the points (F, 3) nearest to B rays each, and the mean square angle by which the rays miss them.

    The rays are (B, F, 3), B at least 2, with unit directions that have equal random errors. A NaN gives NaN.
    """
    usable = np.isfinite(directions).all(axis=(0, 2))
    points = np.full(starts.shape[1:], np.nan)
    starts, directions = starts[:, usable], directions[:, usable]
    # Projections across each ray: their sum is singular for parallel rays.
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    weights = np.ones(starts.shape[:2])
    # An error of direction counts in proportion to the distance, which is not known at first.
    for _ in range(3):
        weighted = across * weights[..., None, None]
        right_side = np.einsum("bfij,bfj->fi", weighted, starts)
        inverse = np.linalg.pinv(weighted.sum(axis=0), hermitian=True)
        nearest = np.einsum("fij,fj->fi", inverse, right_side)
        misses = np.einsum("bfij,bfj->bfi", across, nearest - starts)
        weights = np.maximum(np.linalg.norm(nearest - starts, axis=2), 1e-12) ** -2.0
    points[usable] = nearest
    return points, float((weights * np.square(misses).sum(axis=2)).mean()) if usable.any() else math.nan
