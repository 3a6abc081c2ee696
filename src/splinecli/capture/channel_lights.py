"""Colour images under three coloured lamps at once: each channel is an observation under a light of
its own.

A gray matte pixel with the scaled normal b shows I = M s in its channels, where s = (l_R . b, l_G .
b, l_B . b) and M is the crosstalk matrix: M[c, l] is the response of channel c to lamp l. Reading
gives s = inverse(M) I. The colour of a surface also changes I, and cannot be separated from its
shading.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
    None is none.

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
