"""What EXIF tags say of the images of a capture: orientation and exposure, which must be those of all."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from splinecli.capture.formats.facts import ORIENTATION, ImageFacts
from splinecli.capture.formats.raw import read_shot
from splinecli.errors import InputError

UPRIGHT = 1  # orientation of images that are shown as they are stored
_SAME = 0.1  # share within which two exposures count as one: shutters and ISO numbers are rounded
_EXPOSURE_TIME, _F_NUMBER, _ISO = 0x829A, 0x829D, 0x8827


class Exposure(NamedTuple):
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


def find_exposure(facts: ImageFacts) -> Exposure | None:
    """Return the exposure of an image; None where a part of it is missing or the file is damaged."""
    try:
        if facts.exif is None and facts.kind == "RAW":
            numbers: tuple[Any, ...] = read_shot(facts.path)
        else:
            numbers = tuple((facts.exif or {})[tag] for tag in (_EXPOSURE_TIME, _F_NUMBER, _ISO))
        # Some cameras give two ISO numbers.
        exposure = Exposure(*(float(n[0] if isinstance(n, tuple) else n) for n in numbers))
    except Exception:  # damaged tags cause a dozen types of errors
        return None
    return exposure if all(0 < value < math.inf for value in exposure) else None


def check_exposures(images: Sequence[ImageFacts]) -> None:
    """Raise InputError where two images state different exposures."""
    found = [(facts, exposure) for facts in images if (exposure := find_exposure(facts)) is not None]
    for facts, exposure in found[1:]:
        first, expected = found[0]
        if abs(exposure.relative / expected.relative - 1) > _SAME:
            hint = "Expose all images alike, or give each image's exposure as the intensity of its light"
            problem = f"found an exposure of {exposure}, expected {expected} as in {first.path.name}"
            raise InputError(problem, path=facts.path, hint=f"{hint} (--intensities FILE)")


def common_orientation(images: Sequence[ImageFacts]) -> int:
    """Return the EXIF orientation that all images have, 1 to 8; UPRIGHT where they state none.

    RAW files are not asked: their pixels are read as the sensor has them. Raises InputError for two images with
    different ones, whose pixels do not fit on each other.
    """
    asked = [facts for facts in images if facts.kind != "RAW"]
    stated = ((facts.exif or {}).get(ORIENTATION, UPRIGHT) for facts in asked)
    orientations = [int(value) if value in range(1, 9) else UPRIGHT for value in stated]
    for facts, orientation in zip(asked, orientations, strict=True):
        if orientation != orientations[0]:
            problem = f"found EXIF orientation {orientation}, expected {orientations[0]} as in {asked[0].path.name}"
            raise InputError(problem, path=facts.path, hint="Export all images the same way up, without this tag")
    return orientations[0] if orientations else UPRIGHT
