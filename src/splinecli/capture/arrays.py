"""A capture from arrays that are already in memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from splinecli.capture.lights.found_lights import LightFinder, placeholders
from splinecli.capture.lights.lamp_checks import check_distances
from splinecli.capture.lights.light_files import unit_directions
from splinecli.capture.lights.near_lamps import NearLamps
from splinecli.capture.linearise import StoredPixels, collect_observations, linear_light
from splinecli.capture.record import Capture
from splinecli.capture.stored import StoredCapture
from splinecli.capture_warnings import ESTIMATED_COLOURS
from splinecli.errors import InputError, UsageError
from splinecli.maths import Array, Doubles


def capture_from_arrays(
    images: ArrayLike | Sequence[Array],
    light_directions: ArrayLike | None,
    mask: ArrayLike | None = None,
    *,
    light_intensities: ArrayLike | None = None,
    pixel_size: float | None = None,
    white_level: float | None = None,
    as_stored: bool = False,
    find_lights: LightFinder | None = None,
) -> Capture:
    """Return the capture of these images, restored as `infer` restores the capture of a folder.

    Args:
        images: (F, H, W) gray or (F, H, W, 3) RGB, linear. uint8 and uint16 values are scaled by their full range;
            floating-point values are taken as they are.
        light_directions: (F, 3), towards the lights, of any length; x right, y up, z to the camera. None to find them
            with find_lights.
        mask: (H, W), True at the pixels of the object, or numbers above half of their largest one, as in a mask file.
            None takes all pixels.
        light_intensities: (F,) or (F, 3) RGB. None means that they are unknown.
        pixel_size: for near lamps, the width of a pixel on the object; light_directions are then positions in this
            unit, from the middle of the image on the object's mean plane. None for distant lights.
        white_level: the value from which an observation is saturated, in the unit of the images. None finds it for
            integer images; floating-point images then have none.
        as_stored: use the values alone. By default, saturated observations are restored and unknown light intensities
            are estimated.
        find_lights: finds the lights from the images, where none are given.

    Raises:
        UsageError: a shape or a type does not fit.
        InputError: a value is not finite or negative, the lights cannot give normals, or the mask is empty.
    """
    stack = _checked_images(images)
    shape, n_lights = stack[0].shape[:2], len(stack)
    if light_directions is None and find_lights is None:
        raise UsageError("found neither light directions nor a function that finds them")
    if light_directions is None and pixel_size is not None:
        raise UsageError("light_directions is None, but near lamps need positions", hint="Leave pixel_size out")
    directions = placeholders(n_lights) if light_directions is None else _checked_directions(light_directions, n_lights)
    intensities = _checked_intensities(light_intensities, n_lights)
    inside = np.ones(shape, np.bool_) if mask is None else np.array(mask)
    if inside.dtype != np.bool_:  # the rule of mask files for numbers
        inside = inside > max(inside.max(initial=0) / 2, 0)
    if inside.shape != shape:
        raise UsageError(f"found a mask of shape {inside.shape}, expected (H, W) = {shape} as the images")

    def pixels() -> Iterator[StoredPixels]:
        for index, image in enumerate(stack):
            values = (image if image.ndim == 3 else image[..., None])[inside]
            path = Path(f"images[{index}]")
            yield StoredPixels(path, values, linear_light(values, path), intensities[index])

    observations, saturation, warnings, colours = collect_observations(
        pixels(), int(inside.sum()), n_lights, white_level
    )
    if as_stored:
        warnings, colours = [each for each in warnings if each.code != ESTIMATED_COLOURS], None
    if colours is not None:
        intensities = intensities * colours
        observations = collect_observations(pixels(), int(inside.sum()), n_lights, white_level)[0]
    indices, level = tuple(range(n_lights)), saturation.white_level
    capture = Capture("capture", observations, directions, indices, inside, warnings=tuple(warnings), white_level=level)
    capture = replace(capture, estimated_colours=colours)
    known = light_intensities is not None
    if pixel_size is not None:
        positions = np.asarray(light_directions, np.float64)
        lamps = NearLamps.of(positions, pixel_size, shape, equal=not known)
        capture = replace(capture, lamps=lamps, warnings=(*warnings, *check_distances(lamps, inside, None)))
    stored = StoredCapture(capture, saturation, intensities_known=known)
    if light_directions is None and find_lights is not None:
        stored = stored.find_lights(find_lights)
    return stored.capture if as_stored else stored.restore(stored.estimate_intensities())


def _checked_images(images: ArrayLike | Sequence[Array]) -> list[Array]:
    stack = [np.asarray(image) for image in images]  # type: ignore[union-attr]
    if not stack:
        raise UsageError("found no images, expected (F, H, W) or (F, H, W, 3)")
    for index, image in enumerate(stack):
        first = stack[0].shape
        if image.shape != first:
            raise UsageError(f"found an image of shape {image.shape} at images[{index}], expected {first} as images[0]")
        if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)):
            raise UsageError(f"found images of shape {(len(stack), *image.shape)}, expected (F, H, W) or (F, H, W, 3)")
        if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
            problem = f"found images of type {image.dtype}, expected uint8, uint16 or floating point"
            raise UsageError(problem, hint="Convert them with images.astype(...), without a change of scale")
    return stack


def _checked_directions(directions: ArrayLike, n_lights: int) -> Doubles:
    vectors = np.asarray(directions, np.float64)
    if vectors.shape != (n_lights, 3):
        raise UsageError(
            f"found light directions of shape {vectors.shape}, expected (F, 3) = {(n_lights, 3)}, one for each image"
        )
    if not np.isfinite(vectors).all():
        raise InputError("a light direction is not finite")
    rows = [f" in row {row}" for row in range(n_lights)]
    return unit_directions(vectors, Path("light_directions"), [None] * n_lights, rows)


def _checked_intensities(intensities: ArrayLike | None, n_lights: int) -> Doubles:
    """Return intensities (F, 3); ones where none are given."""
    if intensities is None:
        return np.ones((n_lights, 3))
    values = np.asarray(intensities, np.float64)
    if values.shape == (n_lights,):
        values = values[:, None]
    if values.shape not in ((n_lights, 1), (n_lights, 3)):
        shape = values.shape
        raise UsageError(f"found light intensities of shape {shape}, expected (F,) or (F, 3) with F = {n_lights}")
    if not (np.isfinite(values) & (values > 0)).all():
        raise InputError("a light intensity is not a finite number above 0")
    return np.broadcast_to(values, (n_lights, 3))
