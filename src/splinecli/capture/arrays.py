"""A source of images and lights that are already in memory, for `splinecli.estimate_normals`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from splinecli.capture import linearise
from splinecli.capture.light_files import unit_directions
from splinecli.capture.linearise import StoredPixels, take_around
from splinecli.capture.near_lamps import NearLamps, check_distances
from splinecli.capture.record import placeholders
from splinecli.capture.source import Item, Progress, Source
from splinecli.errors import InputError, UsageError
from splinecli.images.saturation import check_white_level
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Integers
from splinecli.records.capture_warnings import CaptureWarning


@dataclass(frozen=True, eq=False, kw_only=True)
class ArraySource(Source):
    """Images (H, W) or (H, W, C) in memory."""

    images: Sequence[Array]
    mask: Bools  # (H, W)
    lamps: NearLamps | None = None  # over the images; None for distant lights

    @property
    def name(self) -> str:
        return "capture"

    @property
    def has_positions(self) -> bool:
        return self.lamps is not None

    def image_names(self, indices: Sequence[int]) -> list[str]:
        return [f"images[{index}]" for index in indices]

    def mask_for(self, indices: Sequence[int]) -> Bools:
        return self.mask

    def near_lamps(self, mask: Bools) -> tuple[NearLamps | None, list[CaptureWarning]]:
        lamps = self.lamps
        return lamps, [] if lamps is None else check_distances(lamps, mask, None)

    def lamps_on_grid(self, mask: Bools, step: int) -> NearLamps | None:
        lamps = self.lamps
        return None if lamps is None else lamps.within(0, 0, step, lamps.camera_matrix)

    def read_pixels(
        self,
        mask: Bools,
        indices: Sequence[int],
        use: Callable[[StoredPixels], Item],
        progress: Progress = lambda: None,
        wanted: Integers | slice = linearise.EVERY_PIXEL,
        around: Bools | None = None,
    ) -> Iterator[Item]:
        for index in indices:
            image, path = self.images[index], Path(f"images[{index}]")
            pixels = image if image.ndim == 3 else image[..., None]
            stored = pixels[mask]
            used = stored[wanted]
            if around is not None:
                used = np.concatenate((stored, take_around(pixels, around)))
            light = partial(_light, used, path)
            yield use(StoredPixels(path, stored, len(used), light, self.light_intensities[index]))
            progress()


def _light(used: Array, path: Path, rows: Integers | slice) -> Float32Array:
    return linearise.linear_light(used[rows], path)


def open_arrays(
    images: ArrayLike | Sequence[Array],
    light_directions: ArrayLike | None,
    mask: ArrayLike | None = None,
    *,
    light_intensities: ArrayLike | None = None,
    pixel_size: float | None = None,
    camera_matrix: ArrayLike | None = None,
    white_level: float | None = None,
) -> ArraySource:
    """Return a source that reads images and lights from memory.

    Args:
        images: (F, H, W) gray or (F, H, W, 3) RGB, linear. uint8 and uint16 values are scaled by
            their full range; floating-point values are not scaled.
        light_directions: (F, 3) vectors towards the lights, of any length; x right, y up, z to the
            camera. None to have them estimated.
        mask: (H, W), True at the object's pixels. A numeric mask is thresholded at half of its
            maximum, as mask files are. None uses all pixels.
        light_intensities: (F,) or (F, 3) RGB. None if they are unknown.
        pixel_size: the width of a pixel on the object, for near lamps; light_directions are then
            lamp positions in the same unit, relative to the centre of the image on the object's
            mean plane. None for distant lights.
        camera_matrix: (3, 3) in pixels, as in OpenCV. None assumes an orthographic camera.
        white_level: the value, in the unit of the images, from which observations are saturated. By
            default, it is detected in integer images, and floating-point images are assumed not to
            be saturated.

    Raises:
        UsageError: a shape or a type is invalid.
        InputError: a value is negative or not finite, or the mask is empty.
    """
    stack = _checked_images(images)
    shape, n_lights = stack[0].shape[:2], len(stack)
    if light_directions is None and pixel_size is not None:
        raise UsageError(
            "near lamps need positions, but light_directions is None", hint="Omit pixel_size"
        )
    directions = (
        placeholders(n_lights)
        if light_directions is None
        else _checked_directions(light_directions, n_lights)
    )
    check_white_level(white_level)
    inside = np.ones(shape, np.bool_) if mask is None else np.array(mask)
    if inside.dtype != np.bool_:  # the same rule as for mask files
        inside = inside > max(inside.max(initial=0) / 2, 0)
    if inside.shape != shape:
        raise UsageError(
            f"found a mask of shape {inside.shape}, expected (H, W) = {shape}, as the images have"
        )
    if not inside.any():
        raise InputError("capture: the mask is empty")
    known, lamps = light_intensities is not None, None
    matrix = None if camera_matrix is None else np.asarray(camera_matrix, np.float64)
    if pixel_size is not None:
        positions = np.asarray(light_directions, np.float64)
        lamps = NearLamps.of(positions, pixel_size, shape, equal=not known, camera_matrix=matrix)
    return ArraySource(
        images=stack,
        mask=inside,
        light_directions=directions,
        light_intensities=_checked_intensities(light_intensities, n_lights),
        white_level=white_level,
        intensities_known=known,
        intensities_measured=known,
        camera_matrix=matrix,
        lamps=lamps,
    )


def _checked_images(images: ArrayLike | Sequence[Array]) -> list[Array]:
    stack = [np.asarray(image) for image in images]  # type: ignore[union-attr]
    if not stack:
        raise UsageError("found no images, expected (F, H, W) or (F, H, W, 3)")
    for index, image in enumerate(stack):
        first = stack[0].shape
        if image.shape != first:
            raise UsageError(
                f"found an image of shape {image.shape} at images[{index}], expected {first}, as"
                " images[0] has"
            )
        if (
            image.ndim not in (2, 3)
            or not image.size
            or (image.ndim == 3 and image.shape[2] not in (1, 3))
        ):
            raise UsageError(
                f"found images of shape {(len(stack), *image.shape)}, expected (F, H, W) or (F, H,"
                " W, 3)"
            )
        if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
            problem = (
                f"found images of type {image.dtype}, expected uint8, uint16 or floating point"
            )
            raise UsageError(
                problem, hint="Convert them with images.astype(...), without rescaling the values"
            )
    return stack


def _checked_directions(directions: ArrayLike, n_lights: int) -> Float64Array:
    vectors = np.asarray(directions, np.float64)
    if vectors.shape != (n_lights, 3):
        expected = f"(F, 3) = {(n_lights, 3)}, one for each image"
        raise UsageError(f"found light directions of shape {vectors.shape}, expected {expected}")
    if not np.isfinite(vectors).all():
        raise InputError("found a light direction that is not finite")
    rows = [f" in row {row}" for row in range(n_lights)]
    return unit_directions(vectors, Path("light_directions"), [None] * n_lights, rows)


def _checked_intensities(intensities: ArrayLike | None, n_lights: int) -> Float64Array:
    """Return intensities (F, 3), all ones by default."""
    if intensities is None:
        return np.ones((n_lights, 3))
    values = np.asarray(intensities, np.float64)
    if values.shape == (n_lights,):
        values = values[:, None]
    if values.shape not in ((n_lights, 1), (n_lights, 3)):
        shape = values.shape
        raise UsageError(
            f"found light intensities of shape {shape}, expected (F,) or (F, 3) with F = {n_lights}"
        )
    if not (np.isfinite(values) & (values > 0)).all():
        raise InputError("found a light intensity that is not a finite number above 0")
    return np.broadcast_to(values, (n_lights, 3))
