"""Compute observations from images: decode them, take the window and the mask, invert the transfer
curve, subtract ambient light, and divide by the falloff and the light's intensity. Files and arrays
share the last step.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.facts import ImageHeader
from splinecli.capture.formats.images import ExpectedSize, decode_image, to_linear
from splinecli.errors import InputError, UsageError
from splinecli.images.saturation import ImageValues, look_at
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Floats, Integers
from splinecli.maths.pixel_grid import bounds, slices
from splinecli.maths.transfer import BT709, TransferCurve, decode_transfer
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning

Numbers = TypeVar("Numbers", bound=np.generic)


@dataclass(frozen=True)
class Window:
    """The part of the images that is read. Images are subsampled without averaging, which preserves
    the stored values.
    """

    # left, top, width and height in pixels; None for whole images
    box: tuple[int, int, int, int] | None = None
    step: int = 1  # every step-th row and column is read
    shape: tuple[int, ...] | None = None  # (H, W) of the whole images if only a part is read

    @property
    def is_whole(self) -> bool:
        return self.box is None and self.step == 1

    def in_words(self) -> str | None:
        """Return a description of the window for messages, or None for whole images."""
        words = [] if self.box is None else ["{2} x {3} pixels from ({0}, {1})".format(*self.box)]
        words += [f"one in {self.step} rows and columns"] if self.step > 1 else []
        return ", ".join(words) or None

    def of(self, pixels: NDArray[Numbers]) -> NDArray[Numbers]:
        """Return the window of an image or map (H, W, ...) as a view."""
        left, top, width, height = self.box or (0, 0, pixels.shape[1], pixels.shape[0])
        return pixels[top : top + height : self.step, left : left + width : self.step]

    def whole(self, mask: Bools) -> Bools:
        """Return the mask of whole images from a mask of the window."""
        whole = np.zeros(mask.shape if self.shape is None else self.shape, np.bool_)
        self.of(whole)[...] = mask
        return whole

    def camera(self, matrix: Floats) -> Float64Array:
        """Return the camera matrix (3, 3) of the window, from the matrix of whole images."""
        left, top, *_ = self.box or (0, 0)
        to_window = np.array([[1, 0, -left], [0, 1, -top], [0, 0, self.step]]) / self.step
        return np.asarray(to_window @ matrix, np.float64)

    def filled(self, mask: Bools) -> Bools:
        """Return the mask of whole images from a mask of the window. Skipped pixels take the value
        of the pixel that represents them.
        """
        whole = np.zeros(mask.shape if self.shape is None else self.shape, np.bool_)
        part = replace(self, step=1).of(whole)
        part[...] = mask.repeat(self.step, 0).repeat(self.step, 1)[: part.shape[0], : part.shape[1]]
        return whole

    def on(self, image: ImageHeader) -> Window:
        """Return the window for images of the same size as this one. Raises InputError if the box
        extends beyond the image.
        """
        if self.is_whole:
            return self
        height, width = shape = image.size[0][:2]
        if self.box is not None:
            left, top, box_width, box_height = self.box
            if left + box_width > width or top + box_height > height:
                crop = ",".join(map(str, self.box))
                problem = f"--crop {crop} extends beyond the image of {width} x {height} pixels"
                raise InputError(problem, path=image.path)
        return replace(self, shape=shape)


WHOLE = Window()


def parse_window(crop: str | None, scale: str | None) -> Window:
    """Return the window of --crop X,Y,W,H and --scale 1/N. Raises UsageError."""
    box: tuple[Any, ...] | None = None
    if crop is not None:
        found = re.fullmatch(r"\d{1,9}(?:,\d{1,9}){3}", crop.replace(" ", ""))
        box = tuple(int(number) for number in found[0].split(",")) if found else ()
        if not box or not box[2] or not box[3]:
            problem = (
                f"--crop is {crop!r}; expected X,Y,W,H, the upper left corner and the size in"
                " pixels"
            )
            raise UsageError(problem, hint="For example, --crop 1000,500,800,600")
    found = re.fullmatch(r"1(?:/(\d{1,3}))?", "1" if scale is None else scale.replace(" ", ""))
    step = int(found[1] or 1) if found else 0
    if not step:
        raise UsageError(f"--scale is {scale!r}; expected 1/N, such as 1/4")
    return Window(box, step)


@dataclass(frozen=True)
class RadiometricCalibration:
    """Settings for converting stored values to linear light."""

    curve: TransferCurve = 1.0  # the images' transfer curve
    # an image taken under ambient light alone, which is subtracted from all others
    ambient: Path | None = None
    # images of a uniform white surface by which the images are divided, one for each light or one
    # for all
    flat_field: tuple[Path, ...] = ()
    automatic: bool = False  # whether a curve stated by all images replaces `curve`

    def with_stated_curve(
        self, images: Sequence[ImageHeader]
    ) -> tuple[RadiometricCalibration, list[CaptureWarning]]:
        """Return this calibration, if it is automatic with the curve that all images state, and
        warnings.
        """
        if self.curve != 1:
            return self, []
        by = ", ".join(sorted({image.curve.by for image in images if image.curve.curve != 1}))
        if not self.automatic:
            text = (
                f"The image files are marked as display-encoded ({by}) but are read as linear, as"
                " requested by --transfer."
            )
            text += " Omit the option if their values are not linear."
            return self, [CaptureWarning(codes.DISPLAY_ENCODED, text)] if by else []
        unread, warnings = [image.path.name for image in images if image.curve.unread], []
        if unread:
            text = (
                f"The colour profile of {unread[0]} was ignored, because its curve cannot be read."
            )
            warnings.append(
                CaptureWarning(
                    codes.PROFILE_UNREAD, f"{text} Add --transfer linear, srgb or gamma:G."
                )
            )
        curve, *others = {image.curve.curve for image in images}
        if others:
            text = (
                f"The images seem to be display-encoded ({by}) but are read as linear. Add"
                " --transfer srgb if they are in sRGB."
            )
            return self, [*warnings, CaptureWarning(codes.DISPLAY_ENCODED, text)]
        if curve not in (1, BT709):  # videos always have this curve
            how = (
                "the profile says"
                if isinstance(curve, tuple)
                else f"gamma:{curve:g}"
                if curve
                else "sRGB"
            )
            text = f"The image files are marked as display-encoded ({by}) and are read as {how}."
            text += " Add --transfer linear if their values are linear."
            warnings.append(CaptureWarning(codes.DISPLAY_DECODED, text))
        return replace(self, curve=curve), warnings


# treats stored values as linear light unless all images state a curve
AUTOMATIC = RadiometricCalibration(automatic=True)
AS_STORED = RadiometricCalibration()  # stored values are linear light
EVERY_PIXEL = slice(None)


def linear_light(stored: Array, path: Path, curve: TransferCurve = 1.0) -> Float32Array:
    """Return stored values of any shape as linear light. Raises InputError as to_linear does.

    Linear 8-bit values may have been rounded, or truncated as by `image >> 8`, and the file does
    not record which. A value v then represents light between v - 0.5 and v + 0.5, or between v and
    v + 1. Adding a quarter of a step halves the error in both cases. In dark pixels, this error
    affects the normals.
    """
    linear = decode_transfer(to_linear(stored, path), curve)
    if stored.dtype == np.uint8 and curve == 1:
        linear += np.float32(0.25 / 255) * (stored > 0)
    return linear


# From a selection of the pixels read to their linear light (p, C)
LightOf = Callable[[Integers | slice], Float32Array]
_BLOCK = 1 << 15  # as many pixels as fit into a processor's cache


def take_pixels(image: Array, mask: Bools) -> Array:
    """Return the pixels (P, C) of an image (H, W, C) in a mask (H, W), faster than image[mask]."""
    if not mask.any():
        return image[:0, 0]
    if mask.all():
        return image.reshape(-1, image.shape[2])
    rows, columns = (slice(first, last + 1) for first, last in bounds(mask))
    image, mask = image[rows, columns], mask[rows, columns]
    return np.stack([image[..., channel][mask] for channel in range(image.shape[2])], axis=1)


def take_around(image: Array, around: Bools) -> Array:
    """Return the pixels (R, C) around the object. Invalid values such as NaN become 0, so that no
    pixel is lost.
    """
    pixels = take_pixels(image, around)
    if pixels.dtype.kind == "f":
        pixels = np.where(np.isfinite(pixels) & (pixels > 0), pixels, 0).astype(pixels.dtype)
    return pixels


def pixel_reader(
    radiometry: RadiometricCalibration,
    mask: Bools,
    like: str,
    window: Window,
    wanted: Integers | slice = EVERY_PIXEL,
    around: Bools | None = None,
) -> Callable[[Path, int], tuple[Array, int, LightOf]]:
    """Return a function that reads the pixels of a mask (H, W) from an image, given its path and
    index.

    The function returns the stored pixels (P, C), and the number and linear light of the `wanted`
    pixels or, with a mask `around` (H, W), of all pixels followed by the pixels in `around`.

    The ambient image and a common flat field are read immediately and only once; if there are
    several flat fields, each is read together with its image. Both functions raise InputError for
    an unreadable image. Messages name `like` as the image whose size is expected.
    """
    flats = radiometry.flat_field
    ambient: Float32Array | None = None

    def pixels(
        path: Path, like: str = "the other images", wanted: Integers | slice = EVERY_PIXEL
    ) -> tuple[Array, int, LightOf]:
        """Return the stored pixels, and their number and linear light without ambient light."""
        image = decode_image(path, ExpectedSize(window.shape or mask.shape, like))
        image = window.of(image)
        stored = take_pixels(image, mask)
        used = stored[wanted]
        if around is not None and around.any():
            used = np.concatenate((stored, take_around(image, around)))

        def light(rows: Integers | slice) -> Float32Array:
            linear = linear_light(used[rows], path, radiometry.curve)
            return linear if ambient is None else np.maximum(linear - ambient[wanted][rows], 0)

        return stored, len(used), light

    def falloff(path: Path) -> Float32Array:
        stored, _, light = pixels(path)
        linear = light(EVERY_PIXEL)
        mean = linear[: len(stored)].mean()
        if mean <= 0:
            raise InputError("the flat-field image is black", path=path)
        # darker pixels are not reliable
        return np.asarray(np.maximum(linear / mean, 0.02), np.float32)

    if radiometry.ambient is not None:
        ambient = pixels(radiometry.ambient)[2](EVERY_PIXEL)
    common = falloff(flats[0]) if len(flats) == 1 else None

    def read(path: Path, index: int) -> tuple[Array, int, LightOf]:
        stored, count, light = pixels(path, like, wanted)
        flat = falloff(flats[index]) if len(flats) > 1 else common
        if flat is None:
            return stored, count, light
        return stored, count, lambda rows: light(rows) / flat[wanted][rows]

    return read


@dataclass(frozen=True, eq=False)
class StoredPixels:
    """The mask's pixels of one image."""

    path: Path  # of the image, for messages
    values: Array  # (P, C), as stored
    # the number p and the linear light of the pixels for which it was requested; see pixel_reader
    count: int
    light: LightOf
    intensity: Float64Array  # (3,) RGB intensity of the light
    stated_white_level: int | None = None  # the white level stated in the file, or None

    @property
    def linear(self) -> Float32Array:
        """The linear light (p, C)."""
        return self.light(EVERY_PIXEL)

    def observe(self) -> Float32Array:
        """Return observations (p,), the mean over the channels after dividing each by its
        intensity.

        A gray image is treated as having three equal channels.
        """
        weights = 1 / (3 * self.intensity)
        if self.values.shape[1] == 1:
            weights = weights.sum(keepdims=True)
        found = np.empty(self.count, np.float32)
        for part in slices(self.count, _BLOCK):
            found[part] = self.light(part) @ weights.astype(np.float32)
        return found

    def find_saturated(self, white_level: float | None) -> ImageValues:
        """Return the image statistics that determine which pixels are saturated; see look_at.
        Raises InputError.
        """
        return look_at(self.values, self.path, given=white_level, stated=self.stated_white_level)

    def colours(self) -> Float32Array:
        """Return linear RGB (p, 3), each channel divided by its intensity. Gray images stay
        gray.
        """
        if self.values.shape[1] == 1:
            return np.repeat(self.observe()[:, None], 3, axis=1)
        colours, intensity = (
            np.empty((self.count, 3), np.float32),
            self.intensity.astype(np.float32),
        )
        for part in slices(self.count, _BLOCK):
            np.divide(self.light(part), intensity, out=colours[part])
        return colours
