"""Read the images of a capture: observations, saturated ones, and faults of the exposure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splinecli.capture.formats.images import to_linear
from splinecli.capture.linearise import StoredPixels
from splinecli.images.lamps import COLOUR_SAMPLE
from splinecli.images.saturation import ImageValues, Saturation, white_level_warnings
from splinecli.maths import Bools, Float32Array, Integers
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning

# an image is dark if its 99 % quantile is below this share of the white level
DARK = {"uint8": 0.25, "uint16": 0.05}
# Degrees that rounding to 8 bits costs at most, times the part of the range that is used. Measured
# with spline-net on ten captures, rendered and real, with ten lights: 0.2 degrees if the range is
# used, 0.4 for half of it, 1.4 for 20 %, 3.3 for 10 %, 6.7 for 5 %.
_COST_OF_8_BITS = 0.32
MOSTLY_SATURATED = 0.2  # share of an image's pixels from which it is named
_ENOUGH = 1_000_000  # values for a quantile: its rank is uncertain by 0.01 % of the pixels


@dataclass(frozen=True)
class ImageSummary:
    """One image of a capture; only the mask's pixels are used."""

    path: Path
    channels: int  # as stored
    dtype: str  # as stored, such as "uint16"
    # the 99 % quantile of the values, as a share of the white level if they are integers
    bright: float
    saturated: float = 0.0  # share of the pixels with a channel at the white level or above


class Observed(NamedTuple):
    """What was read from the images of a capture."""

    observations: Float32Array  # (P + R, F), of the mask's pixels, then of those around it
    saturation: Saturation
    images: tuple[ImageSummary, ...]
    colours: Float32Array | None  # (F, p, 3), linear RGB of some pixels; None for gray images


def compared_pixels(n_pixels: int) -> Integers:
    """Return the rows (p,) of pixels whose colours are compared, among those of a mask."""
    return np.linspace(0, n_pixels - 1, min(n_pixels, COLOUR_SAMPLE)).astype(np.intp)


def read_observations(
    images: Iterable[StoredPixels],
    n_images: int,
    mask: Bools,
    around: Bools | None,
    white_level: float | None,
) -> Observed:
    """Return the observations of images, of which one at a time is in memory.

    Args:
        mask, around: (H, W), the pixels of the object, and those around it or None.
        white_level: given by the user, or None to find it. Raises InputError if it is above an
            image's full scale.
    """
    n_pixels = int(np.count_nonzero(mask))
    n_around = 0 if around is None else int(np.count_nonzero(around))
    observations = np.empty((n_pixels + n_around, n_images), np.float32)
    compared = compared_pixels(n_pixels)
    found, summaries, colours = list[ImageValues](), list[ImageSummary](), list[Float32Array]()
    for position, image in enumerate(images):
        found.append(image.find_saturated(white_level))
        summaries.append(_summarise(image))
        observations[:, position] = image.observe()
        if image.linear.shape[1] == 3:
            colours.append(replace(image, linear=image.linear[compared]).colours())
        del image  # before the next one is decoded
    saturation = Saturation(n_pixels, tuple(found), white_level)
    return Observed(
        observations,
        saturation,
        tuple(_relative(summaries, saturation)),
        np.stack(colours) if len(colours) == len(found) else None,
    )


def _summarise(image: StoredPixels) -> ImageSummary:
    """Return the summary of an image, relative to its full scale."""
    stored = image.values
    if len(stored) > _ENOUGH:  # at random: pixels at equal distances may be in a few columns
        stored = stored[np.random.default_rng(0).integers(len(stored), size=_ENOUGH)]
    bright = float(np.quantile(to_linear(stored, image.path), 0.99))
    return ImageSummary(image.path, image.values.shape[1], str(image.values.dtype), bright)


def _relative(images: Sequence[ImageSummary], saturation: Saturation) -> Iterable[ImageSummary]:
    """Yield the images relative to the white level, with their shares of saturated pixels."""
    level = saturation.white_level
    for image, n_saturated in zip(images, saturation.n_saturated.tolist(), strict=True):
        full_scale = np.iinfo(image.dtype).max if image.dtype.startswith("uint") else 0
        bright = image.bright
        # The white level of 16-bit images does not apply to 8-bit images among them.
        if level is not None and full_scale >= level.value:
            bright *= full_scale / level.value
        yield replace(image, bright=bright, saturated=n_saturated / max(saturation.n_pixels, 1))


def exposure_warnings(observed: Observed, *, inverted: bool) -> list[CaptureWarning]:
    """Warn about faults of the exposure. `inverted` is whether the mask is probably inverted."""
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
            f"{100 * saturated:.1f} % of the observations are saturated{most}; a shorter exposure"
            " gives better normals."
        )
        warnings.append(CaptureWarning(codes.SATURATED, text))
    lit = observed.observations[:n_pixels].any(axis=1)
    black = (n_pixels - np.count_nonzero(lit)) / max(n_pixels, 1)
    if black > 0.01:
        text = (
            f"{100 * black:.1f} % of the pixels are black under every light; they get the normal"
            " (0, 0, 1). Leave them out with a mask or with --auto-mask."
        )
        warnings.append(CaptureWarning(codes.BLACK_PIXELS, text))
    warnings += _eight_bits([image for image in observed.images if image.dtype == "uint8"])
    dark = [image for image in observed.images if image.bright < DARK.get(image.dtype, 0)]
    if dark and not inverted:
        warnings.append(_dark_images(dark, observed))
    return warnings


def _eight_bits(images: Sequence[ImageSummary]) -> list[CaptureWarning]:
    """Warn about images with 8 bits, if there are any."""
    if not images:
        return []
    used = max(0.01, *(image.bright for image in images))
    if used >= 0.5:
        text = "The images have 8 bits, which costs less than 0.5 degrees."
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
            f"No value is above {level}, as from a camera of {bits} bits in 16-bit files. Of this"
            f" range, the images use {100 * min(used, 1):.0f} %. If the camera has {bits} bits,"
            f" add --white-level {level}; if it has 16, a longer exposure gives less noise."
        )
        return CaptureWarning(codes.WHITE_LEVEL, text)
    most = max(DARK[image.dtype] for image in dark)
    text = (
        f"Images that use less than {100 * most:.0f} % of the range: {len(dark)}, such as"
        f" {dark[0].path.name}; a longer exposure gives less noise"
    )
    # One dark image among others may have been stored in another way.
    few = len(dark) <= len(observed.images) / 2
    text += ", if it has the same bit depth as the others." if few else "."
    return CaptureWarning(codes.DARK_IMAGES, text)
