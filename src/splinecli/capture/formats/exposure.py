"""Exposures of images, from their EXIF tags."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splinecli.capture.formats.decoding import native_stderr
from splinecli.capture.formats.raw import is_raw, read_shot
from splinecli.errors import InputError

_EXIF, _EXPOSURE_TIME, _F_NUMBER, _ISO = 0x8769, 0x829A, 0x829D, 0x8827

SAME = 0.1
"""Exposures within this share of each other count as one: shutters and ISO numbers are rounded."""


@dataclass(frozen=True)
class Exposure:
    """Exposure time in seconds, f-number and ISO sensitivity."""

    seconds: float
    f_number: float
    iso: float

    @property
    def relative(self) -> float:
        """A number that the brightness of the image is proportional to."""
        return self.seconds * self.iso / self.f_number**2

    def __str__(self) -> str:
        time = f"1/{1 / self.seconds:.0f}" if self.seconds < 0.3 else f"{self.seconds:g}"
        return f"{time} s, f/{self.f_number:g}, ISO {self.iso:.0f}"


def read_exposure(path: Path) -> Exposure | None:
    """Return the exposure of an image file; None where a part of it is missing or the file is damaged."""
    # Pillow warns of tags that it does not expect. Decoding the image names a damaged file.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            seconds, f_number, iso = _read_raw(path) if is_raw(path) else _read_tags(path)
            exposure = Exposure(
                float(seconds), float(f_number), float(iso[0] if isinstance(iso, tuple) else iso)
            )
        except Exception:  # damaged tags cause a dozen types of errors
            return None
    usable = all(0 < value < math.inf for value in (exposure.seconds, exposure.f_number, exposure.iso))
    return exposure if usable else None


def _read_tags(path: Path) -> tuple[Any, Any, Any]:
    from PIL import Image

    with Image.open(path) as image:
        # Of the base class: see orientation.py.
        tags = Image.Image.getexif(image).get_ifd(_EXIF)
    return tags[_EXPOSURE_TIME], tags[_F_NUMBER], tags[_ISO]


def _read_raw(path: Path) -> tuple[Any, Any, Any]:
    from PIL import Image

    tags = Image.Exif()
    # Pillow cannot decode RAW files, but it reads their header where it is TIFF's, as with most cameras.
    with path.open("rb") as file:
        try:
            tags.load_from_fp(file)
        except SyntaxError:
            with native_stderr():
                return read_shot(path)
        exif = tags.get_ifd(_EXIF)
    return exif[_EXPOSURE_TIME], exif[_F_NUMBER], exif[_ISO]


def check_exposures(images: Sequence[Path]) -> None:
    """Raise InputError where two images state different exposures."""
    first: tuple[Path, Exposure] | None = None
    for path in images:
        exposure = read_exposure(path)
        if exposure is None:
            continue
        if first is None:
            first = path, exposure
        elif abs(exposure.relative / first[1].relative - 1) > SAME:
            raise InputError(
                f"found an exposure of {exposure}, expected {first[1]} as in {first[0].name}",
                path=path,
                hint="Expose all images alike, or give each image's exposure as the intensity of its light"
                " (--intensities FILE)",
            )
