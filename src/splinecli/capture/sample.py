"""A sample of the pixels of a capture, small enough for checks that use neighbours."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from splinecli.errors import InputError
from splinecli.images.mask import find_object
from splinecli.maths import Bools, Floats

MAX_PIXELS = 20_000  # larger captures are subsampled by 2, 3 and so on
CLOSEUP_SIDE = 192  # side of a closeup in pixels
Part = tuple[slice, slice]  # rows and columns of the images


@dataclass(frozen=True, eq=False)
class Sample:
    """Observations on a grid of pixels."""

    # (p, F), linear, divided by the light intensities; pixels of the mask in row-major order
    observations: Floats
    mask: Bools  # (h, w) bool with p true pixels
    step: int  # rows and columns of the images from one pixel of the grid to the next


def grid_of(mask: Bools) -> Part:
    """Return the rows and columns of a grid that contains about MAX_PIXELS pixels of the mask (H,
    W), or fewer.
    """
    step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(mask) / MAX_PIXELS))))
    return slice(None, None, step), slice(None, None, step)


def closeup_of(mask: Bools) -> Part:
    """Return the rows and columns of a square of CLOSEUP_SIDE around the middle of a mask (H, W)
    with pixels.
    """
    middles = []
    # The median row and column of its pixels, without listing them, which takes 16 bytes each.
    for axis in (1, 0):
        up_to = np.cumsum(np.count_nonzero(mask, axis=axis))
        middles.append(int(np.searchsorted(up_to, (up_to[-1] + 1) // 2)))
    row, column = (max(0, middle - CLOSEUP_SIDE // 2) for middle in middles)
    return slice(row, row + CLOSEUP_SIDE), slice(column, column + CLOSEUP_SIDE)


def pixels_of(parts: Iterable[Part], mask: Bools) -> Bools:
    """Return the pixels of a mask (H, W) that are in one of the parts."""
    chosen = np.zeros_like(mask)
    for part in parts:
        chosen[part] = mask[part]
    return chosen


def sample_observations(
    observations: Floats, mask: Bools, part: Part | None = None, known: Bools | None = None
) -> Sample:
    """Return the sample of a mask (H, W) in a part of the images; None for its grid.

    Observations (P, F) cover the mask, or only its `known` pixels, which include at least the
    pixels of the part.
    """
    part = part or grid_of(mask)
    chosen = pixels_of([part], mask)
    return Sample(
        observations[chosen[mask if known is None else known]], mask[part], part[0].step or 1
    )


def leave_out_background(sample: Sample) -> tuple[Sample, float]:
    """Return a sample of a capture without a mask, without its dark background, and the share of
    that background.

    A sample that has a mask, or no dark background, is returned as it is.
    """
    if not sample.mask.all() or min(sample.mask.shape) < 8:
        return sample, 0.0
    brightness = sample.observations.mean(axis=1).reshape(sample.mask.shape).astype(np.float32)
    try:
        inside = find_object(brightness)
    except InputError:
        return sample, 0.0
    # A background is dark if its median brightness is below this share of the object's.
    if np.median(brightness[~inside]) > 0.15 * np.median(brightness[inside]):
        return sample, 0.0
    return Sample(sample.observations[inside.ravel()], inside, sample.step), float(
        1 - inside.mean()
    )
