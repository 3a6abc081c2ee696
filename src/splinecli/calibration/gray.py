"""Light intensities, relative to each other, from images of a matte gray target."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.calibration.balls import BallFiles
from splinecli.calibration.circle import Circle, circle_from_mask
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.exposure import check_exposures
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.formats.images import read_mask
from splinecli.capture.layouts.capture_files import AMBIENT, find_named
from splinecli.capture.linearise import Lineariser, RadiometricCalibration
from splinecli.capture.restore.saturation import find_saturated
from splinecli.errors import InputError

Target = Literal["ball", "card"]

SMALLEST_COSINE = 0.35
"""Only pixels with n.l above this are used. Closer to grazing light, a matte ball is seldom Lambertian."""

_MIN_PIXELS = 50
_USED_RADIUS = 0.97  # of a ball: pixels at the rim mix it with the background


def measure_light_intensities(
    files: BallFiles, light_directions: NDArray[np.float64], target: Target, *, gamma: float | None = 1.0
) -> NDArray[np.float64]:
    """Return light intensities (F, 3), RGB, with mean 1, from images of a gray target.

    By Lambert's law, each is the median of I / (n.l) over the pixels of the target.

    Args:
        files: one image of the target for each light, and a mask of the target. A card without a mask fills the image.
            An image called `ambient` in the folder is subtracted.
        light_directions: (F, 3), unit vectors.
        target: a matte ball, or a matte card that faces the camera, with the normal (0, 0, 1).
        gamma: transfer curve of the images, as in RadiometricCalibration.

    Raises:
        InputError: the numbers of images and lights differ, an image cannot be read or has another size, or the target
            is dark or saturated under a light.
    """
    if len(files.images) != len(light_directions):
        raise InputError(
            f"found {len(files.images)} images, expected {len(light_directions)}, one for each light",
            path=files.folder,
        )
    shape = decode_image(files.images[0]).shape[:2]
    mask, normals = _target_normals(files, shape, target)
    check_exposures(files.images)
    radiometry = RadiometricCalibration(gamma, find_named(files.folder, AMBIENT))
    linearise = Lineariser(radiometry, mask, len(files.images))
    intensities = [
        _intensity(path, linearise, index, normals @ light, files.images[0])
        for index, (path, light) in enumerate(zip(files.images, light_directions, strict=True))
    ]
    relative: NDArray[np.float64] = np.array(intensities) / np.mean(intensities)
    return relative


def _target_normals(
    files: BallFiles, shape: tuple[int, ...], target: Target
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return the mask (H, W) of the target and the normals (P, 3) of its pixels."""
    mask = (
        np.ones(shape, np.bool_)
        if files.mask is None
        else read_mask(files.mask, ExpectedSize(shape, files.images[0].name, "a mask"))
    )
    if target == "card":
        return mask, np.broadcast_to(np.array((0.0, 0.0, 1.0)), (int(mask.sum()), 3))
    if files.mask is None:
        raise InputError(
            "the images of the gray ball need a mask", path=files.folder, hint="Add one as mask.png"
        )
    circle = circle_from_mask(mask)
    mask &= Circle(circle.x, circle.y, _USED_RADIUS * circle.radius).inside(shape)
    y, x = np.nonzero(mask)
    return mask, circle.normals(x.astype(np.float64), y.astype(np.float64))


def _intensity(
    path: Path, linearise: Lineariser, index: int, cosine: NDArray[np.float64], first: Path
) -> NDArray[np.float64]:
    """Return the intensity (3,) of the light of one image; cosine (P,) is n.l at the pixels of the mask."""
    stored = decode_image(path, ExpectedSize(linearise.mask.shape, first.name))
    pixels = stored[linearise.mask]
    usable = (cosine > SMALLEST_COSINE) & ~find_saturated(pixels)
    values = linearise(pixels, path, index)[usable]
    ratio = np.median(values / cosine[usable, None], axis=0) if usable.sum() >= _MIN_PIXELS else np.zeros(1)
    if not (ratio > 0).all():
        raise InputError(
            "the target is dark or overexposed under this light, so the light's intensity is unknown",
            path=path,
            hint="Every light needs an image of the target that is neither black nor saturated",
        )
    return np.broadcast_to(ratio, (3,)).astype(np.float64)
