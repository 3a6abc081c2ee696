"""How strong the lights are, relative to each other, from photographs of something matte and of one gray."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.balls import BallFiles
from splinecli.calibration.circle import Circle, circle_from_mask
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.exposure import check_exposures
from splinecli.capture.formats.images import read_mask
from splinecli.capture.layouts.capture_files import AMBIENT, find_named
from splinecli.capture.linearise import Lineariser, RadiometricCalibration
from splinecli.capture.restore.saturation import find_saturated
from splinecli.errors import InputError

Target = Literal["ball", "card"]

STEEPEST = 0.35
"""Pixels count where n.l is above this: beside it a matte ball is seldom Lambertian."""

_FEWEST_PIXELS = 50


def light_strengths(
    files: BallFiles, light_directions: NDArray[np.float64], target: Target, *, gamma: float | None = 1.0
) -> NDArray[np.float64]:
    """Strengths (F, 3), RGB, whose mean is 1: the median of I / (n.l) over the target's pixels, by Lambert's law.

    Args:
        files: photographs of the target, one a light; its mask says where it is. A card may fill the picture. An image
            called `ambient` in their folder is taken off.
        light_directions: (F, 3), unit.
        target: a matte ball, or a matte card that faces the camera, normal (0, 0, 1).
        gamma: of the photographs' transfer curve, as in RadiometricCalibration.

    Raises:
        InputError: the numbers disagree, an image cannot be read, or a light leaves the target dark or overexposed.
    """
    if len(files.images) != len(light_directions):
        raise InputError(
            f"found {len(files.images)} images, expected {len(light_directions)}, one for each light",
            path=files.folder,
        )
    shape = decode_image(files.images[0]).shape[:2]
    mask = np.ones(shape, np.bool_) if files.mask is None else read_mask(files.mask)
    if mask.shape != shape:
        raise InputError("the mask's size is not the images'", path=files.mask)
    if target == "ball":
        if files.mask is None:
            raise InputError(
                "the photographs of the gray ball need a mask", path=files.folder, hint="Add one as mask.png"
            )
        circle = circle_from_mask(mask)
        mask &= Circle(circle.x, circle.y, 0.97 * circle.radius).inside(shape)
        y, x = np.nonzero(mask)
        normals = circle.normals(x.astype(np.float64), y.astype(np.float64))
    else:
        normals = np.broadcast_to(np.array((0.0, 0.0, 1.0)), (int(mask.sum()), 3))
    check_exposures(files.images)
    radiometry = RadiometricCalibration(gamma, find_named(files.folder, AMBIENT))
    linearise = Lineariser(radiometry, mask, len(files.images))
    strengths = [
        _strength(path, linearise, index, normals @ light)
        for index, (path, light) in enumerate(zip(files.images, light_directions, strict=True))
    ]
    relative: NDArray[np.float64] = np.array(strengths) / np.mean(strengths)
    return relative


def _strength(
    path: Path, linearise: Lineariser, index: int, cosine: NDArray[np.float64]
) -> NDArray[np.float64]:
    stored = decode_image(path)
    if stored.shape[:2] != linearise.mask.shape:
        raise InputError("the image is not of the others' size", path=path)
    pixels = stored[linearise.mask]
    usable = (cosine > STEEPEST) & ~find_saturated(pixels)
    values = linearise(pixels, path, index)[usable]
    ratio = (
        np.median(values / cosine[usable, None], axis=0) if usable.sum() >= _FEWEST_PIXELS else np.zeros(1)
    )
    if not (ratio > 0).all():
        raise InputError(
            "the target is dark or overexposed under this light, so its strength is not known",
            path=path,
            hint="Every light needs a photograph of the target, neither black nor saturated",
        )
    return np.broadcast_to(ratio, (3,)).astype(np.float64)
