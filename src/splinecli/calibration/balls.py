"""Light directions from folders of images of mirror balls."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from splinecli.calibration.circle import Circle, circle_from_mask, find_circle
from splinecli.calibration.mirror_ball import Highlight, ball_centre, check_in_front, find_highlight, reflect
from splinecli.calibration.view import View, find_view, unit_rays
from splinecli.capture.formats.facts import ImageFacts, read_facts
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.formats.images import decode_image, read_image, read_mask, to_linear
from splinecli.capture.layouts.capture_files import MASK, NOT_PHOTOGRAPHS, find_images, find_named, list_images
from splinecli.capture.source import Progress
from splinecli.errors import InputError
from splinecli.maths import Doubles, Singles
from splinecli.maths.normals import angle_between_deg, unit

REFERENCES = ("ref", "reference")
"""Names, without suffix, of an image that shows the outline of the ball and belongs to no light."""

_NOT_LIGHTS = NOT_PHOTOGRAPHS | set(REFERENCES)


@dataclass(frozen=True, eq=False)
class BallFiles:
    """The files of one ball."""

    folder: Path
    images: tuple[Path, ...]  # one image for each light, in the order of the lights
    reference: Path | None  # an image that shows the outline of the ball, or None
    mask: Path | None

    @cached_property
    def facts(self) -> tuple[ImageFacts, ...]:
        """What the headers of the images state."""
        return tuple(map(read_facts, self.images))


@dataclass(frozen=True, eq=False)
class BallCalibration:
    """The light directions from F images of one ball."""

    files: BallFiles
    circle: Circle
    circle_from: str  # the source of the outline: "--circle", "mask" or "picture"
    highlights: tuple[Highlight, ...]  # (F,), one for each image
    directions: Doubles  # (F, 3) float64, unit vectors; x right, y up, z to the camera
    normals: Doubles  # (F, 3), of the ball at the highlights, half-way between the view and the lights
    view: View
    shape: tuple[int, ...]  # (H, W) of the images

    @property
    def points(self) -> Doubles:
        """The highlights (F, 2) in the image."""
        return np.array([(highlight.x, highlight.y) for highlight in self.highlights])


@dataclass(frozen=True, eq=False)
class CalibratedLights:
    """The light directions from one or several balls."""

    balls: tuple[BallCalibration, ...]
    directions: Doubles  # (F, 3) float64, unit vectors: the mean direction of the balls
    disagreement_deg: Doubles  # (F,), largest angle between a ball's direction and the mean; 0 for one ball


def find_ball_files(folder: Path, *, mask: Path | None = None) -> BallFiles:
    """Return the files of the ball in a folder, with images in natural order or in that of filenames.txt.

    A mask that is given replaces the one in the folder. Raises InputError where there are no images.
    """
    images, _ = find_images(folder, leave_out_stems=_NOT_LIGHTS, leave_out=() if mask is None else (mask,))
    others = list_images(folder, leave_out_stems=(), leave_out=images)
    reference = next((path for path in others if path.stem.lower() in REFERENCES), None)
    return BallFiles(folder, images, reference, mask or find_named(folder, MASK))


def calibrate_ball(
    files: BallFiles,
    *,
    circle: Circle | None = None,
    camera_matrix: Path | None = None,
    progress: Progress = lambda: None,
) -> BallCalibration:
    """Find the outline, the highlights and the light directions of one ball. Only one image is in memory at a time.

    Args:
        circle: the outline. None takes it from the mask, from the reference image, or from the mean of all images, in
            this order.
        camera_matrix: a file; None takes the camera from EXIF, or as distant (see find_view).

    Raises:
        InputError: an image cannot be read, has another size or shows no highlight; or the outline is not found or
            not entirely inside the image.
    """
    circle_from = "--circle"
    if circle is None:
        circle, circle_from = _find_outline(files)
    view = find_view(files.facts[0], camera_matrix)
    centre = ball_centre(circle.outline, view.matrix)
    highlights, normals, directions = [], [], []
    shape = files.facts[0].size[0][:2]
    expected = ExpectedSize(shape, files.images[0].name)
    for path in files.images:
        stored = decode_image(path, expected)
        if not circle.inside(shape).any():
            raise InputError("the circle lies outside the image", path=path, hint="--circle is X,Y,R in pixels")
        try:
            full_scale = 1.0 if stored.dtype.kind == "u" else None
            highlight = find_highlight(to_linear(stored, path).mean(axis=2), circle, full_scale=full_scale)
            point = np.array([(highlight.x, highlight.y)])
            normal, direction = reflect(centre, point, view.matrix)
            check_in_front(direction[0], unit_rays(point, view.matrix)[0])
        except InputError as error:
            raise InputError(error.problem, path=path, hint=error.hint) from None
        highlights.append(highlight)
        normals.append(normal[0])
        directions.append(direction[0])
        progress()
    return BallCalibration(
        files, circle, circle_from, tuple(highlights), np.array(directions), np.array(normals), view, shape
    )


def combine_balls(balls: Sequence[BallCalibration]) -> CalibratedLights:
    """Return the mean direction of each light over the balls. Raises InputError for unequal numbers of images."""
    if len({len(ball.directions) for ball in balls}) > 1:
        counts = ", ".join(f"{len(ball.directions)} images ({ball.files.folder})" for ball in balls)
        hint = "Every ball needs one image for each light, in the same order"
        raise InputError(f"the balls have {counts}", hint=hint)
    stacked = np.stack([ball.directions for ball in balls])
    directions = unit(stacked.sum(axis=0))
    disagreement = np.stack([angle_between_deg(own, directions) for own in stacked]).max(axis=0)
    return CalibratedLights(tuple(balls), directions, np.where(len(balls) > 1, disagreement, 0.0))


def _find_outline(files: BallFiles) -> tuple[Circle, str]:
    """Return the outline of the ball and its source: "mask" or "picture"."""
    path = files.mask or files.reference or files.images[0]
    try:
        if files.mask is not None:
            expected = ExpectedSize(files.facts[0].size[0], files.images[0].name, "a mask")
            mask = read_mask(files.mask, expected)
            circle, source, shape = circle_from_mask(mask), "mask", mask.shape
        else:
            gray = _mean_gray(files.images if files.reference is None else [files.reference])
            circle, source, shape = find_circle(gray), "picture", gray.shape
    except InputError as error:
        raise InputError(error.problem, path=error.path or path, hint=error.hint) from None
    if circle.reaches_beyond(shape):
        raise InputError(
            f"the ball (centre {circle.x:.0f}, {circle.y:.0f}, radius {circle.radius:.0f} pixels) is not entirely"
            " inside the image",
            path=path,
            hint="Take images of the whole ball; if this is not the ball, give its circle with --circle X,Y,R",
        )
    return circle, source


def _mean_gray(images: Sequence[Path]) -> Singles:
    total: Singles = read_image(images[0]).mean(axis=2)
    expected = ExpectedSize(total.shape, images[0].name)
    for path in images[1:]:
        total = total + read_image(path, expected).mean(axis=2)
    return total / np.float32(len(images))
