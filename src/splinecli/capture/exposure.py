"""How long a camera exposed a photograph, from its EXIF tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splinecli.errors import InputError

_EXIF, _EXPOSURE_TIME, _F_NUMBER, _ISO = 0x8769, 0x829A, 0x829D, 0x8827

SAME = 0.1
"""Exposures within this share of each other count as one: shutters and ISO numbers are rounded."""


@dataclass(frozen=True)
class Exposure:
    """Seconds, f-number and ISO sensitivity."""

    seconds: float
    f_number: float
    iso: float

    @property
    def relative(self) -> float:
        """What brightness is proportional to."""
        return self.seconds * self.iso / self.f_number**2

    def __str__(self) -> str:
        time = f"1/{1 / self.seconds:.0f}" if self.seconds < 0.3 else f"{self.seconds:g}"
        return f"{time} s, f/{self.f_number:g}, ISO {self.iso:.0f}"


def read_exposure(path: Path) -> Exposure | None:
    """Of an image file; None where it does not say, or not all."""
    from PIL import Image

    try:
        with Image.open(path) as image:  # reads the header alone
            tags = image.getexif().get_ifd(_EXIF)
        seconds, f_number, iso = tags[_EXPOSURE_TIME], tags[_F_NUMBER], tags[_ISO]
        exposure = Exposure(float(seconds), float(f_number), float(iso[0] if isinstance(iso, tuple) else iso))
    except Exception:  # damaged tags surface as any of a dozen types, and are no reason to refuse the picture
        return None
    usable = all(0 < value < math.inf for value in (exposure.seconds, exposure.f_number, exposure.iso))
    return exposure if usable else None


def check_exposures(images: Sequence[Path]) -> None:
    """Raise InputError where the images tell that they were not all exposed alike."""
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
                hint="Set the camera to manual for all images; or give each its exposure as its light's intensity"
                " (--intensities)",
            )
