"""Colour images under three coloured lamps at once: each channel is an observation under a light of
its own.

A gray matte pixel with the scaled normal b shows I = M s in its channels, where s = (l_R . b, l_G .
b, l_B . b) and M is the crosstalk matrix: M[c, l] is the response of channel c to lamp l. Reading
gives s = inverse(M) I. The colour of a surface also changes I, and cannot be separated from its
shading.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splinecli.capture.formats.images import ExpectedSize, read_image
from splinecli.capture.formats.numbers import read_number_rows
from splinecli.errors import InputError
from splinecli.maths import Array, Float32Array, Float64Array

CROSSTALK = "crosstalk.txt"
CHANNELS = 3
LARGEST_CONDITION = 30.0  # of a crosstalk matrix; noise grows by about so much


@dataclass(frozen=True, eq=False)
class ChannelLights:
    """How F / 3 colour images become F observations; image i is channel i % 3 of colour image i //
    3.
    """

    crosstalk: Float64Array  # (1, 3, 3) or (F / 3, 3, 3); see the module
    measured: bool  # whether a file gives it

    def observe(
        self, path: Path, stored: Array, linear: Float32Array, index: int
    ) -> tuple[Array, Float32Array]:
        """Return one channel (P, 1) of stored pixels, and of linear ones without the light of the
        other lamps.

        Raises InputError for a gray image.
        """
        if linear.shape[1] != CHANNELS:
            raise InputError(
                "the image is gray, but --lights-in-channels reads a light from each of three"
                " channels",
                path,
                hint="Leave --lights-in-channels out",
            )
        channel = index % CHANNELS
        matrix = self.crosstalk[index // CHANNELS % len(self.crosstalk)]
        unmixed = linear @ np.linalg.inv(matrix)[channel].astype(np.float32)
        return stored[:, channel, None], np.maximum(unmixed, 0)[:, None]

    def in_words(self) -> str:
        text = (
            "The channels R, G, B of each image are read as photographs under three lamps. This"
            " is only valid for gray objects; coloured objects get wrong normals."
        )
        if self.measured:
            return text
        return (
            f"{text} Without {CROSSTALK}, each channel is assumed to respond to its own lamp only;"
            " measure the crosstalk with calibrate --gray-ball DIR --lights-in-channels."
        )


def check_crosstalk(matrix: Float64Array, path: Path) -> None:
    """Raise InputError if the channels (3, 3) do not separate the lamps."""
    if (matrix < 0).any():
        raise InputError(
            f"found the negative response {matrix.min():g}, expected numbers of at least 0",
            path,
        )
    condition = np.linalg.cond(matrix) if np.isfinite(matrix).all() else np.inf
    if condition > LARGEST_CONDITION:
        number = f"the condition number {condition:.0f}" if condition < 1e6 else "no inverse"
        raise InputError(
            f"the channels do not separate the lamps: the crosstalk matrix has {number}",
            path,
            hint=f"Expected a condition number of at most {LARGEST_CONDITION:.0f}:"
            " use lamps with more distinct colours",
        )


def channel_lights(path: Path | None, n_images: int) -> ChannelLights:
    """Return the crosstalk of n_images colour images from a file with 3 lines, or 3 for each image;
    None without a file.

    Raises InputError.
    """
    if path is None:
        return ChannelLights(np.eye(CHANNELS)[None], measured=False)
    matrix = read_number_rows(path).as_array()
    if matrix.shape not in (
        (CHANNELS, CHANNELS),
        (CHANNELS * n_images, CHANNELS),
    ):
        raise InputError(
            f"found {matrix.shape[0]} x {matrix.shape[1]} numbers, expected 3 x 3, or 3 lines for"
            " each image",
            path,
            hint="Line c, column l: the response of channel c to lamp l, R G B",
        )
    matrices = matrix.reshape(-1, CHANNELS, CHANNELS)
    for each in matrices:
        check_crosstalk(each, path)
    return ChannelLights(matrices, measured=True)


_REFERENCE = re.compile(
    r"(?<![a-z])(ref|reference|background|bg|empty|blank|flat|baseline|no[_-]?contact|untouched)"
    r"(?![a-z])"
)
_FLATTEST = 0.7  # of the gradients of the next flattest picture, at most
_UNCHANGED = 0.03  # natural logarithm of the largest ratio between equal pixels
_LEAST_UNCHANGED = 0.3  # share of the pixels that no other photograph changes


def find_reference(images: Sequence[Path]) -> Path | None:
    """Return the picture of a sensor without contact among photographs with it; None if unclear.

    It is the only one with such a name, or else a factor of all others: clearly flatter, and equal
    to each of them in many pixels, those without contact. Raises InputError if an image cannot be
    read.
    """
    named = [image for image in images if _REFERENCE.search(image.stem.lower())]
    if named:
        return named[0] if len(named) == 1 else None
    import cv2

    logarithms: list[Float32Array] = []
    for image in images:
        expected = ExpectedSize(logarithms[0].shape, images[0].name) if logarithms else None
        smooth = cv2.GaussianBlur(read_image(image, expected), (0, 0), 1.5)
        logarithms.append(np.log(np.maximum(smooth.reshape(*smooth.shape[:2], -1), 0.02)))
    slopes = [float(np.abs(np.diff(each, axis=0)).mean()) for each in logarithms]
    first, second, *_ = sorted(range(len(slopes)), key=slopes.__getitem__)
    if slopes[first] > _FLATTEST * slopes[second]:
        return None
    for other in logarithms[:first] + logarithms[first + 1 :]:
        ratio = other - logarithms[first]
        equal = (np.abs(ratio - np.median(ratio)) < _UNCHANGED).all(axis=2)
        if equal.mean() < _LEAST_UNCHANGED:
            return None
    return images[first]
