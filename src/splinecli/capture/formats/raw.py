"""Camera RAW files as linear pixels in the camera's own colours, by LibRaw (the extra `raw`)."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.extras import import_extra

if TYPE_CHECKING:
    import rawpy

RAW_SUFFIXES = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".rwl", ".pef",
    ".srw", ".3fr", ".fff", ".iiq", ".mos", ".mef", ".mrw", ".erf", ".kdc", ".dcr", ".x3f",
)  # fmt: skip
"""RAW files are told by name: inside, many look like TIFF."""


def decode_raw(
    data: bytes, path: Path, quiet: Callable[[], AbstractContextManager[object]]
) -> NDArray[np.uint16]:
    """The pixels (H, W, C) of a camera's RAW file, C 3 (the camera's red, green and blue) or 1 (without filters).

    They are proportional to light, from zero at the sensor's black to 65535 where a photosite is saturated, on the
    same scale for all files of a camera at one setting. An orientation is ignored, as in all images.

    Args:
        data: what the file holds.
        path: its name, for messages.
        quiet: keeps what LibRaw mutters away; around reading alone, since it stops progress bars, too.

    Raises:
        InputError: rawpy is not installed, or LibRaw cannot read the file.
    """
    rawpy = _import_rawpy(path)
    try:
        with quiet():
            raw = rawpy.imread(io.BytesIO(data))
            raw.unpack()
        with raw:
            pixels = raw.postprocess(
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                # The camera's white balance or an automatic one would differ from image to image. LibRaw's for
                # daylight is fixed, but lifts red and blue: they would be at full scale before they are saturated.
                user_wb=[1, 1, 1, 1],
                no_auto_bright=True,
                user_sat=_full_scale(raw),  # else it is each image's own maximum, where that is near
                highlight_mode=rawpy.HighlightMode.Clip,
                user_flip=0,
                # The others choose where to interpolate by what they see, so differently under each light. Normals of
                # textured things are two or three times as far off with them (AHD's 1.4 degrees, these 0.5), those
                # of plain ones closer (0.2 and 0.4).
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            )
    except (rawpy.LibRawError, OSError):
        raise InputError(
            "the RAW file is damaged or of a camera that LibRaw does not know",
            path=path,
            hint="Copy it again, or export the photographs as 16-bit linear TIFF",
        ) from None
    # Sensors of four colours exist. The fourth must not pass for an alpha channel.
    return np.asarray(pixels[:, :, :3], np.uint16)


def read_shot(path: Path) -> tuple[float, float, float]:
    """Seconds, f-number and ISO sensitivity, zero where the file does not say.

    LibRaw unpacks the pixels for it, so it is for files that nothing else reads. Raises whatever LibRaw raises.
    """
    with _import_rawpy(path).imread(io.BytesIO(path.read_bytes())) as raw:
        return raw.other.shutter_speed, raw.other.aperture, raw.other.iso_speed


def _full_scale(raw: rawpy.RawPy) -> int:
    """The value above black from which a photosite counts as saturated."""
    white = raw.white_level
    # Many sensors saturate below the largest number, which is what LibRaw gives, and some files tell where. What is
    # far from that number is in another unit.
    told = raw.camera_white_level_per_channel
    if told is not None and white / 2 <= min(told) <= white:
        white = min(told)
    # The colours' black levels differ a little, and the one with the highest has to reach full scale, too. One less,
    # because LibRaw cuts off decimals after scaling: else every seventh white level would end at 65534.
    return max(white - max(raw.black_level_per_channel) - 1, 1)


def _import_rawpy(path: Path) -> ModuleType:
    return import_extra(
        "rawpy",
        "raw",
        error=InputError,
        path=path,
        otherwise="export the photographs as 16-bit linear TIFF",
    )
