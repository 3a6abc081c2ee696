"""Read the pixels of image files exactly as stored, as linear values, or as masks. RAW files are
developed.

Image sizes and the memory that captures need are checked only here, so that messages are the same
everywhere. The check uses the header before anything is decoded, because a file of a few kilobytes
may declare gigabytes of pixels, by mistake or on purpose.

Damaged files are rejected. For a truncated file, OpenCV fills the missing part with gray and only
prints to stderr, so the container is checked before it is decoded, and the messages of the C
libraries are captured and searched.
"""

import math
import os
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splinecli.capture.formats import decoders, facts, mat
from splinecli.errors import InputError
from splinecli.maths import Array, Bools, Float32Array
from splinecli.system.files import StrPath
from splinecli.system.machine import LARGEST_IMAGE, available_memory


@dataclass(frozen=True)
class ExpectedSize:
    """The size that an image is expected to have."""

    shape: tuple[int, ...]  # (H, W) or (H, W, C)
    like: str  # the source of this size, for messages, such as the name of the first image
    what: str = "an image"  # description of the image, with an article

    def check(self, found: tuple[int, ...], path: Path) -> None:
        """Raise InputError if an image (H, W) or (H, W, C) at `path` has another height or
        width.
        """
        if found[:2] != self.shape[:2]:
            raise InputError(
                f"found {self.what} of {_size(found)} pixels, expected {_size(self.shape)} as in"
                f" {self.like}",
                path,
            )


def check_stored_size(
    shape: tuple[int, ...], item_bytes: int, path: Path, expected: ExpectedSize | None = None
) -> None:
    """Raise InputError if an image (H, W) or (H, W, C) does not have the expected size, has no
    pixels, or is too large to be read.
    """
    if expected is not None:
        expected.check(shape, path)
    if 0 in shape[:2]:
        raise InputError(f"found an image of {_size(shape)} pixels, expected at least one", path)
    n_pixels, n_bytes = math.prod(shape[:2]), image_bytes(shape, item_bytes)
    takes = f"found an image of {_size(shape)} pixels, which takes"
    if n_pixels > LARGEST_IMAGE:
        raise InputError(
            f"{takes} {n_bytes / 1e9:.1f} GB of memory, expected at most {LARGEST_IMAGE / 1e6:g}"
            " megapixels",
            path,
            hint="If the size is correct, use a smaller copy of the image",
        )
    check_memory(n_bytes, takes, path)


def check_vectors(shape: tuple[int, ...], path: Path) -> None:
    """Raise InputError if an array is not H x W x 3."""
    if len(shape) != 3 or shape[2] != 3:
        sizes = " x ".join(map(str, shape))
        raise InputError(f"found an array of {sizes}, expected a normal map, H x W x 3", path)


def image_bytes(shape: tuple[int, ...], item_bytes: int) -> int:
    """Return the bytes of memory that an image takes as stored and in float32 together."""
    return math.prod(shape) * (item_bytes + 4)


def check_memory(n_bytes: int, takes: str, path: Path, *, hint: str | None = None) -> None:
    """Raise InputError if less memory is available. `takes` is the subject and verb of the
    message.
    """
    available = available_memory()
    if n_bytes > available:
        raise InputError(
            f"{takes} {n_bytes / 1e9:.1f} GB of memory, but {available / 1e9:.1f} GB are available",
            path,
            hint=hint,
        )


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"


def common_size(images: Sequence[facts.ImageHeader]) -> facts.StoredSize:
    """Return the size of the image that takes the most memory.

    Raises InputError if an image differs from the first in height or width, is too large, or has an
    incomplete header.
    """
    first = images[0]
    check_stored_size(*first.size, first.path)
    expected = ExpectedSize(first.size[0], first.path.name)
    # Opening a RAW file is slow, so its size is not checked until it is decoded.
    asked = [first, *(image for image in images[1:] if image.kind != "RAW")]
    for image in asked[1:]:
        expected.check(image.size[0], image.path)
    return max((image.size for image in asked), key=lambda size: image_bytes(*size))


# In a JPEG's scan, FF is followed by 00 (stuffing), D0-D7 (a restart) or FF (fill). Anything else
# ends the scan.
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# Messages from libpng and libjpeg about pixels that could not be read
_DAMAGE = re.compile(
    r"premature end|bad huffman|corrupt jpeg data(?!.*extraneous)|libpng error", re.IGNORECASE
)


def decode_image(path: Path, expected: ExpectedSize | None = None) -> Array:
    """Return the pixels (H, W, C) of an image file as stored, without alpha; C is 1 or 3 (RGB).

    The dtype is the file's: uint8, uint16, float16, float32 or float64 (bool becomes uint8 0 or
    255). Formats are recognised by their content, except RAW files, which are recognised by name
    and developed (see decode_raw). The EXIF orientation is ignored, because all images of a capture
    share one pixel grid. The header is compared with the expected size.

    Raises:
        InputError: the file is missing, truncated, damaged or in an unknown format; it is a RAW
            file but rawpy is not installed; or the image does not have the expected size or is too
            large (see check_stored_size).
    """
    return decode_with_alpha(path, expected)[0]


def decode_with_alpha(
    path: Path, expected: ExpectedSize | None = None
) -> tuple[Array, Array | None]:
    """Return the pixels as decode_image does, and the alpha channel (H, W) or None. Raises
    InputError.
    """
    damage = decoders.damage_as_input_error(path, decoders.DAMAGED, decoders.COPY_AGAIN)
    with damage, facts.open_image(path) as (file, kind):
        size = facts.facts_in(file, kind, path).size
        check_stored_size(*size, path, expected)
        # The whole file is read, so it is limited, with 64 MB for previews and colour profiles. Of
        # a TIFF with many pages, only one is read.
        length, most = os.fstat(file.fileno()).st_size, image_bytes(*size) + (1 << 26)
        if length > most and decoders.page_of(path)[0] == path:
            raise InputError(
                f"found {length / 1e6:.1f} MB, expected at most {most / 1e6:.1f} MB for an image"
                " of this size",
                path,
            )
        file.seek(0)
        pixels = _decode(file, kind, path)
    if expected is not None:
        expected.check(pixels.shape, path)
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.shape[2] not in (1, 2, 3, 4):
        raise InputError(f"found {pixels.shape[2]} channels, expected 1 (gray) or 3 (RGB)", path)
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    if pixels.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise InputError(
            f"found {pixels.dtype} pixels, expected 8-bit, 16-bit or floating-point pixels",
            path,
            hint="Save the image with 16 bits",
        )
    if pixels.shape[2] in (2, 4):
        return pixels[:, :, :-1], pixels[:, :, -1]
    return pixels, None


def _decode(file: BinaryIO, kind: str, path: Path) -> Array:
    """Return the pixels (H, W) or (H, W, C) of an open file of any kind, including alpha."""
    if kind == "RAW":
        return decoders.decode_raw(file.read(), path)
    if kind == "MAT":
        check_memory(mat.stack_bytes(path), "the array of all photographs takes", path)
        return mat.read_picture(path)
    if kind == "TIFF":
        pixels = decoders.decode_tiff(file, path)
        if pixels is not None:
            return pixels
        file.seek(0)
        return _decode_with_opencv(decoders.tiff_content(file, path))
    if kind in facts.PILLOW_KINDS:
        with facts.open_with_pillow(file, kind, path) as picture:
            mode = {"1": "L", "L": "L", "LA": "LA", "RGBA": "RGBA"}.get(picture.mode, "RGB")
            return np.asarray(picture.convert(mode))
    data = file.read()
    if kind in ("PGM", "PPM"):
        width, height, most, start = facts.pnm_header(data) or (0, 0, 0, 0)
        shape, dtype = (height, width, 1 if kind == "PGM" else 3), ">u2" if most > 255 else "u1"
        if len(data) < start + math.prod(shape) * np.dtype(dtype).itemsize:
            raise InputError(f"the {kind} is truncated", path, hint=decoders.COPY_AGAIN)
        return np.frombuffer(data, dtype, math.prod(shape), start).reshape(shape).astype(dtype[-2:])
    (_check_png if kind == "PNG" else _check_jpeg)(data, path)
    return _decode_with_opencv(data)


def _decode_with_opencv(data: bytes | bytearray) -> Array:
    """Return pixels (H, W) or (H, W, C), as RGB or RGBA. Raises ValueError or cv2.error for a
    damaged file.
    """
    import cv2

    pixels, damaged = _imdecode(data)
    if damaged:  # possibly a file that another thread was decoding at the same time
        pixels, damaged = _imdecode(data, alone=True)
    if pixels is None or damaged:
        raise ValueError
    if pixels.ndim == 2 or pixels.shape[2] not in (3, 4):
        return pixels
    if pixels.dtype in (np.uint8, np.uint16, np.float32):
        code = cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
        # Works in place and is far faster than indexing
        return cv2.cvtColor(pixels, code, dst=pixels)
    return pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]]


def _imdecode(data: bytes | bytearray, *, alone: bool = False) -> tuple[Array | None, bool]:
    """Return OpenCV's pixels or None, and whether a decoder reported damage. See native_stderr for
    `alone`.
    """
    import cv2

    with decoders.native_stderr(alone=alone) as messages:
        try:
            # IMREAD_UNCHANGED keeps 16 bits and the alpha channel, and ignores the EXIF
            # orientation.
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            if error.code == cv2.Error.StsNoMem:
                raise MemoryError from None
            raise
    return pixels, _DAMAGE.search("".join(messages)) is not None


def _check_png(data: bytes, path: Path) -> None:
    """Raise InputError unless all chunks up to IEND are complete and have correct checksums."""
    position, view = len(facts.PNG), memoryview(data)
    for _ in range(10_000 + len(data) // 1024):  # encoders write chunks of at least 8 kB
        if position + 12 > len(data):
            break
        length = int.from_bytes(data[position : position + 4], "big")
        body, end = position + 4, position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[body : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise InputError(
                "the PNG is damaged (a checksum is wrong)", path, hint=decoders.COPY_AGAIN
            )
        if data[body : body + 4] == b"IEND":
            return
        position = end
    raise InputError("the PNG is truncated", path, hint=decoders.COPY_AGAIN)


def _check_jpeg(data: bytes, path: Path) -> None:
    """Raise InputError unless there is an end-of-image marker. A second picture after it is
    ignored.
    """
    position = 2
    while position + 2 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xD9:
            return
        if marker == 0xFF:  # fill
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xDA:  # a scan: compressed pixels of unknown length follow its header
            following = _END_OF_SCAN.search(data, position)
            if following is None:
                break
            position = following.start()
    raise InputError("the JPEG is truncated", path, hint=decoders.COPY_AGAIN)


def read_image(path: StrPath, expected: ExpectedSize | None = None) -> Float32Array:
    """Return an image (H, W, C) float32 whose values are assumed to be linear; C is 1 (gray) or 3
    (RGB).

    8- and 16-bit values are scaled so that full scale becomes 1, and floating-point values are
    kept. Alpha is dropped, and the EXIF orientation is ignored.

    Raises:
        InputError: see decode_image; also if a floating-point value is negative or not finite.
    """
    return to_linear(decode_image(Path(path), expected), Path(path))


def to_linear(stored: Array, path: Path) -> Float32Array:
    """Return stored values of any shape as float32, scaled as by read_image.

    Raises InputError for a floating-point value that is negative or not finite.
    """
    with np.errstate(over="ignore"):  # values beyond float32 become infinite and are rejected below
        values = stored.astype(np.float32)
    if stored.dtype.kind == "u":
        values /= np.float32(np.iinfo(stored.dtype).max)
        return values
    # If any value is NaN or infinite, so is one of these. Calling np.isfinite on all values would
    # take another array.
    lowest, highest = (values.min(), values.max()) if values.size else (0.0, 0.0)
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise InputError(
            "found a value that is not finite (NaN or infinity), expected a photograph", path
        )
    if lowest < 0:
        raise InputError(
            f"found the negative value {lowest:g}, expected a photograph",
            path,
            hint="Set negative values, for example noise after dark-frame subtraction, to zero",
        )
    return values


def read_mask(path: StrPath, expected: ExpectedSize | None = None) -> Bools:
    """Return a mask (H, W) bool, true where any channel is above half of the image's largest value.

    Masks may thus use 0 and 1, or 0 and 255. If an alpha channel cuts something out, it alone is
    the mask, because the colours of such an image are meaningless. Raises InputError if the image
    cannot be read, or no pixel is above zero.
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
            path,
            hint="Paint the object white, or omit the mask",
        )
    return np.asarray((stored > stored.max() / 2).any(axis=2))


def cut_out(alpha: Array | None) -> Bools | None:
    """Return the opaque pixels (H, W) of an alpha channel, or None if it cuts nothing out.

    Pixels above half of the largest alpha are opaque. A channel that is opaque everywhere or
    nowhere cuts nothing out.
    """
    opaque = None if alpha is None else np.asarray(alpha > alpha.max() / 2)
    return opaque if opaque is not None and opaque.any() and not opaque.all() else None
