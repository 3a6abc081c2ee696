"""The mask of a capture: which pixels belong to the object."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.formats.images import read_mask
from splinecli.capture.layouts.capture_files import CaptureFiles
from splinecli.errors import InputError


def read_capture_mask(files: CaptureFiles, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a capture whose images have this shape; all true where the capture has no mask.

    Raises:
        InputError: a mask cannot be read, is empty, or differs in size from the images.
    """
    if files.boundaries:
        return _read_boundaries(files, shape)
    if files.mask is None:
        return np.ones(shape, np.bool_)
    return read_mask(files.mask, ExpectedSize(shape, files.images[0].name, "a mask"))


def _read_boundaries(files: CaptureFiles, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the union of the masks of CyclesPS."""
    union = np.zeros(shape, np.bool_)
    for path in files.boundaries:
        union |= decode_image(path, ExpectedSize(shape, files.images[0].name, "a mask")).max(axis=2) > 0
    if not union.any():
        names = " and ".join(path.name for path in files.boundaries)
        raise InputError(f"the mask is empty: every pixel of {names} is zero", path=files.boundaries[0].parent)
    return union


def take_pixels(image: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return image[mask], the pixels (P, C) of an image (H, W, C) in a mask (H, W), but faster."""
    if mask.all():
        return image.reshape(-1, image.shape[2])
    return np.stack([image[..., channel][mask] for channel in range(image.shape[2])], axis=1)
