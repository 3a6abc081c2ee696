"""What a capture holds, without any normals: sizes, exposure, lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.images import to_linear
from splinecli.capture.linearise import Lineariser
from splinecli.capture.reader import SATURATED_SHARE, CaptureSource
from splinecli.capture.restore.saturation import find_saturated

DARK = 0.05
"""An image whose 99 % quantile lies below this share of full scale is called dark."""


@dataclass(frozen=True)
class ImageSummary:
    """One image of a capture, its object's pixels alone where there is a mask.

    Args:
        shape: (H, W, C) as stored.
        dtype: as stored, such as "uint16".
        bright: the 99 % quantile of its values, as a share of full scale (of floating-point images, as it is).
        saturated: share of the pixels with a channel at full scale.
    """

    path: Path
    shape: tuple[int, ...]
    dtype: str
    bright: float
    saturated: float


@dataclass(frozen=True, eq=False)
class CaptureSummary:
    """A capture's files, its images one by one, and the number of its pixels."""

    source: CaptureSource
    images: tuple[ImageSummary, ...]
    n_pixels: int

    @property
    def elevations_deg(self) -> NDArray[np.float64]:
        """Angles (F,) of the lights above the plane of the picture, 90 at the camera."""
        degrees: NDArray[np.float64] = np.degrees(np.arcsin(self.source.light_directions[:, 2].clip(-1, 1)))
        return degrees

    def warnings(self) -> list[str]:
        """Sentences on what will cost accuracy."""
        found = list(self.source.warnings)
        sizes = {image.shape[:2] for image in self.images}
        if len(sizes) > 1:
            found.append(f"The images have {len(sizes)} different sizes; they have to be equal.")
        if any(image.dtype == "uint8" for image in self.images):
            found.append("There are images of 8 bits; 16-bit linear images give better normals.")
        saturated = [image for image in self.images if image.saturated > SATURATED_SHARE]
        if saturated:
            worst = max(saturated, key=lambda image: image.saturated)
            found.append(
                f"Images saturated in more than {100 * SATURATED_SHARE:.0f} % of the pixels: {len(saturated)},"
                f" most {worst.path.name} ({100 * worst.saturated:.1f} %); a shorter exposure gives better normals."
            )
        dark = [image for image in self.images if image.dtype.startswith("uint") and image.bright < DARK]
        if dark:
            found.append(
                f"Images that use less than {100 * DARK:.0f} % of the range: {len(dark)}, such as"
                f" {dark[0].path.name}; a longer exposure gives less noise."
            )
        if len(self.images) < 8:
            found.append(f"There are {len(self.images)} lights; ten well-spread ones are good.")
        if self.elevations_deg.min() > 60:
            found.append("All lights stand within 30 degrees of the camera; lower ones tell more.")
        return found


def summarise_capture(source: CaptureSource, progress: Callable[[], object] | None = None) -> CaptureSummary:
    """Look at every image once, one at a time. Raises InputError where one cannot be read or the mask does not fit."""
    images = []
    mask: NDArray[np.bool_] | None = None
    for path in source.files.images:
        stored = decode_image(path)
        if mask is None:
            mask = source.read_mask(stored.shape[:2])
            # It refuses ambient images and flat fields that do not fit.
            Lineariser(source.radiometry, mask, len(source.files.images))
        pixels = stored[mask] if mask.shape == stored.shape[:2] else stored.reshape(-1, stored.shape[2])
        images.append(
            ImageSummary(
                path,
                stored.shape,
                str(stored.dtype),
                float(np.quantile(to_linear(pixels, path), 0.99)),
                float(find_saturated(pixels).mean()),
            )
        )
        if progress is not None:
            progress()
    assert mask is not None, "a capture has images"
    return CaptureSummary(source, tuple(images), int(np.count_nonzero(mask)))
