"""Orientation of images, from their EXIF tags."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from splinecli.capture.formats.raw import is_raw
from splinecli.errors import InputError

UPRIGHT = 1
"""The orientation of images that are shown as they are stored."""

_ORIENTATION = 0x0112


def common_orientation(images: Sequence[Path]) -> int:
    """Return the EXIF orientation that all images have, 1 to 8; UPRIGHT where they state none.

    RAW files are not asked: their pixels are read as the sensor has them.

    Raises:
        InputError: two images state different orientations, so that their pixels do not fit on each other.
    """
    stated = [(path, _orientation(path)) for path in images if not is_raw(path)]
    if not stated:
        return UPRIGHT
    first, orientation = stated[0]
    for path, other in stated[1:]:
        if other != orientation:
            raise InputError(
                f"found EXIF orientation {other}, expected {orientation} as in {first.name}",
                path=path,
                hint="Export all images the same way up, without this tag",
            )
    return orientation


def _orientation(path: Path) -> int:
    from PIL import Image

    # Decoding names a damaged file; Pillow warns of tags that it does not expect.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path) as image:
                # Of the base class, because that of PNG decodes the image to find tags behind its pixels.
                value = Image.Image.getexif(image).get(_ORIENTATION, UPRIGHT)
        except Exception:  # damaged tags cause a dozen types of errors
            return UPRIGHT
    return value if value in range(1, 9) else UPRIGHT
