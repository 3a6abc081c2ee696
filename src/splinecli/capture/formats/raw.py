"""Linear pixels of camera RAW files in the camera's own colours, by LibRaw (the extra `raw`)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.damage import native_stderr
from splinecli.errors import InputError
from splinecli.system.files import utf8_name
from splinecli.system.machine import import_extra

if TYPE_CHECKING:
    import rawpy

RAW_SUFFIXES = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".rwl", ".pef",
    ".srw", ".3fr", ".fff", ".iiq", ".mos", ".mef", ".mrw", ".erf", ".kdc", ".dcr", ".x3f",
)  # fmt: skip
"""RAW files count by their names, because the content of many looks like TIFF."""


def raw_size(path: Path) -> tuple[tuple[int, int, int], int]:
    """Return the shape (H, W, 3) of decode_raw's pixels, and the bytes of each number. Raises InputError."""
    with _libraw(path) as rawpy, path.open("rb") as file, native_stderr(), rawpy.imread(utf8_name(path, file)) as raw:
        return (raw.sizes.height, raw.sizes.width, 3), 2


def decode_raw(content: bytes, path: Path) -> NDArray[np.uint16]:
    """Return the pixels (H, W, C) of a camera's RAW file, C 3 (the camera's red, green and blue) or 1 (no filters).

    They are proportional to light, from 0 at the sensor's black to 65535 where a photosite is saturated. All files of a
    camera at one setting have the same scale. An orientation is ignored, as in all images.

    Raises:
        InputError: rawpy is not installed, or LibRaw cannot read the file.
    """
    with _libraw(path) as rawpy:
        with native_stderr():  # not longer, because it stops progress bars, too
            raw = rawpy.imread(io.BytesIO(content))
            raw.unpack()
        with raw:
            pixels = raw.postprocess(
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                # Other white balances differ between images, or bring red and blue to full scale before saturation.
                user_wb=[1, 1, 1, 1],
                no_auto_bright=True,
                user_sat=_full_scale(raw),  # the default is each image's own maximum, if that is near
                highlight_mode=rawpy.HighlightMode.Clip,
                user_flip=0,
                # Others interpolate differently under each light: normals of textured objects have two to three
                # times the error (AHD 1.4 degrees, LINEAR 0.5), those of uniform objects half of it (0.2, 0.4).
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            )
    # Some sensors have four colours. The fourth must not become an alpha channel.
    return np.asarray(pixels[:, :, :3], np.uint16)


def read_shot(path: Path) -> tuple[float, float, float]:
    """Return exposure time in seconds, f-number and ISO sensitivity, each zero where the file does not state it.

    LibRaw unpacks all pixels for this, so use it only for files that nothing else reads. Raises InputError.
    """
    with _libraw(path) as rawpy, native_stderr(), rawpy.imread(io.BytesIO(path.read_bytes())) as raw:
        return raw.other.shutter_speed, raw.other.aperture, raw.other.iso_speed


def _full_scale(raw: rawpy.RawPy) -> int:
    """Return the value above black from which a photosite counts as saturated."""
    white = raw.white_level
    # LibRaw gives the largest number. Many sensors saturate below it, and some files state the level. A level far from
    # the largest number is in another unit.
    stated = raw.camera_white_level_per_channel
    if stated is not None and white / 2 <= min(stated) <= white:
        white = min(stated)
    # The black levels of the colours differ a little, and the colour with the highest must reach full scale, too. It is
    # one less because LibRaw drops decimals after scaling: otherwise every seventh white level would end at 65534.
    return max(white - max(raw.black_level_per_channel) - 1, 1)


@contextmanager
def _libraw(path: Path) -> Iterator[ModuleType]:
    """Yield rawpy. What it raises for a damaged file becomes an InputError."""
    otherwise = "export the photographs as 16-bit linear TIFF"
    rawpy = import_extra("rawpy", "raw", error=InputError, path=path, otherwise=otherwise)
    try:
        yield rawpy
    except (rawpy.LibRawError, OSError):
        problem = "the RAW file is damaged or of a camera that LibRaw does not know"
        raise InputError(problem, path=path, hint=f"Copy it again, or {otherwise}") from None
