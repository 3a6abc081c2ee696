"""Samples of a capture's pixels that are small enough for checks that use neighbouring pixels."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from splinecli.errors import InputError
from splinecli.images.mask import find_object
from splinecli.maths import Bools, Float64Array, Floats

MAX_PIXELS = 20_000  # larger captures are subsampled by a factor of 2, 3 and so on
CLOSEUP_SIDE = 192  # side of a closeup in pixels
Part = tuple[slice, slice]  # rows and columns of the images


@dataclass(frozen=True, eq=False)
class Sample:
    """Observations on a grid of pixels."""

    # (p, F), linear, divided by the light intensities; pixels of the mask in row-major order
    observations: Floats
    mask: Bools  # (h, w) bool with p true pixels
    step: int  # distance between neighbouring pixels of the grid, in pixels of the images

    @property
    def images(self) -> Float64Array:
        """The observations on maps (F, h, w), zero outside the mask."""
        found = np.zeros((self.observations.shape[1], *self.mask.shape))
        found[:, self.mask] = self.observations.T
        return found


def grid_of(mask: Bools) -> Part:
    """Return the rows and columns of a grid with at most about MAX_PIXELS pixels in a mask
    (H, W).
    """
    step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(mask) / MAX_PIXELS))))
    return slice(None, None, step), slice(None, None, step)


def closeup_of(mask: Bools) -> Part:
    """Return the rows and columns of a square of side CLOSEUP_SIDE in the middle of a mask
    (H, W).
    """
    middles = []
    # Find the median row and column without listing the pixels, which would take 16 bytes per
    # pixel.
    for axis in (1, 0):
        up_to = np.cumsum(np.count_nonzero(mask, axis=axis))
        middles.append(int(np.searchsorted(up_to, (up_to[-1] + 1) // 2)))
    row, column = (max(0, middle - CLOSEUP_SIDE // 2) for middle in middles)
    return slice(row, row + CLOSEUP_SIDE), slice(column, column + CLOSEUP_SIDE)


def pixels_of(parts: Iterable[Part], mask: Bools) -> Bools:
    """Return the pixels of a mask (H, W) that are inside one of the parts."""
    chosen = np.zeros_like(mask)
    for part in parts:
        chosen[part] = mask[part]
    return chosen


def sample_observations(
    observations: Floats, mask: Bools, part: Part | None = None, known: Bools | None = None
) -> Sample:
    """Return a sample from a part of the images, by default from the mask's grid.

    The observations (P, F) cover the mask (H, W), or only its `known` pixels, which must include
    the part.
    """
    part = part or grid_of(mask)
    chosen = pixels_of([part], mask)
    return Sample(
        observations[chosen[mask if known is None else known]], mask[part], part[0].step or 1
    )


def leave_out_background(sample: Sample) -> tuple[Sample, float]:
    """Return the sample without a dark background, and the share of its pixels that were left out.

    The sample is unchanged if it has a mask or no dark background.
    """
    if not sample.mask.all() or min(sample.mask.shape) < 8:
        return sample, 0.0
    brightness = sample.observations.mean(axis=1).reshape(sample.mask.shape).astype(np.float32)
    try:
        inside = find_object(brightness, is_requested=False)
    except InputError:
        return sample, 0.0
    return Sample(sample.observations[inside.ravel()], inside, sample.step), float(
        1 - inside.mean()
    )
