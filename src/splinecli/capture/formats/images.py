"""Photographs as linear values, and masks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image, decode_with_alpha
from splinecli.errors import InputError

StrPath = str | os.PathLike[str]


def read_image(path: StrPath) -> NDArray[np.float32]:
    """A photograph as (H, W, C) float32, C 1 (gray) or 3 (RGB), taken to be linear.

    PNG, TIFF or JPEG. 8- and 16-bit values are scaled so that their full range is 0 to 1, floating-point ones
    are kept; alpha is dropped and an EXIF orientation ignored.

    Raises:
        InputError: the file is missing, of another format, truncated or damaged, or holds floating-point
            values that are negative or not finite.
    """
    return to_linear(decode_image(Path(path)), Path(path))


def to_linear(stored: NDArray[Any], path: Path) -> NDArray[np.float32]:
    """Stored values of any shape as float32 on the scale of read_image, which see."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused below
        values = stored.astype(np.float32)
    if stored.dtype.kind == "u":
        values /= np.float32(np.iinfo(stored.dtype).max)
        return values
    # One of these is NaN or infinite where any value is; np.isfinite of all would be an array more.
    lowest, highest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise InputError(
            "found a value that is not finite (NaN or infinity), expected a photograph", path=path
        )
    if lowest < 0:
        raise InputError(
            f"found the negative value {lowest:g}, expected a photograph",
            path=path,
            hint="Set values below zero, such as noise after a dark frame was taken off, to zero",
        )
    return values


def read_boundary(path: StrPath) -> NDArray[np.bool_]:
    """A mask of CyclesPS (H, W) bool: true where any channel is above zero; it may be empty.

    Raises:
        InputError: the image cannot be read.
    """
    above: NDArray[np.bool_] = decode_image(Path(path)).max(axis=2) > 0
    return above


def read_mask(path: StrPath) -> NDArray[np.bool_]:
    """A mask (H, W) bool: true where any channel is above half of the image's largest value.

    So 0 and 1 serve as well as 0 and 255. Where an alpha channel cuts something out (is above half of its
    largest value at some pixels and not at others), it alone is the mask: colours then mean nothing.

    Raises:
        InputError: the image cannot be read, or no pixel is above zero.
    """
    path = Path(path)
    stored, alpha = decode_with_alpha(path)
    if alpha is not None:
        opaque: NDArray[np.bool_] = alpha > alpha.max() / 2
        if opaque.any() and not opaque.all():
            return opaque
    largest = to_linear(stored.max(keepdims=True), path).item()
    if largest <= 0:
        raise InputError(
            "the mask is empty: every pixel is zero",
            path=path,
            hint="Paint the object white, or give no mask",
        )
    mask: NDArray[np.bool_] = (stored > stored.max() / 2).any(axis=2)
    return mask
