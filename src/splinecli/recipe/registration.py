"""The step that aligns images which moved between exposures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from splinecli.capture.linearise import StoredPixels
from splinecli.capture.source import CaptureSource
from splinecli.errors import InputError
from splinecli.images.alignment import (
    LARGEST_MOTION,
    MIN_IMAGES,
    AlignedImages,
    Alignment,
    align_images,
    common_pixels,
    place_in_whole,
    reduced,
    stride_for,
)
from splinecli.images.lamps import lamp_colours
from splinecli.maths import Float64Array
from splinecli.recipe.reading import compared_pixels
from splinecli.recipe.work import Work
from splinecli.records.capture_warnings import IMAGES_ALIGNED, CaptureWarning

LEAST_SIDE = 8  # of the object, in pixels of the reduced images; the filters reach as far
LEAST_COMMON = 0.25  # share of the object that all aligned images must show


def compare_colours(
    source: CaptureSource, indices: Sequence[int], advance: Callable[[], object]
) -> tuple[Float64Array | None, list[CaptureWarning]]:
    """Return the colours (F, 3) of the lamps of some images, None if they do not differ, and
    warnings; see lamp_colours.
    """
    mask = source.mask_for(indices)
    rows = compared_pixels(int(np.count_nonzero(mask)))
    colours = []
    for pixels in source.read_pixels(mask, indices, lambda each: each, advance, wanted=rows):
        if pixels.values.shape[1] != 3:
            return None, []
        colours.append(pixels.colours())
    return lamp_colours(np.stack(colours))


def register(work: Work, advance: Callable[[], object]) -> Work:
    """Align the images to one of them; see align_images.

    Raises InputError if there are too few images, one does not fit the others, or they share too
    little of the object.
    """
    source, indices = work.files, list(work.indices)
    folder = source.files.folder
    names = [source.files.images[index].name for index in indices]
    if len(indices) < MIN_IMAGES:
        problem = (
            f"--align predicts each image from the others: found {len(indices)}, expected at least"
            f" {MIN_IMAGES}"
        )
        raise InputError(problem, path=folder, hint="Add images, or leave --align out")
    mask, seen = source.mask_for(indices), source
    if not work.colours_known:  # they stay in the observations, but would look like motion here
        colours, _ = compare_colours(source, indices, lambda: None)
        seen = source.divided_by(indices, colours)
    stride = stride_for(len(indices) * mask.size)
    small = reduced(mask.astype(np.float32), stride) > 0.5
    height, width = (np.ptp(each) + 1 if each.size else 0 for each in np.nonzero(small))
    if min(height, width) < LEAST_SIDE:
        problem = (
            f"--align compares details: found an object of {stride * width} x {stride * height}"
            f" pixels, expected at least {stride * LEAST_SIDE} x {stride * LEAST_SIDE}"
        )
        hint = "Read a larger part of the images, or leave --align out"
        raise InputError(problem, path=folder, hint=hint)
    read = seen.read_pixels(np.ones_like(mask), indices, StoredPixels.observe, advance)
    images = np.stack([reduced(image.reshape(mask.shape), stride) for image in read])
    lights = None if work.finds_lights else source.light_directions[indices]
    found = align_images(images, small, lights)
    _check_explained(found, names, source, stride)
    left, top, *_ = source.window.box or (0, 0)
    transforms = np.repeat(np.eye(3)[None], source.n_lights, axis=0)
    transforms[indices] = place_in_whole(found.transforms, left, top, stride)
    common = source.window.of(common_pixels(transforms, work.shape))
    share = np.count_nonzero(mask & common) / np.count_nonzero(mask)
    if share < LEAST_COMMON:
        problem = (
            f"the aligned images share {100 * share:.0f} % of the object, expected"
            f" {100 * LEAST_COMMON:.0f} %"
        )
        hint = "Leave out the images that show another part of it"
        raise InputError(problem, path=folder, hint=hint)
    moved, warnings = found.moved_pixels * stride, source.warnings
    if (found.transforms != np.eye(3)).any():
        text = (
            f"The images were aligned to {names[found.reference]}: they moved by up to"
            f" {moved.max():.1f} pixels ({found.model})"
        )
        if share < 1:
            text += (
                f"; {100 - 100 * share:.1f} % of the object is left out, because it is not in"
                " every image"
            )
        warnings = (*warnings, CaptureWarning(IMAGES_ALIGNED, f"{text}."))
    aligned = AlignedImages(names[found.reference], found.model, transforms, moved, common)
    return replace(work, source=replace(source, alignment=aligned, warnings=warnings))


def _check_explained(
    found: Alignment, names: list[str], source: CaptureSource, stride: int
) -> None:
    """Raise InputError if an image fits the others nowhere, or only after a large motion."""
    if found.unexplained is None:
        return
    name, fit = names[found.unexplained], found.fits[found.unexplained]
    if fit < found.least_fit:
        problem = (
            f"--align cannot match {name} to the other images: at best, its correlation with their"
            f" prediction is {fit:.2f}, expected at least {found.least_fit:.2f}"
        )
        hint = "Leave it out with --light-indices, mask the object, or leave --align out"
        raise InputError(problem, path=source.files.folder, hint=hint)
    pixels = stride * found.moved_pixels[found.unexplained]
    problem = (
        f"--align found that {name} moved by {pixels:.0f} pixels, at one pixel by"
        f" {100 * found.largest:.0f} % of the object's size; expected at most"
        f" {100 * LARGEST_MOTION:.0f} %"
    )
    hint = (
        "Read a larger part of the images, leave the image out with --light-indices, or leave"
        " --align out"
    )
    raise InputError(problem, path=source.files.folder, hint=hint)
