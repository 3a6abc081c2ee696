"""Images as linear values, and masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image, decode_with_alpha
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.paths import StrPath
from splinecli.errors import InputError


def read_image(path: StrPath, expected: ExpectedSize | None = None) -> NDArray[np.float32]:
    """Return an image (H, W, C) float32, C 1 (gray) or 3 (RGB), whose values are taken to be linear.

    The file is PNG, TIFF or JPEG. 8- and 16-bit values are scaled so that their full scale is 1. Floating-point values
    are kept. Alpha is dropped, and an EXIF orientation is ignored.

    Raises:
        InputError: see decode_image; also for floating-point values that are negative or not finite.
    """
    return to_linear(decode_image(Path(path), expected), Path(path))


def to_linear(stored: NDArray[Any], path: Path) -> NDArray[np.float32]:
    """Return stored values of any shape as float32 on the scale of read_image.

    Raises:
        InputError: a floating-point value is negative or not finite.
    """
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, and are refused below
        values = stored.astype(np.float32)
    if stored.dtype.kind == "u":
        values /= np.float32(np.iinfo(stored.dtype).max)
        return values
    # One of these is NaN or infinite where any value is. np.isfinite of all values would need another array.
    lowest, highest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise InputError("found a value that is not finite (NaN or infinity), expected a photograph", path=path)
    if lowest < 0:
        raise InputError(
            f"found the negative value {lowest:g}, expected a photograph",
            path=path,
            hint="Set values below zero, such as noise after a dark frame was subtracted, to zero",
        )
    return values


def read_mask(path: StrPath, expected: ExpectedSize | None = None) -> NDArray[np.bool_]:
    """Return a mask (H, W) bool: true where any channel is above half of the image's largest value.

    So 0 and 1 serve as well as 0 and 255. If an alpha channel cuts something out, it alone is the mask, because colours
    mean nothing in such an image.

    Raises:
        InputError: the image cannot be read, or no pixel is above zero.
    """
    path = Path(path)
    stored, alpha = decode_with_alpha(path, expected)
    opaque = cut_out(alpha)
    if opaque is not None:
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


def cut_out(alpha: NDArray[Any] | None) -> NDArray[np.bool_] | None:
    """Return the opaque pixels (H, W) of an alpha channel that cuts something out; None for one that does not.

    Opaque is what is above half of the largest alpha. A channel that is opaque everywhere or nowhere cuts nothing out.
    """
    if alpha is None:
        return None
    opaque: NDArray[np.bool_] = alpha > alpha.max() / 2
    return opaque if opaque.any() and not opaque.all() else None
