"""Read the images of a capture, and report saturation and faults of the exposure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splinecli.capture.formats.images import to_linear
from splinecli.capture.linearise import StoredPixels
from splinecli.images.lamps import COLOUR_SAMPLE
from splinecli.images.saturation import ImageValues, Saturation, white_level_warnings
from splinecli.maths import Array, Bools, Float32Array, Integers
from splinecli.maths.pixel_grid import slices
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning

# An image is dark if its 99th percentile is below this share of the white level.
DARK = {"uint8": 0.25, "uint16": 0.05}
# About the largest error from rounding to 8 bits, in degrees, times the share of the range that is
# used: eight-bits-range of benchmarks/all_figures.py, tabulated in docs/robustness.md.
_COST_OF_8_BITS = 0.5
MOSTLY_SATURATED = 0.2  # an image is named if a larger share of its pixels is saturated
_ENOUGH = 1_000_000  # values for a quantile, so that its rank is accurate to 0.01 % of the pixels


@dataclass(frozen=True)
class ImageSummary:
    """The summary of an image, computed from the pixels in the mask."""

    path: Path
    channels: int  # as stored
    dtype: str  # as stored, such as "uint16"
    # 99th percentile of the values, as a share of the white level if they are integers
    bright: float
    saturated: float = 0.0  # share of the pixels with a channel at or above the white level


class Observed(NamedTuple):
    """The data read from the images of a capture."""

    observations: Float32Array  # (P + R, F), of the pixels in the mask, then around it
    saturation: Saturation
    images: tuple[ImageSummary, ...]
    colours: Float32Array | None  # (F, p, 3), linear RGB of some pixels; None for gray images


def compared_pixels(n_pixels: int) -> Integers:
    """Return the rows (p,) of the pixels in a mask whose colours are compared."""
    return np.linspace(0, n_pixels - 1, min(n_pixels, COLOUR_SAMPLE)).astype(np.intp)


class Look(NamedTuple):
    """The data kept from one image."""

    saturated: ImageValues
    summary: ImageSummary
    observations: Float32Array  # (P + R,)
    colours: Float32Array | None  # (p, 3), of the compared pixels; None for a gray image


def look_at_image(compared: Integers, white_level: float | None, image: StoredPixels) -> Look:
    """Return the observations and the summary of an image.

    Raises InputError if the given white level is above the full scale of the image.
    """
    colours = replace(image, count=len(compared), light=lambda rows: image.light(compared[rows]))
    return Look(
        image.find_saturated(white_level),
        _summarise(image),
        image.observe(),
        colours.colours() if image.values.shape[1] == 3 else None,
    )


_AT_ONCE, _ROWS = 4, 1 << 14  # numbers of images and pixels that are copied at once


def gather_observations(
    images: Iterable[Look], n_images: int, mask: Bools, white_level: float | None
) -> Observed:
    """Return the observations of images in a mask (H, W).

    If `white_level` is None, it is found in the images.
    """
    n_pixels, observations = int(np.count_nonzero(mask)), np.empty((0, n_images), np.float32)
    looks, waiting = list[Look](), list[Float32Array]()
    for position, look in enumerate(images, 1):
        waiting.append(look.observations)
        looks.append(look._replace(observations=_NOTHING))
        if position == 1:
            observations = np.empty((len(look.observations), n_images), np.float32)
        del look
        # Writing one column at a time would pass through the whole array for each image.
        if len(waiting) == _AT_ONCE or position == n_images:
            for rows in slices(len(observations), _ROWS):
                for column, each in enumerate(waiting, position - len(waiting)):
                    observations[rows, column] = each[rows]
            waiting.clear()
    saturation = Saturation(n_pixels, tuple(look.saturated for look in looks), white_level)
    colours = [look.colours for look in looks if look.colours is not None]
    return Observed(
        observations,
        saturation,
        tuple(_relative([look.summary for look in looks], saturation)),
        np.stack(colours) if len(colours) == len(looks) else None,
    )


_NOTHING = np.empty(0, np.float32)


@lru_cache(maxsize=1)
def _enough_rows(n_pixels: int) -> Integers:
    # at random, because equally spaced pixels may be in only a few columns
    return np.random.default_rng(0).integers(n_pixels, size=_ENOUGH)


def _summarise(image: StoredPixels) -> ImageSummary:
    """Return the summary of an image, relative to its full scale."""
    stored = image.values
    if len(stored) > _ENOUGH:
        stored = stored.take(_enough_rows(len(stored)), axis=0)
    bright = float(_quantile(stored, image.path, 0.99))
    return ImageSummary(image.path, image.values.shape[1], str(image.values.dtype), bright)


def _quantile(stored: Array, path: Path, share: float) -> Float32Array:
    """Return a quantile of stored values, as scaled by to_linear."""
    if stored.dtype.kind != "u":
        return np.asarray(np.quantile(to_linear(stored, path), share), np.float32)
    up_to = np.bincount(stored.reshape(-1)).cumsum()
    place = share * (up_to[-1] - 1)
    around = np.searchsorted(up_to, (math.floor(place), math.ceil(place)), side="right")
    lower, upper = to_linear(around.astype(stored.dtype), path)
    return np.asarray(lower + (upper - lower) * (place % 1), np.float32)


def _relative(images: Sequence[ImageSummary], saturation: Saturation) -> Iterable[ImageSummary]:
    """Yield the summaries relative to the white level, with shares of saturated pixels."""
    level = saturation.white_level
    for image, n_saturated in zip(images, saturation.n_saturated.tolist(), strict=True):
        full_scale = np.iinfo(image.dtype).max if image.dtype.startswith("uint") else 0
        bright = image.bright
        # The white level of 16-bit images does not apply to any 8-bit images among them.
        if level is not None and full_scale >= level.value:
            bright *= full_scale / level.value
        yield replace(image, bright=bright, saturated=n_saturated / max(saturation.n_pixels, 1))


def exposure_warnings(observed: Observed, *, inverted: bool) -> list[CaptureWarning]:
    """Return warnings about faults of the exposure.

    `inverted` says whether the mask is probably inverted.
    """
    saturation, n_pixels = observed.saturation, observed.saturation.n_pixels
    n_images = len(observed.images)
    warnings = white_level_warnings(saturation.white_level)
    saturated = int(saturation.n_saturated.sum()) / max(n_pixels * n_images, 1)
    if saturated > codes.SATURATED_SHARE:
        worst = max(observed.images, key=lambda image: image.saturated)
        most = ""
        if worst.saturated > MOSTLY_SATURATED:
            most = f", most of them in {worst.path.name} ({100 * worst.saturated:.1f} %)"
        text = (
            f"{100 * saturated:.1f} % of the observations are saturated{most}. A shorter exposure"
            " gives better normals."
        )
        warnings.append(CaptureWarning(codes.SATURATED, text))
    lit = observed.observations[:n_pixels].any(axis=1)
    black = (n_pixels - np.count_nonzero(lit)) / max(n_pixels, 1)
    if black > 0.01:
        text = (
            f"{100 * black:.1f} % of the pixels are black under every light, so they get the normal"
            " (0, 0, 1). Leave them out with a mask or with --auto-mask."
        )
        warnings.append(CaptureWarning(codes.BLACK_PIXELS, text))
    warnings += _eight_bits([image for image in observed.images if image.dtype == "uint8"])
    dark = [image for image in observed.images if image.bright < DARK.get(image.dtype, 0)]
    if dark and not inverted:
        warnings.append(_dark_images(dark, observed))
    return warnings


def _eight_bits(images: Sequence[ImageSummary]) -> list[CaptureWarning]:
    """Return a warning about images with 8 bits, if there are any."""
    if not images:
        return []
    used = max(0.01, *(image.bright for image in images))
    if used >= 0.5:
        text = "The images have 8 bits, which costs less than 1 degree."
    else:
        text = (
            f"The images have 8 bits and use {100 * used:.0f} % of the range, which costs up to"
            f" {_COST_OF_8_BITS / used:.1f} degrees. Expose longer, or store 16-bit linear images."
        )
    return [CaptureWarning(codes.EIGHT_BIT, text)]


def _dark_images(dark: Sequence[ImageSummary], observed: Observed) -> CaptureWarning:
    bits = observed.saturation.bits
    level = (1 << bits) - 1 if bits else 0
    used = max(image.bright for image in observed.images) * 65_535 / max(level, 1)  # 16-bit files
    if level and used >= DARK["uint16"]:
        text = (
            f"No value is above {level}, as in 16-bit files from a {bits}-bit camera. The images"
            f" use {100 * min(used, 1):.0f} % of this range. If the camera has {bits} bits, add"
            f" --white-level {level}; if it has 16, use a longer exposure for less noise."
        )
        return CaptureWarning(codes.WHITE_LEVEL, text)
    most = max(DARK[image.dtype] for image in dark)
    use = "uses" if len(dark) == 1 else "use"
    text = (
        f"{len(dark)} of {len(observed.images)} images {use} less than {100 * most:.0f} % of the"
        f" range, such as {dark[0].path.name}. A longer exposure gives less noise"
    )
    # A few dark images may have been stored with another bit depth.
    few = len(dark) <= len(observed.images) / 2
    text += ", if they have the same bit depth as the others." if few else "."
    return CaptureWarning(codes.DARK_IMAGES, text)
