"""What the headers of image files state about their values: the transfer curve, and the white level."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from splinecli.capture.formats.colour_profile import LARGEST_PROFILE, profile_curve
from splinecli.capture.formats.raw import is_raw
from splinecli.capture.formats.tiff import first_page
from splinecli.errors import InputError
from splinecli.transfer import SRGB, TransferCurve

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""The first bytes of the files. Those of a PNG are the longest."""

_MOST_PARTS = 10_000
"""Chunks of a PNG before its pixels, or segments of a JPEG before its frame. Real files have a few dozen."""

_MAX_SAMPLE_VALUE, _PROFILE, _WHITE_LEVEL = 281, 34675, 50717  # tags of TIFF and DNG

_RAW_WHITE = 65_535
"""The white level of developed RAW files; see decode_raw."""


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
    """Return the size in the header of a JPEG's frame."""
    for marker, _ in _jpeg_segments(file):
        if _is_frame(marker):
            frame = file.read(6)
            height, width = (int.from_bytes(frame[place : place + 2], "big") for place in (1, 3))
            return ((height, width, frame[5]), 1) if len(frame) == 6 else None
    return None


def _jpeg_segments(file: BinaryIO) -> Iterator[tuple[int, int]]:
    """Yield marker and length of the segments up to a JPEG's frame, with the file at each one's content."""
    start, marker = 2, 0
    for _ in range(_MOST_PARTS):
        file.seek(start)
        header = file.read(4)
        if len(header) < 4 or header[0] != 0xFF or _is_frame(marker):
            return
        if header[1] == 0xFF:  # fill
            start += 1
            continue
        marker, length = header[1], int.from_bytes(header[2:], "big")
        yield marker, length - 2
        start += 2 + length


def _is_frame(marker: int) -> bool:
    return 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)


@dataclass(frozen=True)
class StatedCurve:
    """What a file says of its transfer curve.

    Args:
        curve: see TransferCurve; linear where the file says nothing.
        by: what says so, for people; empty for nothing.
        unread: whether there is a colour profile whose curve cannot be read.
    """

    curve: TransferCurve = 1.0
    by: str = ""
    unread: bool = False


def stated_curve(path: Path) -> StatedCurve:
    """Return the curve that a file states: that of a colour profile, else sRGB for JPEG and PNG with sRGB or gAMA.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(len(PNG))
            if is_raw(path):
                return StatedCurve()
            if start.startswith(TIFF):
                stated, profile = StatedCurve(), _tiff_profile(path)
            elif start.startswith(JPEG):
                stated, profile = StatedCurve(SRGB, "JPEG"), _jpeg_profile(file)
            else:
                stated, profile = _stated_by_chunks(file) if start == PNG else (StatedCurve(), None)
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    if profile is None:
        return stated
    found = profile_curve(profile)
    if found is None:
        return StatedCurve(stated.curve, stated.by, unread=True)
    name, curve = found
    return StatedCurve(curve, f'colour profile "{name}"')


def _stated_by_chunks(file: BinaryIO) -> tuple[StatedCurve, bytes | None]:
    """Return what a PNG's chunks sRGB and gAMA say, and its profile; b"" for a damaged one."""
    stated, profile = StatedCurve(), None
    for kind, content in _png_chunks(file):
        # 100000 times the exponent of the encoding: 1 means linear.
        if kind == b"sRGB" or (kind == b"gAMA" and int.from_bytes(content[:4], "big") != 100_000):
            stated = StatedCurve(SRGB, "PNG that says so")
        if kind == b"iCCP":
            _, _, compressed = content.partition(b"\0")
            try:
                profile = zlib.decompressobj().decompress(compressed[1:], LARGEST_PROFILE)
            except zlib.error:
                profile = b""
    return stated, profile


def _jpeg_profile(file: BinaryIO) -> bytes | None:
    """Return the profile from a JPEG's segments; b"" for one that is too long, None without one."""
    parts: dict[int, bytes] = {}
    for marker, length in _jpeg_segments(file):
        if marker == 0xE2 and length > 14 and file.read(12) == b"ICC_PROFILE\0":
            number = file.read(2)[0]
            parts[number] = file.read(length - 14)
            if sum(map(len, parts.values())) > LARGEST_PROFILE:
                return b""
    return b"".join(parts[number] for number in sorted(parts)) if parts else None


def _tiff_profile(path: Path) -> bytes | None:
    try:
        with first_page(path) as page:
            tag = page.tags.get(_PROFILE)
            if tag is None:
                return None
            return bytes(tag.value) if tag.count <= LARGEST_PROFILE else b""
    except InputError:  # decoding names the damage
        return None


def stated_white_level(path: Path) -> int | None:
    """Return the white level that a 16-bit image states, 2^bits - 1 where it states bits; None without one.

    It is in the unit of the decoded values: full scale for a RAW file, whatever its tags say. Otherwise it comes from a
    PNG's chunk sBIT, or from a TIFF's BitsPerSample, WhiteLevel (DNG) or MaxSampleValue. The last one may also be the
    largest value of an image, so it counts only if it is 2^bits - 1.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        if is_raw(path):
            return _RAW_WHITE
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
        # Those of interest are short, except profiles.
        content = file.read(min(length, LARGEST_PROFILE if header[4:] == b"iCCP" else 16))
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
