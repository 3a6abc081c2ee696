"""Summary of a capture without normals: sizes, exposure and lights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import capture_warnings
from splinecli.capture.capture_warnings import SATURATED_SHARE, CaptureWarning
from splinecli.capture.formats.images import to_linear
from splinecli.capture.linearise import AS_STORED
from splinecli.capture.observations import StoredPixels
from splinecli.capture.restore.saturation import find_saturated
from splinecli.capture.restore.white_level import SaturationFinder, WhiteLevel
from splinecli.capture.sample import Sample, closeup_window, grid_step
from splinecli.capture.source import CaptureSource
from splinecli.capture.window import WHOLE

DARK = 0.05
"""An image is called dark if its 99 % quantile is below this share of the white level."""

FEW_LIGHTS = 8
"""A capture with fewer lights carries a warning."""

NARROW_DEG = 30.0
"""A capture whose lights are all nearer than this to the camera axis carries a warning."""


@dataclass(frozen=True)
class ImageSummary:
    """One image of a capture; only the mask's pixels count.

    Args:
        path: the file.
        shape: (H, W, C) as stored.
        dtype: as stored, such as "uint16".
        bright: the 99 % quantile of the values, as a share of the white level. For floating-point images, the
            quantile itself.
        saturated: share of the pixels with a channel at the white level or above.
    """

    path: Path
    shape: tuple[int, ...]
    dtype: str
    bright: float
    saturated: float


@dataclass(frozen=True, eq=False)
class CaptureSummary:
    """Summary of a capture.

    Args:
        source: the capture.
        images: a summary of each image.
        n_pixels: number of the mask's pixels.
        white_level: as in Capture.
        sample: some of the pixels of all images, on a grid; None where images have different sizes.
        closeup: every pixel of the middle, or None.
        lamp_warnings: about near lamps over this mask.
    """

    source: CaptureSource
    images: tuple[ImageSummary, ...]
    n_pixels: int
    white_level: WhiteLevel | None
    sample: Sample | None = None
    closeup: Sample | None = None
    lamp_warnings: tuple[CaptureWarning, ...] = ()

    @property
    def axis_angles_deg(self) -> NDArray[np.float64]:
        """Angles (F,) between the lights and the camera axis."""
        degrees: NDArray[np.float64] = np.degrees(np.arccos(self.source.light_directions[:, 2].clip(-1, 1)))
        return degrees

    def warnings(self) -> list[CaptureWarning]:
        """Return warnings of faults that reduce accuracy."""
        saturated = [image for image in self.images if image.saturated > SATURATED_SHARE]
        worst = max(saturated, key=lambda image: image.saturated, default=None)
        dark = [image for image in self.images if image.dtype.startswith("uint") and image.bright < DARK]
        n_sizes = len({image.shape[:2] for image in self.images})
        found = [
            capture_warnings.white_level(self.white_level),
            capture_warnings.different_sizes(n_sizes) if n_sizes > 1 else None,
            capture_warnings.eight_bit() if any(image.dtype == "uint8" for image in self.images) else None,
            None
            if worst is None
            else capture_warnings.saturated_images(len(saturated), worst.path.name, worst.saturated),
            capture_warnings.dark_images(len(dark), dark[0].path.name, DARK) if dark else None,
            capture_warnings.few_lights(len(self.images), FEW_LIGHTS) if len(self.images) < FEW_LIGHTS else None,
            capture_warnings.high_lights(NARROW_DEG) if self.axis_angles_deg.max() < NARROW_DEG else None,
        ]
        given = (warning for warning in found if warning is not None)
        return [*self.source.warnings, *self.lamp_warnings, *given]


def summarise_capture(source: CaptureSource, progress: Callable[[], object] | None = None) -> CaptureSummary:
    """Return the summary of a capture, reading its images one at a time.

    Raises:
        InputError: an image cannot be read, the mask, the ambient image or a flat field does not fit, or a lamp would
            be inside the object.
    """
    shape = source.facts[0].size[0][:2]
    mask = source.read_mask(shape)
    n_images = len(source.facts)
    finder = SaturationFinder(int(np.count_nonzero(mask)), n_images, given=source.white_level)
    step = grid_step(mask)
    on_grid, inside = np.zeros_like(mask), np.zeros_like(mask)
    on_grid[::step, ::step] = mask[::step, ::step]
    seen_closely = closeup_window(mask)
    inside[seen_closely] = mask[seen_closely]
    taken = on_grid | inside
    observations = np.zeros((int(np.count_nonzero(taken)), n_images), np.float32)
    images: dict[int, ImageSummary] = {}
    for index, pixels in _pixels_of_all(source, mask, shape):
        height, width = source.facts[index].size[0][:2]
        if (height, width) == shape:
            finder.add(index, pixels.values, pixels.path, stated=pixels.stated_white_level)
            observations[:, index] = replace(pixels, linear=pixels.linear[taken[mask]]).observe()
        images[index] = ImageSummary(
            pixels.path,
            (height, width, pixels.values.shape[1]),
            str(pixels.values.dtype),
            float(np.quantile(to_linear(pixels.values, pixels.path), 0.99)),
            # This share is used if the image has another size, because the finder cannot take it.
            float(find_saturated(pixels.values).mean()),
        )
        if progress is not None:
            progress()
    level, summaries = _by_white_level(finder, [images[index] for index in range(n_images)], shape)
    sample = closeup = None
    if all(image.shape[:2] == shape for image in summaries):
        sample = Sample(observations[on_grid[taken]], mask[::step, ::step], step)
        closeup = Sample(observations[inside[taken]], mask[seen_closely], 1)
    _, of_lamps = source.near_lamps(mask)
    return CaptureSummary(source, summaries, int(np.count_nonzero(mask)), level, sample, closeup, tuple(of_lamps))


def _pixels_of_all(
    source: CaptureSource, mask: NDArray[np.bool_], shape: tuple[int, ...]
) -> Iterator[tuple[int, StoredPixels]]:
    """Yield the mask's pixels of the images of this shape, and then all pixels of the others, with their indices."""
    sizes = [facts.size[0][:2] for facts in source.facts]
    fitting = [index for index, size in enumerate(sizes) if size == shape]
    yield from zip(fitting, source.read_pixels(mask, fitting, lambda pixels: pixels), strict=True)
    as_stored = replace(source, radiometry=AS_STORED, window=WHOLE)
    for index, size in enumerate(sizes):
        if size != shape:
            (pixels,) = as_stored.read_pixels(np.ones(size, np.bool_), [index], lambda pixels: pixels)
            yield index, pixels


def _by_white_level(
    finder: SaturationFinder, images: list[ImageSummary], shape: tuple[int, ...]
) -> tuple[WhiteLevel | None, tuple[ImageSummary, ...]]:
    """Return the white level, and the images with brightness and saturation relative to it."""
    saturation = finder.finish()
    level, shares = saturation.white_level, saturation.n_saturated / max(saturation.n_pixels, 1)
    summaries = []
    for image, share in zip(images, shares, strict=True):
        bright = image.bright
        full_scale = np.iinfo(image.dtype).max if image.dtype.startswith("uint") else 0
        # The white level of 16-bit images does not apply to 8-bit images among them.
        if level is not None and full_scale >= level.value:
            bright *= full_scale / level.value
        fits = image.shape[:2] == shape
        summaries.append(replace(image, bright=bright, saturated=float(share) if fits else image.saturated))
    return level, tuple(summaries)
