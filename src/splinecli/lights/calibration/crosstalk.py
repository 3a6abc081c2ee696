"""Measure the crosstalk of three coloured lamps that light a matte gray ball at once, the share of
each lamp in each channel.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splinecli.capture.channel_lights import CHANNELS, check_crosstalk
from splinecli.capture.linearise import AS_STORED, RadiometricCalibration
from splinecli.errors import InputError
from splinecli.lights.calibration.balls import BallFiles
from splinecli.lights.calibration.lamps import read_target
from splinecli.maths import Bools, Float64Array, Floats

_MIN_PIXELS, _FITS = 50, 10


def measure_crosstalk(
    files: BallFiles,
    light_directions: Float64Array,
    *,
    radiometry: RadiometricCalibration = AS_STORED,
) -> Float64Array:
    """Return crosstalk matrices (N, 3, 3) with a mean diagonal of 1, from colour images of a gray
    ball.

    For N images, the absolute deviations of I_c = sum over l of M[c, l] max(n . l_l, 0) are
    minimised over the pixels that are not saturated.

    Args:
        files: colour images of the matte ball under all three lamps, and its mask.
        light_directions: (3 N, 3), unit, three for each image in the order R, G, B.

    Raises:
        InputError: the numbers of images and lights do not match, an image cannot be read, is gray
            or saturated, or the channels do not separate the lamps.
    """
    count = len(files.images)
    if CHANNELS * count != len(light_directions):
        raise InputError(
            f"found {count} colour images of the gray ball and {len(light_directions)} lights,"
            " expected three lights for each image",
            path=files.folder,
            hint="For each colour image, photograph the mirror ball under each lamp alone, in the"
            " order R, G, B",
        )
    normals, rows, images = read_target(files, "ball", radiometry)
    matrices = []
    for number, image in enumerate(images):
        saturated = np.zeros(len(normals), np.bool_)
        saturated[image.find_saturated(None).saturated] = True
        lights = light_directions[CHANNELS * number : CHANNELS * number + CHANNELS]
        matrices.append(_fit(image.linear, normals[rows] @ lights.T, ~saturated[rows], image.path))
    found = np.stack(matrices)
    return np.asarray(found / (np.trace(found, axis1=1, axis2=2).mean() / CHANNELS))


def _fit(values: Floats, cosines: Float64Array, known: Bools, path: Path) -> Float64Array:
    """Return the matrix (3, 3) that explains values (P, 3) under cosines (P, 3)."""
    if values.shape[1] != CHANNELS:
        raise InputError("the image is gray, expected a colour image under three lamps", path=path)
    if np.count_nonzero(known) < _MIN_PIXELS:
        raise InputError("the gray ball is overexposed", path=path, hint="Use a shorter exposure")
    shading, values = np.maximum(cosines[known], 0), values[known].astype(np.float64)
    rows = []
    for channel in values.T:
        weights = np.ones(len(channel))
        for _ in range(_FITS):
            weighted = shading * weights[:, None]
            row = np.linalg.lstsq(weighted.T @ shading, weighted.T @ channel, rcond=None)[0]
            weights = 1 / (
                np.abs(channel - shading @ row) + 0.02 * max(float(channel.max()), 1e-12)
            )
        rows.append(row)
    matrix = np.stack(rows)
    check_crosstalk(matrix, path)
    return matrix
