"""Light intensities, relative to each other, from images of a matte gray target."""

from dataclasses import replace
from typing import Literal

import numpy as np

from splinecli.calibration.balls import BallFiles
from splinecli.calibration.circle import Circle, circle_from_mask
from splinecli.capture.formats.exif import check_exposures
from splinecli.capture.formats.image_size import ExpectedSize, common_size
from splinecli.capture.formats.images import read_mask
from splinecli.capture.layouts.capture_files import AMBIENT, CaptureFiles, find_named
from splinecli.capture.linearise import AS_STORED, RadiometricCalibration
from splinecli.capture.restore.white_level import Saturation
from splinecli.capture.source import CaptureSource
from splinecli.errors import InputError
from splinecli.maths import Bools, Doubles

Target = Literal["ball", "card"]

SMALLEST_COSINE = 0.35
"""Only pixels with n.l above this are used. Closer to grazing light, a matte ball is seldom Lambertian."""

_MIN_PIXELS, _MOST_PIXELS = 50, 1 << 16
_USED_RADIUS = 0.97  # of a ball: pixels at the rim mix it with the background


def measure_light_intensities(
    files: BallFiles, light_directions: Doubles, target: Target, *, radiometry: RadiometricCalibration = AS_STORED
) -> Doubles:
    """Return light intensities (F, 3), RGB, with mean 1, from images of a gray target.

    By Lambert's law, each is the median of I / (n.l) over the pixels of the target. The images are read and saturated
    pixels are found as in a capture.

    Args:
        files: one image of the target for each light, and a mask of the target. A card without a mask fills the image.
            An image called `ambient` in the folder is subtracted.
        light_directions: (F, 3), unit vectors.
        target: a matte ball, or a matte card that faces the camera, with the normal (0, 0, 1).

    Raises:
        InputError: the numbers of images and lights differ, an image cannot be read or has another size, or the target
            is dark or saturated under a light.
    """
    n_lights = len(light_directions)
    if len(files.images) != n_lights:
        problem = f"found {len(files.images)} images, expected {n_lights}, one for each light"
        raise InputError(problem, path=files.folder)
    mask, normals = _target_normals(files, common_size(files.facts)[0][:2], target)
    check_exposures(files.facts)
    capture = CaptureSource(
        CaptureFiles("gray target", files.folder.name, files.folder, files.images, files.folder),
        files.facts,
        light_directions,
        np.ones((n_lights, 3)),
        radiometry=replace(radiometry, ambient=find_named(files.folder, AMBIENT)),
    )
    rows = np.linspace(0, len(normals) - 1, min(len(normals), _MOST_PIXELS)).astype(np.int64)
    values, found = [], []
    for image in capture.read_pixels(mask, range(n_lights), lambda pixels: pixels, wanted=rows):
        found.append(image.find_saturated(None))
        values.append(image.linear.astype(np.float64))
    saturated = Saturation(len(normals), tuple(found), rows=rows, even=True).flags
    cosines = normals[rows] @ light_directions.T
    intensities = np.empty((n_lights, 3))
    for position, path in enumerate(files.images):
        ratios = values[position] / np.maximum(cosines[:, position], SMALLEST_COSINE)[:, None]
        if saturated is not None:
            # A card is alike everywhere: saturated pixels are its brightest, and shift no median. On a ball, they lie
            # where n.l is largest, and the others tell the same without them.
            ratios[saturated[:, position]] = np.inf if target == "card" else np.nan
        ratios = ratios[(cosines[:, position] > SMALLEST_COSINE) & ~np.isnan(ratios).any(axis=1)]
        intensity = np.median(ratios, axis=0) if len(ratios) >= _MIN_PIXELS else np.zeros(1)
        if not ((intensity > 0) & np.isfinite(intensity)).all():
            problem = "the target is dark or overexposed under this light, so the light's intensity is unknown"
            hint = "Every light needs an image of the target that is neither black nor saturated"
            raise InputError(problem, path=path, hint=hint)
        intensities[position] = intensity
    return np.asarray(intensities / intensities.mean())


def _target_normals(files: BallFiles, shape: tuple[int, ...], target: Target) -> tuple[Bools, Doubles]:
    """Return the mask (H, W) of the target and the normals (P, 3) of its pixels."""
    mask = np.ones(shape, np.bool_)
    if files.mask is not None:
        mask = read_mask(files.mask, ExpectedSize(shape, files.images[0].name, "a mask"))
    if target == "card":
        return mask, np.broadcast_to(np.array((0.0, 0.0, 1.0)), (int(mask.sum()), 3))
    if files.mask is None:
        raise InputError("the images of the gray ball need a mask", path=files.folder, hint="Add one as mask.png")
    circle = circle_from_mask(mask)
    mask &= Circle(circle.x, circle.y, _USED_RADIUS * circle.radius).inside(shape)
    y, x = np.nonzero(mask)
    return mask, circle.normals(x.astype(np.float64), y.astype(np.float64))
