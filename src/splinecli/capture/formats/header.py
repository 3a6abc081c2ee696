"""What the headers of image files state about their values: display encoding, and the white level."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from splinecli.capture.formats.tiff import first_page
from splinecli.errors import InputError

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""The first bytes of the files. Those of a PNG are the longest."""

_MOST_PARTS = 10_000
"""Chunks of a PNG before its pixels, or segments of a JPEG before its frame. Real files have a few dozen."""

_MAX_SAMPLE_VALUE, _WHITE_LEVEL = 281, 50717  # tags of TIFF and DNG


def is_image(content: bytes) -> bool:
    """Return whether the content of a file begins as PNG, JPEG or TIFF."""
    return content.startswith((PNG, JPEG, *TIFF))


def stated_size(path: Path) -> tuple[tuple[int, int, int], int]:
    """Return the shape (H, W, C) that the header of a PNG or JPEG states, and the bytes of each number.

    Raises:
        InputError: the file ends before, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            kind = "PNG" if file.read(len(PNG)) == PNG else "JPEG"
            size = _png_size(file) if kind == "PNG" else _jpeg_size(file)
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    if size is None:
        raise InputError(f"the {kind} is truncated", path=path, hint="Copy or export it again")
    return size


def _png_size(file: BinaryIO) -> tuple[tuple[int, int, int], int] | None:
    header = file.read(18)  # length, name and content of IHDR
    if len(header) < 18 or header[4:8] != b"IHDR":
        return None
    width, height = (int.from_bytes(header[place : place + 4], "big") for place in (8, 12))
    channels = {0: 1, 4: 2, 6: 4}.get(header[17], 3)
    return (height, width, channels), 2 if header[16] == 16 else 1


def _jpeg_size(file: BinaryIO) -> tuple[tuple[int, int, int], int] | None:
    """Return the size in the header of a JPEG's frame, which stands behind segments of any length."""
    file.seek(2)
    for _ in range(_MOST_PARTS):
        if len(start := file.read(2)) < 2 or start[0] != 0xFF:
            return None
        if start[1] == 0xFF:  # fill
            file.seek(-1, 1)
            continue
        segment = file.read(8)
        if len(segment) < 8:
            return None
        if 0xC0 <= start[1] <= 0xCF and start[1] not in (0xC4, 0xC8, 0xCC):
            height, width = (int.from_bytes(segment[place : place + 2], "big") for place in (3, 5))
            return (height, width, segment[7]), 1
        file.seek(int.from_bytes(segment[:2], "big") - 8, 1)
    return None


def is_display_encoded(path: Path) -> bool:
    """Return whether the file says that its values are display-encoded: JPEG, or PNG with a chunk sRGB or gAMA.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(PNG))
            if start.startswith(JPEG):
                return True
            for kind, content in _png_chunks(file) if start == PNG else ():
                if kind == b"sRGB":
                    return True
                if kind == b"gAMA":
                    # 100000 times the exponent of the encoding: 1 means linear.
                    return int.from_bytes(content[:4], "big") != 100_000
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    return False


def stated_white_level(path: Path) -> int | None:
    """Return the white level that a 16-bit image states, 2^bits - 1 where it states bits; None without one.

    It comes from a PNG's chunk sBIT, or from a TIFF's BitsPerSample, WhiteLevel (DNG) or MaxSampleValue. The last one
    may also be the largest value of an image, so it counts only if it is 2^bits - 1.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(PNG))
            if start == PNG:
                return _stated_by_png(file)
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    return _stated_by_tiff(path) if start.startswith(TIFF) else None


def _png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Yield name and content of the chunks before a PNG's pixels, from a file positioned after the signature."""
    for _ in range(_MOST_PARTS):
        if len(header := file.read(8)) < 8 or header[4:] in (b"IDAT", b"IEND"):
            return
        length = int.from_bytes(header[:4], "big")
        # Those of interest are short; others, such as profiles, may be long.
        content = file.read(min(length, 16))
        file.seek(length - len(content) + 4, 1)
        yield header[4:], content


def _stated_by_png(file: BinaryIO) -> int | None:
    for kind, content in _png_chunks(file):
        if kind == b"IHDR" and (len(content) < 10 or content[8] != 16):
            return None
        if kind == b"sBIT" and content:
            # One number for each channel. Alpha, if there is one, comes last.
            bits = set(content[: 3 if len(content) > 2 else 1])
            return _level(bits.pop()) if len(bits) == 1 else None
    return None


def _stated_by_tiff(path: Path) -> int | None:
    try:
        with first_page(path) as page:
            bits = int(page.bitspersample)
            tags = {code: page.tags.valueof(code) for code in (_MAX_SAMPLE_VALUE, _WHITE_LEVEL)}
    except InputError:  # decoding names it
        return None
    if bits < 16:
        return _level(bits)
    if bits > 16:
        return None
    white, largest = (_one_value(tags[code]) for code in (_WHITE_LEVEL, _MAX_SAMPLE_VALUE))
    if white is not None and 0 < white < 65_535:
        return white
    return largest if largest is not None and largest == _level(largest.bit_length()) else None


def _one_value(tag: object) -> int | None:
    """Return the tag's value where it is one whole number, or the same one for each channel."""
    values = set(tag) if isinstance(tag, tuple) else {tag}
    value = values.pop() if len(values) == 1 else None
    return value if isinstance(value, int) else None


def _level(bits: int) -> int | None:
    return (1 << bits) - 1 if 8 <= bits < 16 else None
