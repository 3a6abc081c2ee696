"""Information missing from image values: the white level, and saturated observations.

The white level of a capture is the stored value at which its camera saturated. Cameras of 10 to 14
bits often store their values in 16-bit files without scaling them, so that nothing ever reaches the
file's full scale. Clipping is still visible in the values, because many observations share the
exact maximum of the images, and far fewer have the values just below it. Without clipping, the
maximum on a smooth surface is not more frequent than these values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Integers
from splinecli.maths.robust import absolute_weights, fit_scaled_normals, shade, shadow_weights
from splinecli.records.capture_warnings import WHITE_LEVEL, CaptureWarning
from splinecli.records.white_level import WhiteLevel

# From p rows of the observations to light vectors (F, 3) or (p, F, 3). Their dot products with the
# scaled normal of a matte pixel are its observations.
LightsOf = Callable[[Integers], Float64Array]


def find_saturated(pixels: Array) -> Bools:
    """Return which stored pixels (P, C) have a channel at full scale, as booleans (P,), never for
    floating-point pixels.
    """
    if pixels.dtype.kind != "u":
        return np.zeros(len(pixels), np.bool_)
    return in_any_channel(pixels == np.iinfo(pixels.dtype).max)


def in_any_channel(flags: Bools) -> Bools:
    """Return flags.any(axis=1) for flags (P, C), C at most 3, but several times as fast."""
    return np.asarray(reduce(np.logical_or, flags.T))


def restore_saturated(
    observations: Float32Array, saturated: Bools, lights: Float64Array | LightsOf
) -> Bools | None:
    """Replace saturated observations (P, F) with estimates in place; return which were replaced, or
    None.

    A saturated observation was at least as bright as stored. Its estimate is the prediction of a
    robust Lambertian fit to the pixel (least absolute deviations by reweighting) or the stored
    value, whichever is brighter. The fit is repeated on the restored values, so a saturated
    observation can only raise the fitted values. Without this, a pixel would either lose its
    brightest observations, or its normal would tilt towards the mean of the lights (figures in
    docs/measurements.md). Pixels that are saturated under every light are left unchanged. The
    lights are unit directions (F, 3), or see LightsOf.
    """
    everywhere = np.asarray(saturated.all(axis=1))
    rows = np.flatnonzero(saturated.any(axis=1) & ~everywhere)
    for start in range(0, len(rows), 8192):
        tile = rows[start : start + 8192]
        own = lights(tile) if callable(lights) else lights
        observations[tile] = _restored(observations[tile], saturated[tile], own.astype(np.float32))
    return saturated & ~everywhere[:, None] if len(rows) else None


def _restored(stored: Float32Array, saturated: Bools, lights: Float32Array) -> Float32Array:
    scale = stored.max(axis=1, keepdims=True)
    scale[scale <= 0] = 1
    values = lowest = stored / scale
    weights = lit = shadow_weights(lowest)
    for _ in range(16):  # further fits change the restored values by less than the error of the fit
        predicted = shade(fit_scaled_normals(values, weights, lights), lights)
        residuals = predicted - lowest
        raised = saturated & (residuals > 0)
        # No observation is restored to more than eight times the pixel's brightest stored value.
        values = np.where(raised, np.minimum(predicted, 8.0), lowest)
        # An observation that agrees with the fit has a weight of 50, so raised observations matter
        # only if the others do not suffice.
        weights = lit * np.where(raised, np.float32(0.1), absolute_weights(residuals))
    # Rounding must not make a value darker than stored.
    return np.asarray(np.where(saturated, np.maximum(values * scale, stored), stored))


COMPARED_VALUES = 16  # number of distinct values below the maximum whose observations are counted
_BLOCK = 1 << 20
_FULL_SCALE_16_BIT = 65_535


def check_white_level(value: float | None) -> None:
    """Raise UsageError unless the white level is a number above 0."""
    if value is not None and not 0 < value < math.inf:
        raise UsageError(f"the white level is {value:g}, expected a number above 0")


def white_level_warnings(level: WhiteLevel | None) -> list[CaptureWarning]:
    """Warn about a white level that was found in the images because no file states it."""
    if level is None or level.origin != "images":
        return []
    text = (
        f"The images seem to be clipped at {level.value:g}, so this value is treated as saturated."
    )
    return [CaptureWarning(WHITE_LEVEL, f"{text} Use --white-level N to set another value.")]


_NOTHING = np.empty(0, np.int64)


class ImageValues(NamedTuple):
    """Values that decide whether observations of one image are saturated."""

    # the largest value that the file can store; None for floating-point images
    full_scale: int | None
    stated: int | None  # the white level stated in the file, or None
    # the pixels at the given white level or above, or at full scale if none is given
    saturated: Integers
    maximum: int = 0  # the largest value of a 16-bit image; 0 for other images
    at_maximum: Integers = _NOTHING  # the pixels with this value
    # the largest values below the maximum, at most COMPARED_VALUES and none below half of it
    below: NDArray[np.int64] = _NOTHING
    counts: NDArray[np.int64] = _NOTHING  # how often each of these values occurs


@dataclass(frozen=True, eq=False)
class Saturation:
    """The white level of some images and their saturated observations, decided from these images
    alone.
    """

    n_pixels: int  # P, the number of the mask's pixels
    images: tuple[ImageValues, ...]
    given: float | None = None  # the white level from the user; None to determine it
    # the pixels whose observations are needed; None for all. The level is always determined from
    # all pixels
    rows: Integers | None = None
    # whether the images show a uniform target, of which a single image may be clipped, even
    # completely
    even: bool = False

    @property
    def white_level(self) -> WhiteLevel | None:
        """The white level, or None for floating-point images, which have none."""
        return self._decision[0]

    @cached_property
    def flags(self) -> Bools | None:
        """The saturated observations (P, F), or None if none is saturated."""
        _, saturated = self._decision
        if not any(len(pixels) for pixels in saturated):
            return None
        rows = slice(None) if self.rows is None else self.rows
        flags = np.zeros(
            (self.n_pixels if self.rows is None else len(self.rows), len(saturated)), np.bool_
        )
        for position, pixels in enumerate(saturated):
            column = np.zeros(self.n_pixels, np.bool_)
            column[pixels] = True
            flags[:, position] = column[rows]
        return flags

    @property
    def bits(self) -> int | None:
        """The bit depth of a camera whose values seem to be stored in 16-bit files without scaling,
        or None.

        Scaled values of a smaller bit depth have common divisors.
        """
        level = self.white_level
        if level is None or level.origin != "full scale" or level.value != _FULL_SCALE_16_BIT:
            return None
        values = np.concatenate([np.append(image.below, image.maximum) for image in self.images])
        bits = next((bits for bits in (10, 12, 14) if values.max() < 1 << bits), None)
        return bits if np.gcd.reduce(values) == 1 else None

    @property
    def n_saturated(self) -> NDArray[np.int64]:
        """The number of saturated observations of each image (F,), among all pixels."""
        return np.array([len(pixels) for pixels in self._decision[1]], np.int64)

    def choose_images(self, positions: Sequence[int]) -> Saturation:
        """Return the white level and the saturated observations of some of the images, determined
        only from these images.
        """
        return replace(self, images=tuple(self.images[position] for position in positions))

    def choose_pixels(self, rows: Integers) -> Saturation:
        """Return the same white level with the observations of some pixels."""
        return replace(self, rows=rows if self.rows is None else self.rows[rows])

    @cached_property
    def _decision(self) -> tuple[WhiteLevel | None, list[Integers]]:
        saturated = [image.saturated for image in self.images]
        if self.given is not None:
            return WhiteLevel(float(self.given), "given"), saturated
        full_scale = max((image.full_scale or 0 for image in self.images), default=0)
        if not full_scale:
            return None, saturated
        maximum = max(image.maximum for image in self.images)
        if maximum not in (0, _FULL_SCALE_16_BIT) and not any(len(pixels) for pixels in saturated):
            at_maximum = [
                image.at_maximum if image.maximum == maximum else _NOTHING for image in self.images
            ]
            stated = self._stated_level(maximum)
            if stated is not None:
                return WhiteLevel(stated, "file"), at_maximum if maximum >= stated else saturated
            if self._is_clipped(maximum):
                return WhiteLevel(maximum, "images"), at_maximum
        return WhiteLevel(float(full_scale), "full scale"), saturated

    def _stated_level(self, maximum: int) -> int | None:
        # PNG requires values that are shifted to fill 16 bits. Many programs store them unshifted.
        levels = {image.stated for image in self.images}
        stated = levels.pop() if len(levels) == 1 else None
        if stated is None or maximum <= stated:
            return stated
        bits = stated.bit_length()
        return stated << (16 - bits) if stated + 1 == 1 << bits else None

    def _is_clipped(self, maximum: int) -> bool:
        """Return whether 16-bit images look clipped at their common maximum."""
        images = [image for image in self.images if image.maximum == maximum]
        fewest_pixels = max(3, 1e-4 * self.n_pixels)
        reaching = [image.at_maximum for image in images if len(image.at_maximum) >= fewest_pixels]
        even_at_bits = self.even and _is_bits(maximum)
        # images that reach a common maximum
        fewest = 1 if even_at_bits else 2 if _is_bits(maximum) else 3
        if len(reaching) < fewest:
            return False
        # A flat background has the same value under all lights. Clipped pixels are bright only
        # under some lights.
        images_at_maximum = np.bincount(np.concatenate(reaching), minlength=self.n_pixels)
        number = int(images_at_maximum[images_at_maximum < max(len(reaching), 2)].sum())
        # The largest values of all images are among the largest of each image, with complete
        # counts.
        below, places = np.unique(
            np.concatenate([image.below for image in images]), return_inverse=True
        )
        if len(below) < COMPARED_VALUES and not even_at_bits:
            return False
        counts = np.zeros(len(below), np.int64)
        np.add.at(counts, places, np.concatenate([image.counts for image in images]))
        return number >= 5 * int(counts[-COMPARED_VALUES:].max(initial=0))


def look_at(
    pixels: Array, path: Path, *, given: float | None = None, stated: int | None = None
) -> ImageValues:
    """Return the values that decide which of an image's pixels (P, C), as stored, are saturated.

    `given` is the white level from the user, None to determine it; `stated` is the white level
    stated in the file (2^bits - 1 for a bit depth), or None. Raises InputError if the given level
    is above the image's full scale.
    """
    full_scale = int(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else None
    if given is not None:
        if full_scale is not None and given > full_scale:
            problem = (
                f"the white level is {given:g}, but {full_scale.bit_length()}-bit pixels end at"
                f" {full_scale}"
            )
            raise InputError(problem, path=path, hint="Lower the white level, or omit it")
        return ImageValues(full_scale, stated, _indices(in_any_channel(pixels >= given)))
    maximum = int(pixels.max(initial=0)) if pixels.dtype == np.uint16 else 0
    if not maximum:
        return ImageValues(full_scale, stated, _indices(find_saturated(pixels)))
    at_maximum = _indices(in_any_channel(pixels == maximum))
    saturated = at_maximum if maximum == full_scale else _NOTHING
    return ImageValues(
        full_scale, stated, saturated, maximum, at_maximum, *_largest_values(pixels, maximum)
    )


def _indices(flags: Bools) -> Integers:
    # Indices, not flags: few observations are saturated, and large captures have billions.
    return np.flatnonzero(flags).astype(np.int32 if len(flags) < 2**31 else np.int64)


def _largest_values(
    pixels: NDArray[np.uint16], maximum: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the values of an image that are compared with its maximum, ascending, and their
    counts.
    """
    lowest_compared = math.ceil(0.5 * maximum)  # clipping cuts through a continuous range of values
    values = pixels.reshape(-1)
    # Few values are near the maximum. The others are counted only if these do not suffice.
    for lowest in (max(lowest_compared, maximum - 1024), lowest_compared):
        counts = np.zeros(maximum + 1 - lowest, np.int64)
        for start in range(0, len(values), _BLOCK):
            block = values[start : start + _BLOCK]
            counts += np.bincount(block[block >= lowest] - np.uint16(lowest), minlength=len(counts))
        below = np.flatnonzero(counts[:-1])[-COMPARED_VALUES:]
        if len(below) == COMPARED_VALUES:
            break
    return below + lowest, counts[below]


def _is_bits(level: int) -> bool:
    """Return whether the level is 2^bits - 1, shifted to fill 16 bits or not, for 8 to 15 bits."""
    return any(
        level in ((1 << bits) - 1, ((1 << bits) - 1) << (16 - bits)) for bits in range(8, 16)
    )
