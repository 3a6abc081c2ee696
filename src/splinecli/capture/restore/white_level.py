"""The white level of a capture: the stored value at which its camera saturated.

Cameras of 10 to 14 bits often store their values in 16-bit files without scaling them, so that nothing ever reaches the
file's full scale. Clipping still shows in the values. Many observations share the images' exact maximum, and far fewer
have the values just below it. On a smooth surface without clipping, the maximum is no more frequent than they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.restore.saturation import find_saturated
from splinecli.errors import InputError

Origin = Literal["given", "file", "images", "full scale"]

FEWEST_IMAGES = 3
"""An image counts as clipped at the common maximum only if at least this many images reach it..."""

FEWEST_IMAGES_AT_BITS = 2
"""... or this many, if the maximum is the largest number of 8 to 15 bits."""

FEWEST_PIXELS, SMALLEST_SHARE = 3, 1e-4
"""An image reaches the maximum at no fewer pixels, and at no smaller share of the pixels."""

COMPARED_VALUES = 16
"""The number of different values below the maximum whose observations are counted."""

LOWEST_COMPARED = 0.5
"""They must not be smaller than this share of the maximum: clipping cuts through a continuous range of values."""

SPIKE = 5
"""The maximum occurs at least this many times as often as any of the compared values."""

_BLOCK = 1 << 20
_FULL_SCALE_16_BIT = 65_535


@dataclass(frozen=True)
class WhiteLevel:
    """The stored value from which observations count as saturated.

    Args:
        value: in the unit of the files, such as 4095.
        origin: "given" by the user, stated in the "file", seen in the "images", or the "full scale" of the files.
    """

    value: float
    origin: Origin


class SaturationFinder:
    """Find the saturated observations of a capture from its images, one at a time.

    Args:
        n_pixels: P, the number of the mask's pixels.
        n_images: F.
        given: the white level that the user gave; None to find it.
        stated: the white level that the files state, 2^bits - 1 for a number of bits; None where they state none.
    """

    def __init__(
        self, n_pixels: int, n_images: int, *, given: float | None = None, stated: int | None = None
    ) -> None:
        self.shape = n_pixels, n_images
        self.given, self.stated = given, stated
        self._full_scale: float | None = None
        self._saturated: dict[int, NDArray[np.integer]] = {}  # image -> its saturated pixels
        # Of 16-bit images: the largest value so far, the pixels that have it, and how often each value occurs there.
        self._maximum = 0
        self._at_maximum: dict[int, NDArray[np.integer]] = {}
        self._counts = np.zeros(_FULL_SCALE_16_BIT + 1, np.int64)

    def add(self, position: int, pixels: NDArray[Any], path: Path) -> None:
        """Add the mask's pixels (P, C) of the image at this position, as stored.

        Raises:
            InputError: the white level that the user gave is above the image's full scale.
        """
        if pixels.dtype.kind == "u":
            full_scale = int(np.iinfo(pixels.dtype).max)
            self._full_scale = max(self._full_scale or 0.0, float(full_scale))
            if self.given is not None and self.given > full_scale:
                raise InputError(
                    f"the white level is {self.given:g}, but {full_scale.bit_length()}-bit pixels end at {full_scale}",
                    path=path,
                    hint="Lower the white level, or leave it out",
                )
        if self.given is not None:
            saturated = np.asarray((pixels >= self.given).any(axis=1))
            self._keep(self._saturated, position, saturated)
            return
        self._keep(self._saturated, position, find_saturated(pixels))
        if pixels.dtype == np.uint16 and pixels.size:
            self._follow_maximum(position, pixels)

    def finish(self) -> tuple[WhiteLevel | None, NDArray[np.bool_] | None]:
        """Return the white level and the saturated observations (P, F).

        The level is None for floating-point images, which have none; the observations are None where none is
        saturated.
        """
        level, saturated = self._decide()
        if not saturated:
            return level, None
        flags = np.zeros(self.shape, np.bool_)
        for position, pixels in saturated.items():
            flags[pixels, position] = True
        return level, flags

    def _decide(self) -> tuple[WhiteLevel | None, dict[int, NDArray[np.integer]]]:
        if self.given is not None:
            return WhiteLevel(float(self.given), "given"), self._saturated
        if self._full_scale is None:
            return None, {}
        at_full_scale = WhiteLevel(self._full_scale, "full scale"), self._saturated
        if self._maximum in (0, _FULL_SCALE_16_BIT) or self._saturated:
            return at_full_scale
        stated = self._stated_level()
        if stated is not None:
            return WhiteLevel(stated, "file"), self._at_maximum if self._maximum >= stated else {}
        if self._is_clipped():
            return WhiteLevel(self._maximum, "images"), self._at_maximum
        return at_full_scale

    def _keep(self, store: dict[int, NDArray[np.integer]], position: int, flags: NDArray[np.bool_]) -> None:
        # Indices, not flags: few observations are saturated, and large captures have billions.
        pixels = np.flatnonzero(flags)
        if len(pixels):
            store[position] = pixels.astype(np.int32 if len(flags) < 2**31 else np.int64)

    def _follow_maximum(self, position: int, pixels: NDArray[np.uint16]) -> None:
        maximum = int(pixels.max())
        if maximum > self._maximum:
            self._maximum = maximum
            self._at_maximum.clear()
            self._counts[:] = 0
        if maximum < self._maximum:
            return
        self._keep(self._at_maximum, position, (pixels == maximum).any(axis=1))
        values = pixels.reshape(-1)
        for start in range(0, len(values), _BLOCK):
            self._counts += np.bincount(values[start : start + _BLOCK], minlength=len(self._counts))

    def _stated_level(self) -> int | None:
        """Return the level by the number of bits that the files state.

        PNG asks for values that are shifted to fill 16 bits. Many programs store them unshifted.
        """
        if self.stated is None or self._maximum <= self.stated:
            return self.stated
        bits = self.stated.bit_length()
        return self.stated << (16 - bits) if self.stated + 1 == 1 << bits else None

    def _is_clipped(self) -> bool:
        """Return whether 16-bit images look clipped at their common maximum."""
        fewest = max(FEWEST_PIXELS, SMALLEST_SHARE * self.shape[0])
        reaching = [pixels for pixels in self._at_maximum.values() if len(pixels) >= fewest]
        if len(reaching) < (FEWEST_IMAGES_AT_BITS if _is_bits(self._maximum) else FEWEST_IMAGES):
            return False
        # A flat background has one value under all lights. Clipped pixels are bright under some lights only.
        images_at_maximum = np.bincount(np.concatenate(reaching), minlength=self.shape[0])
        number = int(images_at_maximum[images_at_maximum < len(reaching)].sum())
        below = np.flatnonzero(self._counts[: self._maximum])[-COMPARED_VALUES:]
        if len(below) < COMPARED_VALUES or below[0] < LOWEST_COMPARED * self._maximum:
            return False
        return number >= SPIKE * int(self._counts[below].max())


def _is_bits(level: int) -> bool:
    """Return whether the level is 2^bits - 1, shifted to fill 16 bits or not, for 8 to 15 bits."""
    return any(level in ((1 << bits) - 1, ((1 << bits) - 1) << (16 - bits)) for bits in range(8, 16))
