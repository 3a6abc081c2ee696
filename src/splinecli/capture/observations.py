"""Observations from stored pixels, one image at a time: the step that files and arrays have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import capture_warnings as codes
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.restore.white_level import ImageValues, Saturation, look_at

BLACK_SHARE = 0.01
"""The share of pixels without light above which the capture carries a warning."""


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

    def find_saturated(self, white_level: float | None) -> ImageValues:
        """Return what decides which pixels are saturated; see look_at. Raises InputError."""
        return look_at(self.values, self.path, given=white_level, stated=self.stated_white_level)

    def colours(self) -> NDArray[np.float32]:
        """Return linear RGB (P, 3), each channel divided by its intensity."""
        # In float32 and in place: 24 megapixels take noticeably longer in any other way.
        colours = np.array(np.broadcast_to(self.linear, (len(self.linear), 3)), np.float32)
        colours /= self.intensity.astype(np.float32)
        return colours


def collect_observations(
    images: Iterable[StoredPixels],
    n_pixels: int,
    n_images: int,
    *,
    white_level: float | None = None,
    progress: Callable[[], object] | None = None,
) -> tuple[NDArray[np.float32], Saturation, list[CaptureWarning]]:
    """Return observations (P, F) of the images, in their order, which are saturated, and warnings.

    Only one image is in memory at a time.

    Args:
        white_level: the one that the user gave; None to find it.
        progress: called once after each image.

    Raises:
        InputError: the white level that the user gave is above an image's full scale.
    """
    observations = np.empty((n_pixels, n_images), np.float32)
    any_8_bit, found = False, []
    for position, image in enumerate(images):
        any_8_bit |= image.values.dtype == np.uint8
        found.append(image.find_saturated(white_level))
        observations[:, position] = image.observe()
        del image  # before the next one is decoded
        if progress is not None:
            progress()
    saturation = Saturation(n_pixels, tuple(found), white_level)
    warnings = codes.white_level(saturation.white_level)
    saturated = int(saturation.n_saturated.sum()) / max(observations.size, 1)
    if saturated > codes.SATURATED_SHARE:
        text = f"{100 * saturated:.1f} % of the observations are saturated; a shorter exposure gives better normals."
        warnings.append(CaptureWarning(codes.SATURATED, text))
    black = (n_pixels - np.count_nonzero(observations.any(axis=1))) / max(n_pixels, 1)
    if black > BLACK_SHARE:
        text = f"{100 * black:.1f} % of the pixels are black under every light; they get the normal (0, 0, 1)."
        text += " Leave them out with a mask or with --auto-mask."
        warnings.append(CaptureWarning(codes.BLACK_PIXELS, text))
    return observations, saturation, warnings + codes.eight_bit(any_8_bit)
