"""Observations from stored pixels, one image at a time: the step that files and arrays have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import capture_warnings
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.restore.white_level import Saturation, SaturationFinder


@dataclass(frozen=True, eq=False)
class StoredPixels:
    """The mask's pixels of one image.

    Args:
        path: the image; messages name it.
        values: (P, C), as stored.
        linear: (P, C) float32, linear light.
        intensity: (3,), RGB, of the light.
        stated_white_level: the white level that the file states; None where it states none.
    """

    path: Path
    values: NDArray[Any]
    linear: NDArray[np.float32]
    intensity: NDArray[np.float64]
    stated_white_level: int | None = None

    def observe(self) -> NDArray[np.float32]:
        """Return observations (P,): each channel is divided by its intensity, then the mean is taken.

        A gray image is equal in all channels.
        """
        weights = 1 / (3 * self.intensity)
        if self.linear.shape[1] == 1:
            weights = weights.sum(keepdims=True)
        return self.linear @ weights.astype(np.float32)

    def colours(self) -> NDArray[np.float32]:
        """Return linear RGB (P, 3), each channel divided by its intensity."""
        # In float32 and in place: 24 megapixels take noticeably longer in any other way.
        colours = np.array(np.broadcast_to(self.linear, (len(self.linear), 3)), np.float32)
        colours /= self.intensity.astype(np.float32)
        return colours


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations (P, F) as read, and which of them are saturated."""

    values: NDArray[np.float32]
    saturation: Saturation
    any_8_bit: bool

    def warnings(self) -> list[CaptureWarning]:
        n_saturated = int(self.saturation.n_saturated.sum())
        n_black = len(self.values) - np.count_nonzero(self.values.any(axis=1))
        warnings = [
            capture_warnings.white_level(self.saturation.white_level),
            capture_warnings.saturated(n_saturated / max(self.values.size, 1)),
            capture_warnings.black_pixels(n_black / max(len(self.values), 1)),
            capture_warnings.eight_bit() if self.any_8_bit else None,
        ]
        return [warning for warning in warnings if warning is not None]


def collect_observations(
    images: Iterable[StoredPixels],
    saturation: SaturationFinder,
    progress: Callable[[], object] | None = None,
) -> Observations:
    """Return the observations of the images, in their order. Only one image is in memory at a time.

    Args:
        saturation: a new one for P pixels and F images.
        progress: called once after each image.

    Raises:
        InputError: the white level that the user gave is above an image's full scale.
    """
    observations = np.empty(saturation.shape, np.float32)
    any_8_bit = False
    for position, image in enumerate(images):
        any_8_bit |= image.values.dtype == np.uint8
        saturation.add(position, image.values, image.path, stated=image.stated_white_level)
        observations[:, position] = image.observe()
        del image  # before the next one is decoded
        if progress is not None:
            progress()
    return Observations(observations, saturation.finish(), any_8_bit)
