"""Colour photographs taken under three coloured lamps at once, where each channel is an observation
under a different light.

For a gray matte pixel with the scaled normal b, the three channels are I = M s, where s = (l_R . b,
l_G . b, l_B . b). M is the crosstalk matrix: M[c, l] is the response of channel c to lamp l. The
observations are s = inverse(M) I. The colour of a surface also affects I and cannot be separated
from its shading.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splinecli.capture.formats.images import ExpectedSize, read_image
from splinecli.capture.formats.numbers import read_number_rows
from splinecli.capture.linearise import LightOf
from splinecli.errors import InputError
from splinecli.maths import Array, Float32Array, Float64Array, Integers

CROSSTALK = "crosstalk.txt"
CHANNELS = 3
LARGEST_CONDITION = 30.0  # of a crosstalk matrix, which amplifies noise by about this factor


@dataclass(frozen=True, eq=False)
class ChannelLights:
    """The mapping from F / 3 colour images to F observations: channel i % 3 of image i // 3 is
    observation i.
    """

    crosstalk: Float64Array  # (1, 3, 3) or (F / 3, 3, 3); see the module
    measured: bool  # whether the crosstalk was read from a file

    def observe(
        self, path: Path, stored: Array, count: int, light: LightOf, index: int
    ) -> tuple[Array, int, LightOf]:
        """Return one channel (P, 1) of the stored pixels and, with the crosstalk removed, of the
        linear pixels; see pixel_reader.

        Raises InputError for a gray image.
        """
        if stored.shape[1] != CHANNELS:
            raise InputError(
                "the image is gray, but --lights-in-channels needs three channels, one for each"
                " light",
                path,
                hint="Omit --lights-in-channels",
            )
        channel = index % CHANNELS
        matrix = self.crosstalk[index // CHANNELS % len(self.crosstalk)]
        weights = np.linalg.inv(matrix)[channel].astype(np.float32)

        def unmixed(rows: Integers | slice) -> Float32Array:
            return np.asarray(np.maximum(light(rows) @ weights, 0)[:, None], np.float32)

        return stored[:, channel, None], count, unmixed

    def in_words(self) -> str:
        text = (
            "The red, green and blue channels of each image are treated as separate photographs"
            " under three lamps. This is valid only for gray objects; the normals of coloured"
            " objects are wrong."
        )
        if self.measured:
            return text
        return (
            f"{text} Because there is no {CROSSTALK}, each channel is assumed to respond only to"
            " its own lamp. To measure the crosstalk, run calibrate --gray-ball DIR"
            " --lights-in-channels."
        )


def check_crosstalk(matrix: Float64Array, path: Path) -> None:
    """Raise InputError if the lamps cannot be separated with this matrix (3, 3)."""
    if (matrix < 0).any():
        raise InputError(
            f"found a negative response ({matrix.min():g}), expected non-negative numbers",
            path,
        )
    condition = np.linalg.cond(matrix) if np.isfinite(matrix).all() else np.inf
    if condition > LARGEST_CONDITION:
        number = f"a condition number of {condition:.0f}" if condition < 1e6 else "no inverse"
        raise InputError(
            f"the lamps cannot be separated, because the crosstalk matrix has {number}",
            path,
            hint="Use lamps with more distinct colours; the condition number must be at most"
            f" {LARGEST_CONDITION:.0f}",
        )


def channel_lights(path: Path | None, n_images: int) -> ChannelLights:
    """Return the crosstalk of n_images colour images.

    The file has either 3 lines that apply to all images or 3 lines for each image. Without a file,
    the channels are assumed to be independent. Raises InputError.
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
            hint="Write the response of channel c to lamp l in line c, column l, in the order R G"
            " B",
        )
    matrices = matrix.reshape(-1, CHANNELS, CHANNELS)
    for each in matrices:
        check_crosstalk(each, path)
    return ChannelLights(matrices, measured=True)


_REFERENCE = re.compile(
    r"(?<![a-z])(ref|reference|background|bg|empty|blank|flat|baseline|no[_-]?contact|untouched)"
    r"(?![a-z])"
)
_FLATTEST = 0.7  # largest mean gradient, relative to the next flattest picture
_UNCHANGED = 0.03  # natural logarithm of the largest ratio at which pixels are considered equal
_LEAST_UNCHANGED = 0.3  # smallest share of pixels that must be equal in every other photograph


def find_reference(images: Sequence[Path]) -> Path | None:
    """Return the picture that a tactile sensor took without contact, or None if it is ambiguous.

    If exactly one picture has a name such as "background", it is the reference. Otherwise, it must
    be clearly flatter than all other pictures and equal to each of them wherever there was no
    contact. Raises InputError if an image cannot be read.
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
