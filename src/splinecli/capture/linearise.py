"""Linear light from stored values: invert the transfer curve, subtract ambient light, divide by the falloff."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import capture_warnings
from splinecli.capture.capture_warnings import CaptureWarning
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.header import stated_curve
from splinecli.capture.formats.image_size import ExpectedSize
from splinecli.capture.formats.images import to_linear
from splinecli.capture.masks import take_pixels
from splinecli.capture.window import WHOLE, Window
from splinecli.errors import InputError
from splinecli.transfer import TransferCurve, decode_transfer

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

    def with_stated_curve(
        self, images: Sequence[Path]
    ) -> tuple[RadiometricCalibration, list[CaptureWarning]]:
        """Return this calibration with the curve that all images state, if it is automatic, and warnings.

        Raises:
            InputError: an image cannot be read.
        """
        if self.curve != 1:
            return self, []
        stated = {path: stated_curve(path) for path in images}
        curves = {found.curve for found in stated.values()}
        by = ", ".join(sorted({found.by for found in stated.values() if found.curve != 1}))
        unread = [path for path, found in stated.items() if found.unread]
        warnings = [capture_warnings.profile_unread(unread[0].name)] if unread and self.automatic else []
        if self.automatic and len(curves) == 1:
            (curve,) = curves
            if curve != 1:
                warnings.append(capture_warnings.display_decoded(by, curve))
            return replace(self, curve=curve), warnings
        return self, [*warnings, capture_warnings.display_encoded(by)] if by else warnings


AUTOMATIC = RadiometricCalibration(automatic=True)
"""Stored values are linear light, unless all images say otherwise."""

AS_STORED = RadiometricCalibration()
"""Stored values are linear light."""


class Lineariser:
    """Linearise the pixels of a mask (H, W). Ambient image and common flat field are read once."""

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
        self._ambient = None if radiometry.ambient is None else self._linear(radiometry.ambient)
        self._flat = self._read_flat(flats[0]) if len(flats) == 1 else None

    def __call__(self, pixels: NDArray[Any], path: Path, index: int) -> NDArray[np.float32]:
        """Return linear light (P, C) from the mask's pixels (P, C), as stored in image `index`. Raises InputError."""
        linear = decode_transfer(to_linear(pixels, path), self.radiometry.curve)
        if self._ambient is not None:
            linear = np.maximum(linear - self._ambient, 0)
        if len(self.radiometry.flat_field) > 1:
            linear = linear / self._read_flat(self.radiometry.flat_field[index])
        elif self._flat is not None:
            linear = linear / self._flat
        return linear

    def _read_flat(self, path: Path) -> NDArray[np.float32]:
        linear = self._linear(path)
        if self._ambient is not None:
            linear = np.maximum(linear - self._ambient, 0)
        mean = linear.mean()
        if mean <= 0:
            raise InputError("the flat-field image is black", path=path)
        return np.asarray(np.maximum(linear / mean, _DARKEST_FLAT), np.float32)

    def _linear(self, path: Path) -> NDArray[np.float32]:
        expected = ExpectedSize(self._window.shape or self.mask.shape, "the other images")
        stored = self._window.of(decode_image(path, expected))
        return decode_transfer(to_linear(take_pixels(stored, self.mask), path), self.radiometry.curve)
