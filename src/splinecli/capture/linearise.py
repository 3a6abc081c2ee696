"""Pixels of images: decode, take the window and the mask, invert the transfer curve, subtract ambient light, divide by
the falloff."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.capture_warnings import DISPLAY_DECODED, DISPLAY_ENCODED, PROFILE_UNREAD, CaptureWarning
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.facts import ImageFacts
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.formats.images import to_linear
from splinecli.capture.window import WHOLE, Window
from splinecli.errors import InputError
from splinecli.maths.transfer import BT709, TransferCurve, decode_transfer

_DARKEST_FLAT = 0.02  # share of a flat field's mean; darker places do not show the falloff


@dataclass(frozen=True)
class RadiometricCalibration:
    """How stored values become linear light.

    Args:
        curve: the images' transfer curve.
        automatic: whether the curve that all images state is used in its place.
        ambient: an image under ambient light alone, which is subtracted from all others.
        flat_field: images of an evenly white surface, one for each light or one for all. Images are divided by them.
    """

    curve: TransferCurve = 1.0
    ambient: Path | None = None
    flat_field: tuple[Path, ...] = ()
    automatic: bool = False

    def with_stated_curve(self, images: Sequence[ImageFacts]) -> tuple[RadiometricCalibration, list[CaptureWarning]]:
        """Return this calibration with the curve that all images state, if it is automatic, and warnings."""
        if self.curve != 1:
            return self, []
        curves = {image.curve.curve for image in images}
        by = ", ".join(sorted({image.curve.by for image in images if image.curve.curve != 1}))
        unread = [image.path.name for image in images if image.curve.unread]
        warnings = []
        if unread and self.automatic:
            text = f"The colour profile of {unread[0]} has no curve that can be read, so it does not count."
            warnings.append(CaptureWarning(PROFILE_UNREAD, f"{text} Add --transfer linear, srgb or gamma:G."))
        if self.automatic and len(curves) == 1:
            (curve,) = curves
            if curve not in (1, BT709):  # a film has no other curve
                how = (
                    "sRGB" if curve is None else "the profile says" if isinstance(curve, tuple) else f"gamma:{curve:g}"
                )
                text = f"The images say that they are display-encoded ({by}) and are read as {how}."
                text += " Add --transfer linear if their values are linear."
                warnings.append(CaptureWarning(DISPLAY_DECODED, text))
            return replace(self, curve=curve), warnings
        if by:
            text = f"The images look display-encoded ({by}) but are read as linear."
            warnings.append(CaptureWarning(DISPLAY_ENCODED, f"{text} Add --transfer srgb if they are sRGB."))
        return self, warnings


AUTOMATIC = RadiometricCalibration(automatic=True)
"""Stored values are linear light, unless all images say otherwise."""

AS_STORED = RadiometricCalibration()
"""Stored values are linear light."""


def take_pixels(image: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return image[mask], the pixels (P, C) of an image (H, W, C) in a mask (H, W), but faster."""
    if mask.all():
        return image.reshape(-1, image.shape[2])
    return np.stack([image[..., channel][mask] for channel in range(image.shape[2])], axis=1)


class PixelReader:
    """Read the pixels of a mask (H, W) from images. The ambient image and a common flat field are read once."""

    def __init__(
        self,
        radiometry: RadiometricCalibration,
        mask: NDArray[np.bool_],
        n_images: int,
        window: Window = WHOLE,
    ) -> None:
        """Read the shared images. Raises InputError for an unreadable image or a wrong number of flat fields."""
        self.radiometry = radiometry
        self.mask, self._window = mask, window
        flats = radiometry.flat_field
        if len(flats) not in (0, 1, n_images):
            raise InputError(
                f"found {len(flats)} flat-field images, expected 1 or {n_images}, one for each image",
                path=flats[0].parent,
            )
        self._ambient: NDArray[np.float32] | None = None
        if radiometry.ambient is not None:
            self._ambient = self._read(radiometry.ambient, "the other images")[1]
        self._flat = self._read_flat(flats[0]) if len(flats) == 1 else None

    def read(self, path: Path, index: int, like: str) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Return the mask's pixels (P, C) of image `index`: as stored, and as linear light. Raises InputError.

        Args:
            like: the image of the expected size, for messages.
        """
        stored, linear = self._read(path, like)
        if len(self.radiometry.flat_field) > 1:
            linear = linear / self._read_flat(self.radiometry.flat_field[index])
        elif self._flat is not None:
            linear = linear / self._flat
        return stored, linear

    def _read_flat(self, path: Path) -> NDArray[np.float32]:
        _, linear = self._read(path, "the other images")
        mean = linear.mean()
        if mean <= 0:
            raise InputError("the flat-field image is black", path=path)
        return np.asarray(np.maximum(linear / mean, _DARKEST_FLAT), np.float32)

    def _read(self, path: Path, like: str) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Return the pixels as stored, and linear without ambient light."""
        image = decode_image(path, ExpectedSize(self._window.shape or self.mask.shape, like))
        stored = take_pixels(self._window.of(image), self.mask)
        linear = decode_transfer(to_linear(stored, path), self.radiometry.curve)
        return stored, linear if self._ambient is None else np.maximum(linear - self._ambient, 0)
