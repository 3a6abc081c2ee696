"""The part of the images that is read: a box, or one of every few rows and columns, for a quick first look."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.facts import ImageFacts
from splinecli.errors import InputError, UsageError
from splinecli.maths import Bools, Doubles, Floats

Numbers = TypeVar("Numbers", bound=np.generic)

_SCALE, _CROP = re.compile(r"1(?:/(\d{1,3}))?"), re.compile(r"\d{1,9}(?:,\d{1,9}){3}")


@dataclass(frozen=True)
class Window:
    """Which pixels of the images are read. Pixels are left out, not averaged, so values are those of the files."""

    box: tuple[int, int, int, int] | None = None  # left, top, width and height in pixels; None for whole images
    step: int = 1  # one of so many rows and columns is read
    shape: tuple[int, ...] | None = None  # (H, W) of the whole images, where they are not read as a whole

    @property
    def is_whole(self) -> bool:
        return self.box is None and self.step == 1

    def in_words(self) -> str | None:
        """Return what is read, for people; None for whole images."""
        words = []
        if self.box is not None:
            left, top, width, height = self.box
            words.append(f"{width} x {height} pixels from ({left}, {top})")
        if self.step > 1:
            words.append(f"one of {self.step} rows and columns")
        return ", ".join(words) or None

    def of(self, pixels: NDArray[Numbers]) -> NDArray[Numbers]:
        """Return the part of an image or map (H, W, ...) that is read, as a view."""
        left, top, width, height = self.box or (0, 0, pixels.shape[1], pixels.shape[0])
        return pixels[top : top + height : self.step, left : left + width : self.step]

    def whole(self, mask: Bools) -> Bools:
        """Return the mask of whole images from a mask of what is read."""
        whole = np.zeros(mask.shape if self.shape is None else self.shape, np.bool_)
        self.of(whole)[...] = mask
        return whole

    def camera(self, matrix: Floats) -> Doubles:
        """Return the camera matrix (3, 3) of what is read, from that of whole images."""
        left, top, *_ = self.box or (0, 0)
        to_window = np.array([[1, 0, -left], [0, 1, -top], [0, 0, self.step]]) / self.step
        return np.asarray(to_window @ matrix, np.float64)

    def filled(self, mask: Bools) -> Bools:
        """Return the mask of whole images from a mask of what is read. A pixel stands for those left out beside it."""
        whole = np.zeros(mask.shape if self.shape is None else self.shape, np.bool_)
        part = replace(self, step=1).of(whole)
        part[...] = mask.repeat(self.step, 0).repeat(self.step, 1)[: part.shape[0], : part.shape[1]]
        return whole

    def on(self, image: ImageFacts) -> Window:
        """Return the window on images of the size of this one. Raises InputError where the box is not inside."""
        if self.is_whole:
            return self
        height, width = shape = image.size[0][:2]
        if self.box is not None:
            left, top, box_width, box_height = self.box
            if left + box_width > width or top + box_height > height:
                crop = ",".join(map(str, self.box))
                problem = f"--crop {crop} is not inside the image of {width} x {height} pixels"
                raise InputError(problem, path=image.path)
        return replace(self, shape=shape)


WHOLE = Window()


def parse_window(crop: str | None, scale: str | None) -> Window:
    """Return the window of --crop X,Y,W,H and --scale 1/N. Raises UsageError."""
    box: tuple[Any, ...] | None = None
    if crop is not None:
        found = _CROP.fullmatch(crop.replace(" ", ""))
        box = tuple(int(number) for number in found[0].split(",")) if found else ()
        if not box or not box[2] or not box[3]:
            problem = f"--crop is {crop!r}; expected X,Y,W,H: the left upper corner and the size in pixels"
            raise UsageError(problem, hint="Such as --crop 1000,500,800,600")
    step = 1
    if scale is not None:
        found = _SCALE.fullmatch(scale.replace(" ", ""))
        step = int(found[1] or 1) if found else 0
        if not step:
            raise UsageError(f"--scale is {scale!r}; expected 1/N, such as 1/4")
    return Window(box, step)
