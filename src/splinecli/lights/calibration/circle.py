"""Find the outline of a ball as a circle in a mask or an image, with measures of its quality.

Coordinates are in pixels of the image: x right, y down, with integers at pixel centres and (0, 0)
at the top left pixel.
"""

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from splinecli.errors import InputError
from splinecli.maths import Array, Bools, Float32Array, Float64Array
from splinecli.maths.normals import unit

_ANGLES = np.arange(720) * (2 * np.pi / 720)
_RAYS = np.column_stack((np.cos(_ANGLES), np.sin(_ANGLES)))  # unit vectors
# Smallest visible share of an outline. A shorter arc may be the edge of another object.
_MIN_VISIBLE = 0.35
# Relative to the radius:
_SEARCH_BAND = 0.06  # distance to either side of the guess within which edges are searched
_TOLERANCE = 0.015  # largest distance of a point from a circle with which it agrees
_SAME = 0.03  # largest difference between equal circles in two images


@dataclass(frozen=True)
class Circle:
    """The outline of a ball."""

    x: float  # x, y and radius are in pixels. The defaults apply to a circle given by the user
    y: float
    radius: float
    spread: float = 0.0  # rms distance of the outline's points from the circle, in pixels
    visible: float = 1.0  # share of the outline that is visible in the image or mask, 0 to 1
    # (N, 2), points of the outline
    points: Float64Array | None = field(default=None, repr=False, compare=False)

    @property
    def outline(self) -> Float64Array:
        """The points (N, 2) of the outline near the circle. With a near camera, it is an
        ellipse.
        """
        if self.points is not None:
            return self.points[
                _distance(self.points, (self.x, self.y, self.radius)) < _SEARCH_BAND * self.radius
            ]
        return (self.x, self.y) + self.radius * _RAYS

    def normals(self, x: Float64Array, y: Float64Array) -> Float64Array:
        """Return the unit normals (N, 3) of the ball at image points in an orthographic view.

        They are NaN outside the circle.
        """
        nx, ny = (x - self.x) / self.radius, (self.y - y) / self.radius
        with np.errstate(invalid="ignore"):
            return np.stack((nx, ny, np.sqrt(1 - nx * nx - ny * ny)), axis=-1)

    def inside(self, shape: tuple[int, ...]) -> Bools:
        """Return the mask (H, W) of the pixels inside the circle."""
        y, x = np.indices(shape[:2])
        return np.asarray((x - self.x) ** 2 + (y - self.y) ** 2 < self.radius**2)

    def reaches_beyond(self, shape: tuple[int, ...]) -> bool:
        """Return whether at least a hundredth of the radius is outside the image."""
        reach = 0.99 * self.radius
        places = ((self.x, shape[1]), (self.y, shape[0]))
        return any(middle - reach < -0.5 or middle + reach > size - 0.5 for middle, size in places)


def circle_from_mask(mask: Bools) -> Circle:
    """Return the circle through most of the outline of the largest part of a mask (H, W).

    Raises InputError if the outline is not a circle.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=cv2.contourArea)[:, 0].astype(np.float64)
    height, width = mask.shape
    x, y = outline.T
    # Points at the border of the image are not part of the outline.
    outline = outline[(x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)]
    if len(outline) < 12:
        raise InputError("the mask has no outline inside the image, expected a ball")
    circle = _fit(outline, outline_points=len(outline))
    # The contour passes through the centres of the outermost pixels, so the ball extends half a
    # pixel further.
    outline = outline + 0.5 * unit(outline - (circle.x, circle.y))
    circle = replace(circle, radius=circle.radius + 0.5, points=outline)
    if circle.visible < _MIN_VISIBLE:
        raise InputError(
            f"only {100 * circle.visible:.0f} % of the mask's outline is on a circle, expected a"
            " ball",
            hint="Mark only the ball in the mask, or pass its circle with --circle X,Y,R",
        )
    return circle


def find_circles(image: Array) -> list[Circle]:
    """Return the clear circles in a gray image (H, W), the most likely ball first.

    Raises InputError if there are none.
    """
    values = _brightened(image)
    scale = 480 / max(values.shape)  # longer side of the image for the Hough transform
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(values, None, fx=scale, fy=scale, interpolation=interpolation)
    small = cv2.GaussianBlur(small, (0, 0), 1.5)
    refined = []
    for stretch in (1.0, 4.0):
        found = cv2.HoughCircles(
            (255 * (stretch * small).clip(0, 1)).astype(np.uint8),
            cv2.HOUGH_GRADIENT,
            dp=1.5,
            minDist=10,
            param1=40,
            param2=20,
            minRadius=round(0.08 * max(small.shape)),
            maxRadius=round(0.55 * max(small.shape)),
        )
        for x, y, radius in found[0, :12].tolist() if found is not None else ():
            # Pixel centres are at integers in both images, so corners are offset by half a pixel.
            guess = Circle((x + 0.5) / scale - 0.5, (y + 0.5) / scale - 0.5, radius / scale)
            refined.append(_refine(values, guess))
    circles = [circle for circle in refined if circle is not None]
    if not circles:
        hint = (
            "If these are images of a mirror ball, pass a mask of the ball with --mask, or its"
            " circle with --circle X,Y,R"
        )
        raise InputError("found no circle, expected a ball", hint=hint)
    # Reflections in the ball may also be circles, so the larger of two equally visible circles is
    # the ball.
    return sorted(circles, key=lambda each: -each.visible * math.sqrt(each.radius))


def is_in(image: Array, circle: Circle) -> bool:
    """Return whether a circle agrees with the edges in a gray image (H, W)."""
    found = _refine(_brightened(image), circle)
    if found is None:
        return False
    differences = found.x - circle.x, found.y - circle.y, found.radius - circle.radius
    return max(map(abs, differences)) < _SAME * circle.radius


def _brightened(image: Array) -> Float32Array:
    values = image.astype(np.float32)
    # In many images, a dark ball is in front of a dark background. Clipping the brightest 1 %
    # emphasises its edge.
    return np.asarray(np.sqrt(values / max(float(np.quantile(values, 0.99)), 1e-9)).clip(0, 1))


def _refine(values: Float32Array, guess: Circle) -> Circle | None:
    """Return the circle through the strongest edges along rays from the centre of a guess.

    Return None if too few edges agree.
    """
    for band in (_SEARCH_BAND, _SEARCH_BAND / 2):
        half = max(band * guess.radius, 3.0)
        steps = np.arange(guess.radius - half, guess.radius + half, 0.5)
        places = (guess.x, guess.y) + _RAYS[:, None] * steps[:, None]
        x, y = np.moveaxis(places.astype(np.float32), -1, 0)
        sampled = cv2.remap(
            values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
        )
        smooth = cv2.GaussianBlur(sampled, (9, 1), 2)
        edge = np.abs(smooth[:, 2:] - smooth[:, :-2])
        edge[~np.isfinite(edge)] = 0
        peak = edge[:, 1:-1].argmax(axis=1) + 1
        before, strength, after = (edge[np.arange(len(_RAYS)), peak + step] for step in (-1, 0, 1))
        # Sub-pixel position: the maximum of the parabola through the peak and its neighbours.
        bend = np.maximum(2 * strength - before - after, 1e-12)
        reach = steps[1] + 0.5 * (peak + ((after - before) / (2 * bend)).clip(-0.5, 0.5))
        clear = strength > 0.01  # weakest edge that is used
        if clear.sum() < 0.2 * len(_RAYS):
            return None
        points = ((guess.x, guess.y) + _RAYS * reach[:, None])[clear]
        guess = replace(_fit(points, outline_points=len(_RAYS)), points=points)
        if guess.visible < _MIN_VISIBLE:
            return None
    return guess


def _fit(points: Float64Array, *, outline_points: int) -> Circle:
    """Return the circle through most of the points (N, 2).

    RANSAC with samples of three points is followed by least squares over the points close to the
    circle. A complete outline would have `outline_points`.
    """
    generator, size = np.random.default_rng(0), np.ptp(points, axis=0).max()
    best: tuple[float, float, float] | None = None
    most = -1
    for _ in range(300):  # random triples of points
        (ax, ay), (bx, by), (cx, cy) = points[generator.choice(len(points), 3, replace=False)]
        twice_area = 2 * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
        if abs(twice_area) < 1e-9:
            continue
        b2, c2 = (bx - ax) ** 2 + (by - ay) ** 2, (cx - ax) ** 2 + (cy - ay) ** 2
        x, y = (
            ((cy - ay) * b2 - (by - ay) * c2) / twice_area,
            ((bx - ax) * c2 - (cx - ax) * b2) / twice_area,
        )
        circle = ax + x, ay + y, math.hypot(x, y)
        if 0.2 * size < circle[2] < 3 * size:
            agreeing = int(np.count_nonzero(_distance(points, circle) < _TOLERANCE * circle[2]))
            if agreeing > most:
                best, most = circle, agreeing
    if best is None:
        return Circle(0.0, 0.0, 1.0, math.inf, 0.0)
    for _ in range(5):
        close_by = points[_distance(points, best) < _TOLERANCE * best[2]]
        if len(close_by) < 3:
            break
        # x^2 + y^2 = 2 a x + 2 b y + c is linear in the centre (a, b). The points are centred for
        # accuracy.
        middle = close_by.mean(axis=0)
        around = close_by - middle
        terms = np.column_stack((2 * around, np.ones(len(around))))
        a, b, c = np.linalg.lstsq(terms, (around**2).sum(axis=1), rcond=None)[0]
        best = (float(middle[0] + a), float(middle[1] + b), math.sqrt(max(c + a * a + b * b, 1e-9)))
    distance = _distance(points, best)
    close = distance < _TOLERANCE * best[2]
    spread = math.sqrt(float((distance[close] ** 2).mean())) if close.any() else math.inf
    x, y, radius = (float(value) for value in best)
    return Circle(x, y, radius, spread, min(1.0, float(close.sum() / outline_points)))


def _distance(points: Float64Array, circle: tuple[float, float, float]) -> Float64Array:
    x, y, radius = circle
    return np.asarray(np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius))
