"""Decoders for TIFF and camera RAW files, and the error handling for damaged files that all
decoders share.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, SplinecliError
from splinecli.maths import Array
from splinecli.system.files import utf8_name
from splinecli.system.machine import import_extra, is_out_of_memory

if TYPE_CHECKING:
    import rawpy


DAMAGED, COPY_AGAIN = "the image is damaged and cannot be read", "Copy or export it again"
"""Problem and hint for a damaged image."""


@contextmanager
def damage_as_input_error(path: Path, problem: str, hint: str | None = None) -> Iterator[None]:
    """Convert any of the dozen types of exceptions that readers raise for a damaged file to an
    InputError.
    """
    try:
        yield
    except SplinecliError:
        raise
    except PermissionError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path) from None
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise InputError(problem, path, hint=hint) from error


class _Redirected:
    """File descriptor 2, redirected to a file while `users` threads are decoding."""

    def __init__(self) -> None:
        self.turn, self.changed, self.users = threading.Lock(), threading.Condition(), 0
        self._store: BinaryIO | None = None
        self._original = -1

    def enter(self) -> tuple[BinaryIO | None, int]:
        """Return the file, or None if there is no stderr, and its length before this thread's
        messages.
        """
        self.users += 1
        if self.users == 1:
            with suppress(OSError, ValueError):  # without a stderr, there is nothing to protect
                if sys.stderr is not None:
                    sys.stderr.flush()
                self._original = os.dup(2)
                self._store = tempfile.TemporaryFile()  # noqa: SIM115 - until the last one leaves
                os.dup2(self._store.fileno(), 2)
        return self._store, 0 if self._store is None else os.fstat(self._store.fileno()).st_size

    def leave(self) -> None:
        self.users -= 1
        if not self.users and self._original >= 0:
            os.dup2(self._original, 2)
            os.close(self._original)
            if self._store is not None:
                self._store.close()
            self._store, self._original = None, -1
        self.changed.notify_all()


_STDERR = _Redirected()


@contextmanager
def native_stderr(*, alone: bool = False) -> Iterator[list[str]]:
    """Capture the messages that C libraries print to stderr, in a list that is filled after the
    block.

    This replaces file descriptor 2, which belongs to the whole process, so use it only around
    decoding. Meanwhile, output of other threads is lost unless it goes elsewhere (stderr_is_apart).
    Several threads may decode at once; the list then contains the messages of all of them, unless
    the block waits until it is `alone`.
    """
    messages: list[str] = []
    with _STDERR.turn if alone else nullcontext():
        with nullcontext() if alone else _STDERR.turn, _STDERR.changed:
            if alone:
                _STDERR.changed.wait_for(lambda: not _STDERR.users)
            store, start = _STDERR.enter()
        try:
            yield messages
        finally:
            with _STDERR.changed:
                if store is not None:
                    messages.append(_read_from(store.fileno(), start).decode(errors="replace"))
                _STDERR.leave()


def _read_from(descriptor: int, start: int) -> bytes:
    """Return the bytes of a file after `start`, without moving the position at which others
    write.
    """
    if hasattr(os, "pread"):
        return os.pread(descriptor, 1 << 20, start)
    place = os.lseek(descriptor, 0, os.SEEK_CUR)  # Windows
    os.lseek(descriptor, start, os.SEEK_SET)
    found = os.read(descriptor, 1 << 20)
    os.lseek(descriptor, place, os.SEEK_SET)
    return found


def stderr_is_apart() -> bool:
    """Return whether Python's stderr is not file descriptor 2, so that native_stderr does not
    swallow its output.
    """
    try:
        return sys.stderr is None or sys.stderr.fileno() != 2
    except (OSError, ValueError):  # the stream has no descriptor
        return True


# Values of TIFF's PhotometricInterpretation, the meaning of a sample.
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _YCBCR = 0, 1, 2, 6


def decode_tiff(file: BinaryIO, path: Path) -> Array | None:
    """Return the first picture of a TIFF file as stored, (H, W) or (H, W, samples), or None if
    OpenCV must decode it.

    Values increase with brightness: if zero means white in the file, the values are inverted, as
    viewers do. tifffile reads every sample format but lacks decoders for some compressions (LZW).
    Raises InputError if the file is truncated or damaged, or does not contain gray or RGB values.
    """
    with first_page(file, path) as page:
        # A malicious part may expand to a thousand times the size of its pixels, and so may a tile
        # far larger than the picture. Legitimate parts without pixels, such as the tables of a
        # JPEG, have up to 2^16 bytes, and tiles up to 2^24 more than the picture.
        expanded = math.prod(page.chunks) * page.dtype.itemsize
        longest = max(page.databytecounts, default=0)
        if expanded > 2 * page.nbytes + (1 << 24) or longest > 2 * expanded + (1 << 16):
            raise ValueError
        size = os.fstat(file.fileno()).st_size
        parts = zip(page.dataoffsets, page.databytecounts, strict=True)
        if any(count == 0 or offset + count > size for offset, count in parts):
            raise InputError("the TIFF is truncated", path, hint=COPY_AGAIN)
        photometric = int(page.photometric)
        if photometric not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _YCBCR):
            raise InputError(
                f"found a TIFF with the colour model {page.photometric.name}, expected gray or RGB",
                path,
                hint="Export it as RGB",
            )
        pixels = _decode_page(page)
        if photometric == _WHITE_IS_ZERO:
            if pixels is None:
                raise ValueError  # OpenCV would not invert the values
            if pixels.dtype.kind in "ub":
                return ~pixels
    return pixels


_MOST_PAGES = 10_000  # in a TIFF file whose pages are treated as images
MASK_PAGE = -1  # the number that stands for the mask in a .mat file with photographs
_PAGE = re.compile(r"(.+\.(?:tiff?|mat))\[(\d{1,4}|mask)\]", re.IGNORECASE)


def page_of(path: Path) -> tuple[Path, int]:
    """Return the file and the zero-based number of a picture in it.

    The path ends with a page, as named by `pages`, or with a photograph or the mask in a .mat file,
    as in a.mat[0] or a.mat[mask]. The number is 0 for any other path.
    """
    found = _PAGE.fullmatch(path.name)
    if found is None:
        return path, 0
    return path.with_name(found[1]), MASK_PAGE if found[2] == "mask" else int(found[2])


def pages(path: Path) -> list[Path]:
    """Return a path for each page of a TIFF file, such as stack.tif[0], or only the file itself if
    it has a single page, is damaged, or is in another format.
    """
    try:
        with path.open("rb") as file, first_page(file, path) as page:
            count = len(page.parent.pages)
    except (InputError, OSError):
        return [path]
    if not 1 < count < _MOST_PAGES:
        return [path]
    return [path.with_name(f"{path.name}[{number}]") for number in range(count)]


@contextmanager
def first_page(file: BinaryIO, path: Path) -> Iterator[Any]:
    """Yield the first page of an open TIFF file, or the page named in the path. Raises InputError
    for a damaged file.
    """
    import tifffile

    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True  # our error is all that a user needs
    try:
        with damage_as_input_error(path, "the TIFF is damaged and cannot be read", COPY_AGAIN):
            stored, number = page_of(path)
            if number:
                stamp = os.fstat(file.fileno())
                place = _all_places(stored.absolute(), stamp.st_size, stamp.st_mtime_ns)[number]
            else:
                place = next(_places(file))
            file.seek(0)
            with tifffile.TiffFile(file, name=path.name) as tiff:
                tiff.filehandle.seek(place)
                yield tifffile.TiffPage(tiff, index=number)
    finally:
        logger.disabled = before


@lru_cache(maxsize=4)
def _all_places(path: Path, *_: int) -> tuple[int, ...]:
    """Return the results of _places, cached because each page of a file is opened separately."""
    with path.open("rb") as file:
        return tuple(_places(file))


def _places(file: BinaryIO) -> Iterator[int]:
    """Yield the offsets of the pages in an open TIFF file.

    Raises ValueError for too many tags, or for a tag with millions of values, because tifffile
    reads whole tags.
    """
    start = file.read(16)
    order: Literal["little", "big"] = "little" if start[:1] == b"I" else "big"
    big = 43 in start[2:4]  # BigTIFF has wider numbers
    bytes_of, length, entry = (8, 8, 20) if big else (4, 2, 12)
    following = start[8:16] if big else start[4:8]
    total = 0
    for _ in range(_MOST_PAGES):
        place = int.from_bytes(following, order)
        if place == 0:
            return
        file.seek(place)
        total += (count := int.from_bytes(file.read(length), order))
        if total > 1 << 20:
            raise ValueError
        entries = file.read(count * entry)
        following = file.read(8 if big else 4)
        for at in range(0, len(entries), entry):
            tag = int.from_bytes(entries[at : at + 2], order)
            values = int.from_bytes(entries[at + 4 : at + 4 + bytes_of], order)
            # These tags have one value per strip or tile; others, such as colour profiles, have
            # more.
            if values > (1 << 18 if tag in (273, 279, 324, 325) else 1 << 24):
                raise ValueError
        yield place


def tiff_content(file: BinaryIO, path: Path) -> bytes | bytearray:
    """Return the content of an open TIFF file or, if the path names a page, a BigTIFF file with
    only this page.
    """
    if page_of(path)[0] == path:
        return file.read()

    def read(start: int, length: int) -> bytes:
        file.seek(start)
        return file.read(length)

    def append(data: bytes) -> int:
        content.extend(data)
        return len(content) - len(data)

    with first_page(file, path) as page:
        order, tags = page.parent.byteorder, list(page.tags)
        content = bytearray(24 + 20 * len(tags) + 8)
        parts = zip(page.dataoffsets, page.databytecounts, strict=True)
        places = [append(read(*part)) for part in parts]
        start = b"II" if order == "<" else b"MM"
        struct.pack_into(order + "2sHHHQQ", content, 0, start, 43, 8, 0, 16, len(tags))
        for number, tag in enumerate(tags):
            kind, value = int(tag.dtype), read(tag.valueoffset, tag.valuebytecount)
            if tag.code in (273, 324):  # the offsets of strips or tiles, as 8-byte numbers
                kind, value = 16, struct.pack(f"{order}{len(places)}Q", *places)
            if len(value) > 8:
                value = struct.pack(order + "Q", append(value))
            at = 24 + 20 * number
            struct.pack_into(order + "HHQ8s", content, at, tag.code, kind, tag.count, value)
    return content


def _decode_page(page: Any) -> Array | None:
    """Return pixels (H, W) or (H, W, samples), or None if tifffile has no decoder or fails."""
    if int(page.photometric) == _YCBCR:
        return None
    try:
        pixels: Array = page.asarray()
    except Exception as error:  # for a missing codec, the type depends on tifffile's version
        if is_out_of_memory(error):
            raise
        return None
    if page.axes == "SYX":
        pixels = np.moveaxis(pixels, 0, -1)
    return pixels if pixels.ndim in (2, 3) else None


RAW_SUFFIXES = (
    ".dng",
    ".nef",
    ".nrw",
    ".cr2",
    ".cr3",
    ".crw",
    ".arw",
    ".sr2",
    ".srf",
    ".raf",
    ".orf",
    ".rw2",
    ".rwl",
    ".pef",
    ".srw",
    ".3fr",
    ".fff",
    ".iiq",
    ".mos",
    ".mef",
    ".mrw",
    ".erf",
    ".kdc",
    ".dcr",
    ".x3f",
)
"""Suffixes of RAW files. They are recognised by name, because many have the content of a TIFF
file.
"""


def raw_size(path: Path) -> tuple[tuple[int, int, int], int]:
    """Return the shape (H, W, 3) of decode_raw's pixels, and the bytes per value. Raises
    InputError.
    """
    with (
        _libraw(path) as rawpy,
        path.open("rb") as file,
        native_stderr(),
        rawpy.imread(utf8_name(path, file)) as raw,
    ):
        return (raw.sizes.height, raw.sizes.width, 3), 2


def decode_raw(content: bytes, path: Path) -> NDArray[np.uint16]:
    """Return the pixels (H, W, C) of a camera's RAW file, where C is 3 (the camera's red, green and
    blue) or 1 (no colour filters).

    Values are proportional to light, from 0 at the sensor's black level to 65535 at saturation,
    with the same scale for all files of a camera at the same settings. The orientation is ignored,
    as in all images. Raises InputError if rawpy is not installed, or LibRaw cannot read the file.
    """
    with _libraw(path) as rawpy:
        with native_stderr():  # kept short, because it also suppresses progress bars
            raw = rawpy.imread(io.BytesIO(content))
            raw.unpack()
        with raw:
            pixels = raw.postprocess(
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                # Any other white balance may differ between images, or scale red and blue beyond
                # the saturation level.
                user_wb=[1, 1, 1, 1],
                no_auto_bright=True,
                # by default, it may be the maximum of each image
                user_sat=_full_scale(raw),
                highlight_mode=rawpy.HighlightMode.Clip,
                user_flip=0,
                # Other algorithms interpolate differently under each light. They double or triple
                # the errors on textured objects (AHD 1.4 degrees, LINEAR 0.5), but halve them on
                # uniform objects (0.2 and 0.4 degrees).
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            )
    # Some sensors have four colours. The fourth must not become an alpha channel.
    return np.asarray(pixels[:, :, :3], np.uint16)


def read_shot(path: Path) -> tuple[float, float, float]:
    """Return exposure time in seconds, f-number and ISO sensitivity, each zero if the file does not
    state it.

    LibRaw unpacks all pixels for this, so use it only for files that Pillow cannot read. Raises
    InputError.
    """
    with (
        _libraw(path) as rawpy,
        native_stderr(),
        rawpy.imread(io.BytesIO(path.read_bytes())) as raw,
    ):
        return raw.other.shutter_speed, raw.other.aperture, raw.other.iso_speed


def _full_scale(raw: rawpy.RawPy) -> int:
    """Return the value above black from which a photosite is considered saturated."""
    white = raw.white_level
    # LibRaw returns the largest possible value. Many sensors saturate below it, and some files
    # state that level. A level far from the largest value is in another unit.
    stated = raw.camera_white_level_per_channel
    if stated is not None and white / 2 <= min(stated) <= white:
        white = min(stated)
    # The black levels of the colours differ slightly, and the colour with the highest level must
    # also reach full scale. The result is one less because LibRaw truncates after scaling, and
    # otherwise every seventh white level would end at 65534.
    return max(white - max(raw.black_level_per_channel) - 1, 1)


@contextmanager
def _libraw(path: Path) -> Iterator[ModuleType]:
    """Yield rawpy, and convert the errors that it raises for a damaged file to an InputError."""
    otherwise = "export the photographs as 16-bit linear TIFF"
    rawpy = import_extra("rawpy", "raw", error=InputError, path=path, otherwise=otherwise)
    try:
        yield rawpy
    except (rawpy.LibRawError, OSError):
        raise InputError(
            "the RAW file is damaged or from a camera that LibRaw does not support",
            path,
            hint=f"Copy it again, or {otherwise}",
        ) from None
