"""Photographs of mirror balls, one folder a ball -> one light direction for each photograph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.circle import Circle, circle_from_mask, find_circle
from splinecli.calibration.mirror_ball import Highlight, find_highlight, light_direction
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.images import read_mask, to_linear
from splinecli.capture.layouts.capture_files import FILENAMES, MASK, NOT_PHOTOGRAPHS, find_named
from splinecli.capture.layouts.image_lists import check_not_empty, list_images, read_image_list
from splinecli.errors import InputError
from splinecli.normals import angle_between_deg, unit

REFERENCES = ("ref", "reference")
"""Stems of a picture that shows a ball's outline and is no photograph of a light."""

_NO_LIGHTS = NOT_PHOTOGRAPHS | set(REFERENCES)


@dataclass(frozen=True, eq=False)
class BallFiles:
    """A folder's photographs of a ball, one a light, and what shows its outline."""

    folder: Path
    images: tuple[Path, ...]
    reference: Path | None
    mask: Path | None


@dataclass(frozen=True, eq=False)
class BallCalibration:
    """What F photographs of a ball say.

    Args:
        files: of the ball.
        circle: its outline; circle_from: "--circle", "mask" or "picture", whence it is known.
        highlights: (F,).
        directions: (F, 3) float64, unit; x right, y up, z to the camera.
    """

    files: BallFiles
    circle: Circle
    circle_from: str
    highlights: tuple[Highlight, ...]
    directions: NDArray[np.float64]

    @property
    def normals(self) -> NDArray[np.float64]:
        """The ball's own normals (F, 3) at the highlights, half way from the view to the lights."""
        return unit(self.directions + np.array((0.0, 0.0, 1.0)))


@dataclass(frozen=True, eq=False)
class CalibratedLights:
    """The lights of one or several balls.

    Args:
        directions: (F, 3) float64, unit: the mean of the balls.
        disagreement_deg: (F,) float64, the largest angle between a ball's direction and the mean; zero for one ball.
    """

    balls: tuple[BallCalibration, ...]
    directions: NDArray[np.float64]
    disagreement_deg: NDArray[np.float64]


def find_ball_files(folder: Path, *, mask: Path | None = None) -> BallFiles:
    """A ball's photographs in natural order, or in that of filenames.txt. Raises InputError."""
    filenames = find_named(folder, [FILENAMES])
    images = (
        read_image_list(filenames)
        if filenames is not None
        else list_images(folder, leave_out_stems=_NO_LIGHTS, leave_out=() if mask is None else (mask,))
    )
    check_not_empty(images, folder)
    others = list_images(folder, leave_out_stems=(), leave_out=images)
    reference = next((path for path in others if path.stem.lower() in REFERENCES), None)
    return BallFiles(folder, images, reference, mask or find_named(folder, MASK))


def calibrate_ball(
    files: BallFiles, *, circle: Circle | None = None, progress: Callable[[], object] | None = None
) -> BallCalibration:
    """Outline, highlights and light directions of one ball; one photograph is held at a time.

    Args:
        circle: the outline, where it is known. Else it comes from the mask, or is looked for in the reference picture,
            or in the mean of the photographs.

    Raises:
        InputError: with the file: an image cannot be read or is of another size, there is no circle, or it is cut off
            by the frame, or a photograph shows no highlight.
    """
    circle_from = "--circle"
    if circle is None:
        circle, circle_from = _find_outline(files)
    highlights, directions = [], []
    first: tuple[int, ...] | None = None
    for path in files.images:
        stored = decode_image(path)
        first = first or stored.shape[:2]
        if stored.shape[:2] != first:
            raise InputError(
                f"found an image of {stored.shape[1]} x {stored.shape[0]} pixels, expected {first[1]} x {first[0]}"
                f" as in {files.images[0].name}",
                path=path,
            )
        if not circle.inside(first).any():
            raise InputError(
                "the circle lies outside the picture", path=path, hint="--circle is X,Y,R in pixels"
            )
        try:
            highlight = find_highlight(
                to_linear(stored, path).mean(axis=2),
                circle,
                full_scale=1.0 if stored.dtype.kind == "u" else None,
            )
            directions.append(light_direction(circle, highlight))
        except InputError as error:
            raise InputError(error.problem, path=path, hint=error.hint) from None
        highlights.append(highlight)
        if progress is not None:
            progress()
    return BallCalibration(files, circle, circle_from, tuple(highlights), np.array(directions))


def combine_balls(balls: Sequence[BallCalibration]) -> CalibratedLights:
    """The mean direction of each light over the balls. Raises InputError where they have not equally many images."""
    counts = [len(ball.directions) for ball in balls]
    if len(set(counts)) > 1:
        raise InputError(
            "the balls have "
            + ", ".join(f"{n} images ({b.files.folder})" for n, b in zip(counts, balls, strict=True)),
            hint="Every ball needs one image for each light, in the same order",
        )
    stacked = np.stack([ball.directions for ball in balls])
    directions = unit(stacked.sum(axis=0))
    disagreement = np.stack([angle_between_deg(own, directions) for own in stacked]).max(axis=0)
    return CalibratedLights(tuple(balls), directions, np.where(len(balls) > 1, disagreement, 0.0))


def _find_outline(files: BallFiles) -> tuple[Circle, str]:
    if files.mask is not None:
        mask = read_mask(files.mask)
        try:
            circle, where = circle_from_mask(mask), "mask"
        except InputError as error:
            raise InputError(error.problem, path=files.mask, hint=error.hint) from None
        shape, path = mask.shape, files.mask
    else:
        path = files.reference or files.images[0]
        if files.reference is not None:
            picture = to_linear(decode_image(path), path).mean(axis=2)
        else:
            picture = _mean_picture(files.images)
        try:
            circle, where = find_circle(picture), "picture"
        except InputError as error:
            raise InputError(error.problem, path=path, hint=error.hint) from None
        shape = picture.shape
    if circle.reaches_beyond(shape):
        raise InputError(
            f"the ball (centre {circle.x:.0f}, {circle.y:.0f}, radius {circle.radius:.0f} pixels) is cut off by the"
            " frame",
            path=path,
            hint="Photograph it whole; if this is not the ball, give its circle by --circle X,Y,R",
        )
    return circle, where


def _mean_picture(images: Sequence[Path]) -> NDArray[np.float32]:
    total: NDArray[np.float32] | None = None
    for path in images:
        picture = to_linear(decode_image(path), path).mean(axis=2)
        if total is not None and total.shape != picture.shape:
            raise InputError(
                f"found an image of {picture.shape[1]} x {picture.shape[0]} pixels,"
                f" expected {total.shape[1]} x {total.shape[0]} as in {images[0].name}",
                path=path,
            )
        total = picture if total is None else total + picture
    assert total is not None
    return total / np.float32(len(images))
