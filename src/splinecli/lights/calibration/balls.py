"""Light directions from images of mirror balls, in one folder for each ball.

The light direction follows from the highlight of a lamp in the ball. At the highlight, the ball's
normal n is halfway between the light direction l and the direction v to the camera, so l = 2 (n.v)
n - v. A common mistake is to use n itself as the light direction. The camera is at the origin, and
the unit of length is the radius of the ball; x right, y up, z towards the camera.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splinecli.capture import files as capture_files
from splinecli.capture.formats.facts import ImageHeader, read_header
from splinecli.capture.formats.images import (
    ExpectedSize,
    decode_image,
    read_image,
    read_mask,
    to_linear,
)
from splinecli.capture.lamp_files import read_camera_matrix
from splinecli.capture.roles import choose_mask
from splinecli.errors import InputError
from splinecli.lights.calibration.circle import (
    Circle,
    circle_from_mask,
    find_circles,
    is_in,
)
from splinecli.maths import Array, Float32Array, Float64Array
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import ray_basis
from splinecli.maths.transfer import TransferCurve, decode_transfer
from splinecli.records.capture_warnings import CaptureWarning
from splinecli.system.progress import Progress, ignore

# focal length in pixels of a distant camera, whose rays are nearly parallel
DISTANT = 1e6
# shortest usual focal length, relative to the longer side of the image: 25 mm for 36 mm of film, as
# in telephones
SHORTEST_LENS = 0.7
# EXIF tags
_FOCAL_LENGTH, _WIDTH, _RESOLUTION, _UNIT, _FILM = (0x920A, 0xA002, 0xA20E, 0xA210, 0xA405)


@dataclass(frozen=True, eq=False)
class View:
    """The camera of a calibration."""

    matrix: Float64Array  # (3, 3) in pixels
    source: str  # "--camera-matrix", "EXIF" or "assumed distant"
    shortest: float  # the shortest usual focal length, in pixels

    @property
    def known(self) -> bool:
        return self.source != "assumed distant"

    def draw(self, generator: np.random.Generator) -> Float64Array:
        """Return a random camera matrix (3, 3) that is compatible with the known facts."""
        matrix = self.matrix.copy()
        if not self.known:
            # Uniform between parallel rays and the shortest usual lens.
            nearest = self.shortest / float(matrix[0, 0])
            matrix[:2, :2] *= nearest / generator.uniform(nearest, 1)
        elif self.source == "EXIF":
            # Focal lengths in EXIF have this standard deviation, because they are rounded and
            # focusing changes them.
            matrix[:2, :2] *= math.exp(0.05 * generator.normal())
        return matrix


def unit_rays(points: Float64Array, matrix: Float64Array) -> Float64Array:
    """Return unit vectors (N, 3) from a camera at the origin through image points (N, 2)."""
    return unit(np.column_stack((points, np.ones(len(points)))) @ ray_basis(matrix))


def find_view(image: ImageHeader, matrix: Path | None) -> View:
    """Return the camera described by a matrix file or an image's EXIF tags, or else a distant
    camera.

    Raises InputError if the file or the image cannot be read, or if the file does not contain a
    camera matrix.
    """
    height, width = image.size[0][:2]
    shortest = SHORTEST_LENS * max(width, height)
    if matrix is not None:
        return View(read_camera_matrix(matrix), "--camera-matrix", shortest)
    found = _focal_length(image.exif or {}, width, height)
    focal = found or DISTANT
    given = np.array(((focal, 0, (width - 1) / 2), (0, focal, (height - 1) / 2), (0, 0, 1.0)))
    return View(given, "assumed distant" if found is None else "EXIF", shortest)


def _focal_length(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """Return the focal length in pixels from EXIF tags, or None if it is missing."""
    millimetres = {2: 25.4, 3: 10.0}  # in an inch and a centimetre, by EXIF's codes of units
    try:
        if tags.get(_RESOLUTION) and tags.get(_FOCAL_LENGTH) and tags.get(_UNIT, 2) in millimetres:
            pixels = float(tags[_FOCAL_LENGTH]) * float(tags[_RESOLUTION])
            pixels /= millimetres[tags.get(_UNIT, 2)]
            pixels *= width / float(tags.get(_WIDTH) or width)  # in case the picture was scaled
        else:
            pixels = float(tags[_FILM]) / math.hypot(36, 24) * math.hypot(width, height)
    except Exception:  # damaged tags raise a dozen types of errors
        return None
    return pixels if SHORTEST_LENS / 3 * width < pixels < DISTANT else None


# A highlight is the patch above this share of its brightest value, after a slight blur.
_HIGHLIGHT_LEVEL = 0.7


@dataclass(frozen=True)
class Highlight:
    """The image of a lamp in a mirror ball."""

    x: float  # position of the centroid, in pixels of the image
    y: float
    saturated: float  # share of saturated pixels, 0 to 1
    # (2, 2), the covariance of x and y over its patch, in square pixels
    shape: Float64Array = field(repr=False, compare=False)


def find_highlight(
    image: Array,
    circle: Circle,
    *,
    full_scale: float | None = None,
    curve: TransferCurve = 1.0,
) -> Highlight:
    """Return the highlight of the lamp in the ball, located at the centroid of its brightest patch.

    Raises InputError if the ball shows no highlight, or if its brightest patch is too wide for a
    lamp.

    Args:
        image: (H, W), stored gray values.
        curve: their transfer curve. It is reversed to compare the highlight with the rest of the
            ball.
        full_scale: the value at which pixels saturate. None for images that do not saturate.
    """
    inside = circle.inside(image.shape)
    values = np.where(inside, image, 0).astype(np.float32)
    # The blur removes single bright pixels, which are dust or noise.
    smooth = cv2.GaussianBlur(values, (0, 0), max(0.8, circle.radius / 200)) * inside
    brightest = float(smooth.max())
    levels = np.array((brightest, np.median(values[inside])), np.float32)
    lamp, median = decode_transfer(levels, curve)
    if lamp <= 4.0 * median or lamp <= 0:
        raise InputError(
            "found no highlight in the ball",
            hint="If these are images of a mirror ball, take them with all other lights off, so"
            " that the lamp is by far the brightest spot in the ball",
        )
    _, labels = cv2.connectedComponents((smooth >= _HIGHLIGHT_LEVEL * brightest).astype(np.uint8))
    # Of several patches, choose the one with the most light rather than the brightest pixel.
    light = np.bincount(labels.ravel(), weights=smooth.ravel())
    light[0] = 0
    core = labels == light.argmax()
    y, x = np.nonzero(core)
    width = max(np.ptp(x), np.ptp(y))
    if width > 0.3 * 2 * circle.radius:  # such as a window or an overexposed ball
        raise InputError(
            f"the brightest patch in the ball is {width} pixels wide, too wide for a lamp",
            hint="Shorten the exposure, or cover windows and bright walls",
        )
    # In a saturated highlight, all weights are nearly equal, so this is the centroid of its shape.
    weight = smooth[core].astype(np.float64) - 0.9 * _HIGHLIGHT_LEVEL * brightest
    saturated = float((values[core] >= full_scale).mean()) if full_scale is not None else 0.0
    x_centre, y_centre = (float(np.average(axis, weights=weight)) for axis in (x, y))
    shape = np.cov(x, y, ddof=0, aweights=weight)
    return Highlight(x_centre, y_centre, saturated, shape)


def ball_centre(outline: Float64Array, matrix: Float64Array) -> Float64Array:
    """Return the centre (3,) of a ball whose outline is at these image points (N, 2) of a camera.

    Rays d that touch the ball, |d| = 1, form a cone: d.c = sqrt(|c|^2 - 1). For m = c / sqrt(|c|^2
    - 1), this is linear. Written in terms of m_z + 1, it is also exact for a distant camera.
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


def reflect(
    centre: Float64Array, highlights: Float64Array, matrix: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return normals and light directions (F, 3) at the highlights (F, 2) of a ball, NaN outside
    the ball.
    """
    rays = unit_rays(highlights, matrix)
    across = centre - (rays @ centre)[:, None] * rays
    with np.errstate(invalid="ignore"):
        normals = -across - np.sqrt(1 - np.square(across).sum(axis=1, keepdims=True)) * rays
    return normals, rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals


REFERENCES = ("ref", "reference")
"""Names, without suffix, of an additional image that shows the outline of the ball."""


@dataclass(frozen=True, eq=False)
class BallFiles:
    """The files of one ball."""

    folder: Path
    images: tuple[Path, ...]  # one image for each light, in the order of the lights
    reference: Path | None  # an image that shows the outline of the ball, or None
    mask: Path | None
    warnings: tuple[CaptureWarning, ...] = ()  # report how the mask was chosen

    @cached_property
    def facts(self) -> tuple[ImageHeader, ...]:
        """Facts from the headers of the images."""
        return tuple(map(read_header, self.images))


@dataclass(frozen=True, eq=False)
class BallCalibration:
    """The light directions from F images of one ball."""

    files: BallFiles
    circle: Circle
    circle_from: str  # the source of the outline: "--circle", "mask" or "picture"
    highlights: tuple[Highlight, ...]  # (F,), one for each image
    directions: Float64Array  # (F, 3) float64, unit vectors; x right, y up, z to the camera
    # (F, 3), normals of the ball at the highlights, halfway between the view and the lights
    normals: Float64Array
    view: View
    shape: tuple[int, ...]  # (H, W) of the images
    doubt: str | None = None  # why the outline may not belong to a mirror ball

    @property
    def points(self) -> Float64Array:
        """The highlights (F, 2) in the image."""
        return np.array([(highlight.x, highlight.y) for highlight in self.highlights])


class NoHighlightError(InputError):
    """An image of a ball has no usable highlight. `ball` contains the highlights of earlier
    images.
    """

    def __init__(self, error: InputError, path: Path, ball: BallCalibration) -> None:
        super().__init__(error.problem, path=path, hint=error.hint)
        self.ball = ball


@dataclass(frozen=True, eq=False)
class CalibratedLights:
    """The light directions from one or more balls."""

    balls: tuple[BallCalibration, ...]
    directions: Float64Array  # (F, 3) float64, unit vectors, the mean over the balls
    # (F,), largest angle between a ball's direction and the mean; 0 for one ball
    disagreement_deg: Float64Array


def find_ball_files(folder: Path, mask: Path | None = None) -> BallFiles:
    """Return the files of the ball in a folder.

    The images are in natural order or in the order of filenames.txt. If `mask` is given, it is used
    instead of the one in the folder. Raises InputError if the folder contains no images.
    """
    not_lights, leave_out = (
        capture_files.NOT_PHOTOGRAPHS | set(REFERENCES),
        () if mask is None else (mask,),
    )
    images, _ = capture_files.find_images(folder, leave_out_stems=not_lights, leave_out=leave_out)
    others = capture_files.list_images(folder, leave_out_stems=(), leave_out=images)
    reference = next((path for path in others if path.stem.lower() in REFERENCES), None)
    mask = mask or capture_files.find_named(folder, capture_files.MASK)
    warnings: tuple[CaptureWarning, ...] = ()
    if mask is None:
        mask, warnings = choose_mask(folder, images)
    return BallFiles(folder, images, reference, mask, warnings)


def calibrate_ball(
    files: BallFiles,
    circle: Circle | None = None,
    camera_matrix: Path | None = None,
    progress: Progress = ignore,
) -> BallCalibration:
    """Return the outline, the highlights and the light directions of one ball.

    Only one image is in memory at a time.

    Args:
        circle: the outline. By default, it is taken from the mask, the reference image, or the mean
            of all images, in this order.
        camera_matrix: a file. By default, the camera is taken from EXIF or assumed to be distant
            (see find_view).

    Raises:
        NoHighlightError: an image shows no highlight of a lamp in front of the ball.
        InputError: an image cannot be read or has another size; or the outline is not found or not
            entirely inside the image.
    """
    circles, circle_from = _find_outline(files) if circle is None else ([circle], "--circle")
    circle = circles[0]
    view = find_view(files.facts[0], camera_matrix)
    centre = ball_centre(circle.outline, view.matrix)
    highlights: list[Highlight] = []
    normals, directions = np.empty((2, len(files.images), 3))
    n_agreeing = n_uniform = 0
    shape = files.facts[0].size[0][:2]

    def result(doubt: str | None = None) -> BallCalibration:
        n = len(highlights)
        found = (tuple(highlights), directions[:n], normals[:n])
        return BallCalibration(files, circle, circle_from, *found, view, shape, doubt)

    for number, (path, facts) in enumerate(zip(files.images, files.facts, strict=True)):
        stored = decode_image(path, ExpectedSize(shape, files.images[0].name))
        if not circle.inside(shape).any():
            raise InputError(
                "the circle is outside the image", path=path, hint="Pass --circle X,Y,R in pixels"
            )
        full_scale = 1.0 if stored.dtype.kind == "u" else None
        gray = to_linear(stored, path).mean(axis=2)
        try:
            highlight = find_highlight(gray, circle, full_scale=full_scale, curve=facts.curve.curve)
            point = np.array([(highlight.x, highlight.y)])
            normals[[number]], directions[[number]] = reflect(centre, point, view.matrix)
            if not directions[number] @ unit_rays(point, view.matrix)[0] < 0:
                raise InputError(
                    "the highlight is near the rim of the ball, so the lamp is level with the ball"
                    " or behind it",
                    hint="Place all lights on the camera's side of the object",
                )
        except InputError as error:
            raise NoHighlightError(error, path, result()) from None
        if circle_from == "picture":
            n_agreeing += is_in(gray, circle)
            n_uniform += _is_uniform(gray, circle)
        highlights.append(highlight)
        progress(1)
    if circle_from != "picture":
        return result()
    doubt = _doubt(circles, result().points, n_agreeing)
    if doubt is None and 2 * n_uniform > len(highlights) and _keep_shape(highlights, circle):
        doubt = (
            "it is evenly bright, and the highlight is as round near the edge as in the middle, as"
            " on a flat disc"
        )
    return result(doubt)


_LEAST_VISIBLE = 0.6  # share of the outline of a ball that is found in a picture
_SMALLER = 0.8  # largest radius of another circle that may be the ball, relative to the first
_CLEAR = 0.7  # smallest visible share of the outline of such a circle
_LEAST_MOTION = 0.02  # median distance of highlights from their median, relative to the radius


def _doubt(circles: Sequence[Circle], highlights: Float64Array, n_agreeing: int) -> str | None:
    """Return a reason why the first circle may not be the outline of a mirror ball, or None.

    The circles were found in a picture, and the highlights are (F, 2).
    """
    ball, n_images = circles[0], len(highlights)
    if ball.visible < _LEAST_VISIBLE:
        return f"the image has edges along only {100 * ball.visible:.0f} % of the circle"
    if 2 * n_agreeing < n_images:
        return f"only {n_agreeing} of {n_images} images show the circle"
    for other in circles[1:]:
        around = np.hypot(*(highlights - (other.x, other.y)).T).max() < other.radius
        if around and other.radius < _SMALLER * ball.radius and other.visible > _CLEAR:
            return (
                f"a smaller circle (centre {other.x:.0f}, {other.y:.0f}, radius"
                f" {other.radius:.0f} pixels) is also clear and contains all highlights"
            )
    moved = np.hypot(*(highlights - np.median(highlights, axis=0)).T)
    if n_images > 2 and np.median(moved) < _LEAST_MOTION * ball.radius:
        return "the highlight does not move in most images"
    return None


# Interquartile range of the brightness of a uniform disc, relative to the median; above 1 in
# photographs of mirror balls, which reflect the room
_UNIFORM = 0.1
_FORESHORTENED = 0.25  # share of a mirror ball's foreshortening below which highlights have none
# smallest rms logarithm of the foreshortening, and width (standard deviation in pixels), at which
# it is measured
_MEASURABLE, _LEAST_WIDTH = 0.05, 2.0


def _is_uniform(image: Array, circle: Circle) -> bool:
    """Return whether a circle inside an image (H, W) is evenly bright, except for highlights."""
    across, half = (np.arange(32) - 15.5) / 16, math.ceil(circle.radius)
    left, top = max(0, round(circle.x) - half), max(0, round(circle.y) - half)
    cut = image[top : top + 2 * half + 1, left : left + 2 * half + 1].astype(np.float32)
    values = cv2.resize(cut, (32, 32), interpolation=cv2.INTER_AREA)
    quarter, median, other = np.quantile(
        values[np.hypot(across, across[:, None]) < 0.9], (0.25, 0.5, 0.75)
    )
    return bool(other - quarter < _UNIFORM * median)


def _keep_shape(highlights: Sequence[Highlight], circle: Circle) -> bool:
    """Return whether highlights keep their shape towards the edge, as on a flat disc.

    At a distance of r radii from the middle, a mirror ball foreshortens the image of a lamp by
    1 - r^2 along the radius, relative to its width; a brushed one, by the square root. False if the
    highlights are too small or too close to the middle for this to be measured.
    """
    from_middle = np.array([(each.x, each.y) for each in highlights]) - (circle.x, circle.y)
    distance = np.hypot(*from_middle.T)
    along = from_middle / np.maximum(distance, 1e-9)[:, None]
    across = along[:, ::-1] * (1, -1)
    shapes = np.array([each.shape for each in highlights])
    length, width = (
        np.sqrt(np.maximum(np.einsum("fi,fij,fj->f", axis, shapes, axis), 1e-9))
        for axis in (along, across)
    )
    expected = np.log(1 - np.square(distance / circle.radius).clip(0, 0.99))
    power = float(np.square(expected).mean())
    found = float((expected * np.log(length / width)).mean())
    measurable = math.sqrt(power) > _MEASURABLE and float(np.median(width)) > _LEAST_WIDTH
    return measurable and found < _FORESHORTENED * power


def combine_balls(balls: Sequence[BallCalibration]) -> CalibratedLights:
    """Return the mean light directions over the balls. Raises InputError if the numbers of images
    differ.
    """
    if len({len(ball.directions) for ball in balls}) > 1:
        counts = ", ".join(f"{len(ball.directions)} images ({ball.files.folder})" for ball in balls)
        raise InputError(
            f"the balls have {counts}",
            hint="Take one image of every ball for each light, in the same order",
        )
    stacked = np.stack([ball.directions for ball in balls])
    directions = unit(stacked.sum(axis=0))
    disagreement = np.stack([angle_between_deg(own, directions) for own in stacked]).max(axis=0)
    return CalibratedLights(tuple(balls), directions, np.where(len(balls) > 1, disagreement, 0.0))


def _find_outline(files: BallFiles) -> tuple[list[Circle], str]:
    """Return the circles that may be the outline of the ball, most likely first, and their source.

    The source is "mask" or "picture".
    """
    path = files.mask or files.reference or files.images[0]
    try:
        if files.mask is not None:
            expected = ExpectedSize(files.facts[0].size[0], files.images[0].name, "a mask")
            mask = read_mask(files.mask, expected)
            circles, source, shape = [circle_from_mask(mask)], "mask", mask.shape
        else:
            first, *others = files.images if files.reference is None else [files.reference]
            gray: Float32Array = read_image(first).mean(axis=2)
            for image in others:
                gray = gray + read_image(image, ExpectedSize(gray.shape, first.name)).mean(axis=2)
            gray = gray / np.float32(1 + len(others))
            circles, source, shape = find_circles(gray), "picture", gray.shape
    except InputError as error:
        raise InputError(error.problem, path=error.path or path, hint=error.hint) from None
    circle = circles[0]
    if circle.reaches_beyond(shape):
        ball = (
            f"the ball (centre {circle.x:.0f}, {circle.y:.0f}, radius {circle.radius:.0f} pixels)"
        )
        raise InputError(
            f"{ball} is not entirely inside the image",
            path=path,
            hint="Take images of the whole ball; if this is not the ball, pass its circle with"
            " --circle X,Y,R",
        )
    return circles, source
