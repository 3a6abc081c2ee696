"""Summary of a capture without normals, and a sample of its pixels, small enough for checks that
use neighbours.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splinecli.capture.formats.images import check_stored_size, to_linear
from splinecli.capture.linearise import AS_STORED, WHOLE, StoredPixels
from splinecli.capture.sample import Sample
from splinecli.capture.source import CaptureSource, Progress
from splinecli.errors import InputError
from splinecli.images.saturation import (
    Saturation,
    find_object,
    find_saturated,
    white_level_warnings,
)
from splinecli.maths import Bools, Float64Array, Floats
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import SATURATED_SHARE, CaptureWarning
from splinecli.records.white_level import WhiteLevel

MAX_PIXELS = 20_000  # larger captures are subsampled by 2, 3 and so on
CLOSEUP_SIDE = 192  # side of a closeup in pixels


Part = tuple[slice, slice]  # rows and columns of the images
DARK = 0.05  # an image is dark if its 99 % quantile is below this share of the white level
_ENOUGH = 1_000_000  # pixels for a quantile: its rank is uncertain by 0.01 % of the pixels


def grid_of(mask: Bools) -> Part:
    """Return the rows and columns of a grid that contains about MAX_PIXELS pixels of the mask (H,
    W), or fewer.
    """
    step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(mask) / MAX_PIXELS))))
    return slice(None, None, step), slice(None, None, step)


def closeup_of(mask: Bools) -> Part:
    """Return the rows and columns of a square of CLOSEUP_SIDE around the middle of a mask (H, W)
    with pixels.
    """
    middles = []
    for axis in (
        1,
        0,
    ):  # the median row and column of its pixels, without listing them, which takes 16 bytes each
        up_to = np.cumsum(np.count_nonzero(mask, axis=axis))
        middles.append(int(np.searchsorted(up_to, (up_to[-1] + 1) // 2)))
    row, column = (max(0, middle - CLOSEUP_SIDE // 2) for middle in middles)
    return slice(row, row + CLOSEUP_SIDE), slice(column, column + CLOSEUP_SIDE)


def pixels_of(parts: Iterable[Part], mask: Bools) -> Bools:
    """Return the pixels of a mask (H, W) that are in one of the parts."""
    chosen = np.zeros_like(mask)
    for part in parts:
        chosen[part] = mask[part]
    return chosen


def sample_observations(
    observations: Floats, mask: Bools, part: Part | None = None, known: Bools | None = None
) -> Sample:
    """Return the sample of a mask (H, W) in a part of the images; None for its grid.

    Observations (P, F) cover the mask, or only its `known` pixels, which include at least the
    pixels of the part.
    """
    part = part or grid_of(mask)
    chosen = pixels_of([part], mask)
    return Sample(
        observations[chosen[mask if known is None else known]], mask[part], part[0].step or 1
    )


def leave_out_background(sample: Sample) -> tuple[Sample, float]:
    """Return a sample of a capture without a mask, without its dark background, and the share of
    that background.

    A sample that has a mask, or no dark background, is returned as it is.
    """
    if not sample.mask.all() or min(sample.mask.shape) < 8:
        return sample, 0.0
    brightness = sample.observations.mean(axis=1).reshape(sample.mask.shape).astype(np.float32)
    try:
        inside = find_object(brightness)
    except InputError:
        return sample, 0.0
    # A background is dark if its median brightness is below this share of the object's.
    if np.median(brightness[~inside]) > 0.15 * np.median(brightness[inside]):
        return sample, 0.0
    return Sample(sample.observations[inside.ravel()], inside, sample.step), float(
        1 - inside.mean()
    )


@dataclass(frozen=True)
class ImageSummary:
    """One image of a capture; only the mask's pixels are used."""

    path: Path
    shape: tuple[int, ...]  # (H, W, C) as stored
    dtype: str  # as stored, such as "uint16"
    # the 99 % quantile of the values, as a share of the white level if they are integers
    bright: float
    saturated: float  # share of the pixels with a channel at the white level or above


@dataclass(frozen=True, eq=False)
class CaptureSummary:
    """Summary of a capture."""

    source: CaptureSource
    images: tuple[ImageSummary, ...]
    n_pixels: int
    white_level: WhiteLevel | None
    # some of the pixels of all images, on a grid, and every pixel of the middle; None if images
    # have different sizes
    samples: tuple[Sample, Sample] | None
    lamp_warnings: list[CaptureWarning]  # about near lamps over this mask
    mask_warnings: list[CaptureWarning] = field(default_factory=list)
    # of the camera, if 16-bit files seem to have its values without scaling
    bits: int | None = None

    @property
    def axis_angles_deg(self) -> Float64Array:
        """Angles (F,) between the lights and the camera axis."""
        return np.asarray(np.degrees(np.arccos(self.source.light_directions[:, 2].clip(-1, 1))))

    def warnings(self) -> list[CaptureWarning]:
        """Return warnings of faults that reduce accuracy."""
        saturated = [image for image in self.images if image.saturated > SATURATED_SHARE]
        dark = [
            image for image in self.images if image.dtype.startswith("uint") and image.bright < DARK
        ]
        n_sizes = len({image.shape[:2] for image in self.images})
        found = [
            *self.source.warnings,
            *self.lamp_warnings,
            *white_level_warnings(self.white_level),
        ]
        if n_sizes > 1:
            text = f"The images have {n_sizes} different sizes; all images need the same size."
            found.append(CaptureWarning(codes.DIFFERENT_SIZES, text))
        found += codes.eight_bit(any(image.dtype == "uint8" for image in self.images))
        if saturated:
            worst = max(saturated, key=lambda image: image.saturated)
            text = (
                f"Images saturated in more than {100 * SATURATED_SHARE:.0f} % of the pixels:"
                f" {len(saturated)}, most of"
                f" all {worst.path.name} ({100 * worst.saturated:.1f} %); a shorter exposure gives"
                " better normals."
            )
            found.append(CaptureWarning(codes.SATURATED, text))
        found += self.mask_warnings
        if dark and not self.mask_warnings:
            found.append(self._dark_images(dark))
        return found

    def _dark_images(self, dark: Sequence[ImageSummary]) -> CaptureWarning:
        level = (1 << self.bits) - 1 if self.bits else 0
        # of 16-bit files
        used = max(image.bright for image in self.images) * 65_535 / max(level, 1)
        if level and used >= DARK:
            text = (
                f"No value is above {level}, as from a camera of {self.bits} bits in 16-bit files."
                " Of this range, the"
                f" images use {100 * min(used, 1):.0f} %. If the camera has {self.bits} bits, add"
                " --white-level"
                f" {level}; if it has 16, a longer exposure gives less noise."
            )
            return CaptureWarning(codes.WHITE_LEVEL, text)
        text = (
            f"Images that use less than {100 * DARK:.0f} % of the range: {len(dark)}, such as"
            f" {dark[0].path.name};"
        )
        text += " a longer exposure gives less noise"
        # One dark image among others may have been stored in another way.
        text += (
            "."
            if len(dark) > len(self.images) / 2
            else ", if it has the same bit depth as the others."
        )
        return CaptureWarning(codes.DARK_IMAGES, text)


def summarise_capture(source: CaptureSource, progress: Progress = lambda: None) -> CaptureSummary:
    """Return the summary of a capture, reading its images one at a time.

    Raises InputError if an image cannot be read, is too large or does not fit, or a lamp would be
    inside the object.
    """
    for facts in source.facts:
        check_stored_size(*facts.size, facts.path)
    sizes = [facts.size[0][:2] for facts in source.facts]
    shape = sizes[0]
    mask = source.read_mask(shape)
    n_pixels = int(np.count_nonzero(mask))
    parts = grid_of(mask), closeup_of(mask)
    taken = pixels_of(parts, mask)
    fitting = [index for index, size in enumerate(sizes) if size == shape]
    observations = np.zeros((int(np.count_nonzero(taken)), len(fitting)), np.float32)
    found, images = [], {}
    reading = source.read_pixels(
        mask, fitting, lambda pixels: pixels, progress, wanted=np.flatnonzero(taken[mask])
    )
    for position, pixels in enumerate(reading):
        found.append(pixels.find_saturated(source.white_level))
        observations[:, position] = pixels.observe()
        images[fitting[position]] = _summarise(pixels, shape)
    as_stored = replace(source, radiometry=AS_STORED, window=WHOLE)
    for index, size in enumerate(sizes):
        if size != shape:
            (pixels,) = as_stored.read_pixels(
                np.ones(size, np.bool_), [index], lambda pixels: pixels, progress
            )
            share = float(find_saturated(pixels.values).mean())
            images[index] = replace(_summarise(pixels, size), saturated=share)
    saturation = Saturation(n_pixels, tuple(found), source.white_level)
    for index, n_saturated in zip(fitting, saturation.n_saturated.tolist(), strict=True):
        images[index] = replace(images[index], saturated=n_saturated / max(n_pixels, 1))
    level, samples = saturation.white_level, None
    if len(fitting) == len(sizes):
        sample, close = (sample_observations(observations, mask, part, taken) for part in parts)
        samples = sample, close
    for index, image in images.items():
        full_scale = np.iinfo(image.dtype).max if image.dtype.startswith("uint") else 0
        # The white level of 16-bit images does not apply to 8-bit images among them.
        if level is not None and full_scale >= level.value:
            images[index] = replace(image, bright=image.bright * (full_scale / level.value))
    relative, lamps = (
        tuple(images[index] for index in range(len(sizes))),
        source.near_lamps(mask)[1],
    )
    of_mask = source.mask_warnings(mask, fitting)
    return CaptureSummary(
        source, relative, n_pixels, level, samples, lamps, of_mask, saturation.bits
    )


def _summarise(pixels: StoredPixels, size: tuple[int, ...]) -> ImageSummary:
    """Return the summary of an image with this height and width, relative to its full scale; 0 as
    its saturation.
    """
    stored = pixels.values
    if stored.dtype.kind == "f":  # every value is checked
        stored = to_linear(stored, pixels.path)
    if (
        len(stored) > _ENOUGH
    ):  # at random, because pixels at equal distances may all be in a few columns
        stored = stored[np.random.default_rng(0).integers(len(stored), size=_ENOUGH)]
    bright = float(np.quantile(to_linear(stored, pixels.path), 0.99))
    return ImageSummary(
        pixels.path, (*size, stored.shape[1]), str(pixels.values.dtype), bright, 0.0
    )
