"""Pixels of TIFF files: 8 and 16 bits and floating point, gray or RGB."""

import logging
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from splinecli.capture.formats.damage import COPY_AGAIN, damage_as_input_error
from splinecli.errors import InputError
from splinecli.maths import Array
from splinecli.system.machine import is_out_of_memory

_LONGEST_EMPTY_PART = 1 << 16  # bytes, such as the tables of a JPEG in a TIFF
_LARGEST_EMPTY_PART = 1 << 24  # bytes by which a tile may be larger than the whole picture

_LONGEST_TAG = 1 << 24  # values, such as the bytes of a colour profile
_MOST_PARTS = 1 << 18  # strips or tiles
_PLACES_OF_PARTS = (273, 279, 324, 325)  # tags with one value for each strip or tile

# Values of TIFF's PhotometricInterpretation, the meaning of a sample.
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _YCBCR = 0, 1, 2, 6


def decode_tiff(file: BinaryIO, path: Path) -> Array | None:
    """Return the first picture of a TIFF file as stored, (H, W) or (H, W, samples); None for one that OpenCV decodes.

    Values grow with brightness: if zero is white in the file, the values are inverted, as in viewers. tifffile reads
    every sample format, but has no decoder for some compressions (LZW).

    Raises:
        InputError: the file is truncated, damaged, or of a kind without linear gray or RGB values.
    """
    with first_page(file, path) as page:
        _check_complete(page, os.fstat(file.fileno()).st_size, path)
        photometric = int(page.photometric)
        if photometric not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _YCBCR):
            problem = f"found a TIFF of the colour model {page.photometric.name}, expected gray or RGB"
            raise InputError(problem, path=path, hint="Export it as RGB")
        pixels = _decode_page(page)
        if photometric == _WHITE_IS_ZERO:
            if pixels is None:
                raise ValueError  # OpenCV would not invert the values
            if pixels.dtype.kind in "ub":
                return ~pixels
    return pixels


@contextmanager
def first_page(file: BinaryIO, path: Path) -> Iterator[Any]:
    """Yield the first page of an open TIFF file. What tifffile raises for a damaged file becomes an InputError."""
    import tifffile

    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True  # the error says what a user needs
    try:
        with damage_as_input_error(path, "the TIFF is damaged and cannot be read", COPY_AGAIN):
            _check_tags(file)
            file.seek(0)
            with tifffile.TiffFile(file, name=path.name) as pages:
                yield pages.pages.first
    finally:
        logger.disabled = before


def _check_tags(file: BinaryIO) -> None:
    """Raise ValueError for a tag with millions of values, because tifffile reads tags as a whole."""
    start = file.read(16)
    order: Literal["little", "big"] = "little" if start[:1] == b"I" else "big"
    big = 43 in start[2:4]  # BigTIFF has wider numbers
    number, length, entry = (8, 8, 20) if big else (4, 2, 12)
    file.seek(int.from_bytes(start[8:16] if big else start[4:8], order))
    count = int.from_bytes(file.read(length), order)
    entries = file.read(min(count, 1 << 16) * entry)
    for place in range(0, len(entries), entry):
        tag = int.from_bytes(entries[place : place + 2], order)
        values = int.from_bytes(entries[place + 4 : place + 4 + number], order)
        if values > (_MOST_PARTS if tag in _PLACES_OF_PARTS else _LONGEST_TAG):
            raise ValueError


def _decode_page(page: Any) -> Array | None:
    """Return pixels (H, W) or (H, W, samples); None where tifffile has no decoder or fails."""
    if int(page.photometric) == _YCBCR:
        return None
    try:
        pixels: Array = page.asarray()
    except Exception as error:  # the type of the error for a missing codec depends on tifffile's version
        if is_out_of_memory(error):
            raise
        return None
    if page.axes == "SYX":
        pixels = np.moveaxis(pixels, 0, -1)
    return pixels if pixels.ndim in (2, 3) else None


def _check_complete(page: Any, size: int, path: Path) -> None:
    """Raise an error where a part of the pixels lies beyond the file's size in bytes, or is longer than its pixels."""
    # Such a part may expand to a thousand times the size of its pixels. So may a tile far larger than the picture.
    expanded = math.prod(page.chunks) * page.dtype.itemsize
    longest = 2 * expanded + _LONGEST_EMPTY_PART
    if expanded > 2 * page.nbytes + _LARGEST_EMPTY_PART or max(page.databytecounts, default=0) > longest:
        raise ValueError
    parts = zip(page.dataoffsets, page.databytecounts, strict=True)
    if any(count == 0 or offset + count > size for offset, count in parts):
        raise InputError("the TIFF is truncated", path=path, hint=COPY_AGAIN)
