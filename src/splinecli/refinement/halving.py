"""A capture at half the resolution, and its results at the full one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.lights.lamp_light import LIT_AT_ONCE, LampLight, LightOf, Rows
from splinecli.maths.normals import unit
from splinecli.refinement.tiles import Box, pixels_before
from splinecli.system.machine import side_by_side

Floats = NDArray[np.float32]

_DARK = 1e-6  # weight of a pixel that is dark under every light, relative to lit ones of the capture's brightness


@dataclass(frozen=True, eq=False)
class HalfCapture:
    """A capture of half the size: each pixel is the mean of the masked ones in a block of 2 x 2 of another capture."""

    mask: NDArray[np.bool_]  # (H / 2, W / 2), with Q true pixels
    observations: Floats  # (Q, F)
    normals: Floats  # (Q, 3), unit, in the capture's frame
    errors: Floats  # (Q, 2)
    members: Rows  # (Q,), the row of one pixel of each block in the other capture; its lights hold for the block
    whole: LightOf  # gives the light of the other capture's pixels

    @classmethod
    def of(
        cls, mask: NDArray[np.bool_], light_of: LightOf, normals: Floats, errors: Floats, reference: float
    ) -> HalfCapture:
        """Return half of a capture.

        Args:
            mask: (H, W), both even, with P true pixels.
            light_of: gives the observations and light directions of some pixels.
            normals, errors: (P, 3) and (P, 2), in the capture's frame.
            reference: the brightness of the capture.
        """
        half = _over_blocks(np.logical_or, mask)
        rows_above, done_above = pixels_before(mask), pixels_before(half)
        n_half, n_lights = int(done_above[-1]), light_of(np.arange(1)).observations.shape[1]
        values, of_normals, of_errors = (np.empty((n_half, columns), np.float32) for columns in (n_lights, 3, 2))
        small = cls(half, values, of_normals, of_errors, np.empty(n_half, np.int32), light_of)
        step = max(1, LIT_AT_ONCE // (2 * mask.shape[1]))  # rows of blocks

        def halve(first: int) -> None:
            last = min(first + step, len(half))
            seen, kept = mask[2 * first : 2 * last], half[first:last]
            rows = np.arange(rows_above[2 * first], rows_above[2 * last], dtype=np.int32)
            if not len(rows):
                return
            observations = light_of(rows).observations
            largest = observations.max(axis=1, keepdims=True)
            equal = np.where(largest > 0, np.float32(1), np.float32(_DARK))
            # In a block, the observations depend mostly on the normals of its brightest pixels.
            weights = np.maximum(largest, np.float32(_DARK * reference))
            found = np.hstack((normals[rows], errors[rows])) * weights
            sent = np.hstack((observations * equal, equal, found, weights))
            maps, numbers = np.zeros((*seen.shape, sent.shape[1]), np.float32), np.zeros(seen.shape, np.int32)
            maps[seen], numbers[seen] = sent, rows
            sums = _over_blocks(np.add, maps)[kept]
            done = slice(done_above[first], done_above[last])
            small.observations[done] = sums[:, :-7] / sums[:, -7:-6]
            small.normals[done] = unit(sums[:, -6:-3])
            small.errors[done] = sums[:, -3:-1] / sums[:, -1:]
            small.members[done] = _over_blocks(np.maximum, numbers)[kept]

        for _ in side_by_side(halve, range(0, len(half), step)):
            pass
        return small

    def light_of(self, rows: Rows) -> LampLight:
        """Return the observations and light directions of some pixels."""
        return replace(self.whole(self.members[rows]), observations=self.observations[rows])

    def enlarged(self, box: Box) -> tuple[torch.Tensor, torch.Tensor]:
        """Return normals (3, h, w), not of unit length, and errors (2, h, w) in a box of the other capture's map.

        They are interpolated bilinearly between pixels of the mask. The box is between even rows and columns.
        """
        rows, columns = (slice(max(0, side.start // 2 - 1), side.stop // 2 + 1) for side in box)
        mask = self.mask[rows]
        numbers = mask.cumsum(dtype=np.int32).reshape(mask.shape) + (np.count_nonzero(self.mask[: rows.start]) - 1)
        mask, numbers = mask[:, columns], numbers[:, columns]
        values = np.zeros((*mask.shape, 5), np.float32)
        some = numbers[mask]
        values[mask] = np.hstack((self.normals[some], self.errors[some]))
        maps = enlarge(torch.from_numpy(values).permute(2, 0, 1), torch.from_numpy(mask))
        top, left = box[0].start - 2 * rows.start, box[1].start - 2 * columns.start
        maps = maps[:, top : top + box[0].stop - box[0].start, left : left + box[1].stop - box[1].start]
        return maps[:3], maps[3:]


def enlarge(maps: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return maps (C, h, w) at twice the resolution, interpolated bilinearly between the pixels of a mask (h, w)."""
    weights = mask.to(maps)[None]
    weighed = torch.cat((maps * weights, weights))[None]
    found = torch.nn.functional.interpolate(weighed, scale_factor=2, mode="bilinear")[0]
    return found[:-1] / found[-1:].clamp(min=1e-6)


def _over_blocks(function: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """Return a function of the four values (H, W, ...) in each block of 2 x 2, (H / 2, W / 2, ...)."""
    rows = function(values[::2], values[1::2])
    return np.asarray(function(rows[:, ::2], rows[:, 1::2]))
