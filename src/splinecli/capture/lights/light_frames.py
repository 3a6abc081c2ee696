"""Frames of light files: which way their axes point, and whether x and y are exchanged."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from splinecli.errors import UsageError
from splinecli.maths import Doubles

AXIS_WORDS = {
    "x-right": (0, 1),
    "x-left": (0, -1),
    "y-up": (1, 1),
    "y-down": (1, -1),
    "z-camera": (2, 1),
    "z-away": (2, -1),
}
"""What --light-frame takes: the axis of the file and the sign with which it enters."""

EXCHANGED = "exchanged"  # word for files whose first column is y and whose second is x


@dataclass(frozen=True)
class LightFrame:
    """The frame of a light file."""

    signs: tuple[int, int, int] = (1, 1, 1)  # of x, y and z, 1 for right, up and to the camera, -1 for left, down, away
    exchanged: bool = False  # whether the file has y before x. The signs are those of x and y, wherever they stand

    @property
    def matrix(self) -> Doubles:
        """The matrix (3, 3) M with which directions @ M' are in the frame x right, y up, z to the camera."""
        order = [1, 0, 2] if self.exchanged else [0, 1, 2]
        return np.asarray(np.diag(self.signs).astype(np.float64)[:, order])

    def __str__(self) -> str:
        """Return the value of --light-frame, such as "x-left,y-down"; only what differs from the usual frame."""
        words = [EXCHANGED] if self.exchanged else []
        words += [name for name, (axis, sign) in AXIS_WORDS.items() if sign == self.signs[axis] == -1]
        return ",".join(words) or "x-right,y-up"

    def describe(self) -> str:
        """Return words such as "x and y exchanged, y negated"; empty for the usual frame."""
        negated = " and ".join(axis for axis, sign in zip("xyz", self.signs, strict=True) if sign < 0)
        parts = ["x and y exchanged"] if self.exchanged else []
        if negated:
            parts.append(f"{negated} negated")
        return ", ".join(parts)

    def after(self, first: LightFrame) -> LightFrame:
        """Return the frame that stands for `first` and then this one."""
        x, y, z = (int(sign) for sign in (self.matrix @ first.matrix).sum(axis=1))
        return LightFrame((x, y, z), self.exchanged != first.exchanged)


USUAL_FRAME = LightFrame()  # x right, y up, z to the camera, as in docs/files-and-frames.md

BOTH_NEGATED = LightFrame((-1, -1, 1))

PLANE_FRAMES = tuple(LightFrame((x, y, 1), exchanged) for exchanged, x, y in product((False, True), (1, -1), (1, -1)))
"""The eight frames with z to the camera; the usual one first."""


def parse_light_frame(text: str | None) -> LightFrame:
    """Return the frame of a list such as "x-left,y-down,exchanged"; the usual one of None.

    Axes that the list does not name are as usual. Raises UsageError for an unknown word, and an axis that comes twice.
    """
    if text is None:
        return USUAL_FRAME
    signs: dict[int, int] = {}
    exchanged = False
    for word in (item.strip() for item in text.split(",")):
        if word == EXCHANGED:
            exchanged = True
            continue
        if word not in AXIS_WORDS:
            words = ", ".join((*AXIS_WORDS, EXCHANGED))
            raise UsageError(f"--light-frame is {text!r}; expected words of {words}, separated by commas")
        axis, sign = AXIS_WORDS[word]
        if axis in signs:
            raise UsageError(f"--light-frame is {text!r}; {'xyz'[axis]} comes twice", hint="Leave one out")
        signs[axis] = sign
    return LightFrame((signs.get(0, 1), signs.get(1, 1), signs.get(2, 1)), exchanged)
