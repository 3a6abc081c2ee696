"""Square blocks of pixels: a map at a coarser scale, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splinecli.maths.arrays import Array, Bools, Floats, Integers, Singles


@dataclass(frozen=True)
class Blocks:
    """The blocks of step x step pixels that contain a pixel of the object."""

    mask: Bools  # (h, w) bool, true for these blocks; p of them
    step: int  # pixels along a side of a block

    @classmethod
    def over(cls, mask: Bools, number: int) -> Blocks:
        """Return about `number` blocks over the pixels of a mask (H, W), at most twice as many."""
        step = max(1, math.ceil(math.sqrt(np.count_nonzero(mask) / number)))
        blocks = cls.of_step(mask, step)
        while (count := np.count_nonzero(blocks.mask)) > 2 * number:  # thin or scattered parts
            blocks = cls.of_step(mask, math.ceil(blocks.step * math.sqrt(count / number)))
        return blocks

    @classmethod
    def of_step(cls, mask: Bools, step: int) -> Blocks:
        """Return the blocks of step x step pixels over the pixels of a mask (H, W)."""
        for axis, size in enumerate(mask.shape):
            mask = np.logical_or.reduceat(mask, np.arange(0, size, step), axis=axis)
        return cls(mask, step)

    def centres(self) -> tuple[Floats, Floats]:
        """Return the rows and columns (p,) of the centres, in pixels of the capture."""
        rows, columns = np.nonzero(self.mask)
        return rows * self.step + self._shift, columns * self.step + self._shift

    def average(self, values: Array, mask: Bools) -> Array:
        """Return the means (p, F) over the blocks of the values (P, F) of a mask's pixels."""
        if self.step == 1:
            return values
        block = self.numbers_at(*np.nonzero(mask))
        sums = np.stack([np.bincount(block, column) for column in values.T], axis=1)
        return (sums / np.bincount(block)[:, None]).astype(values.dtype)

    def shrink_camera(self, camera_matrix: Floats | None) -> Floats | None:
        """Return the camera matrix in blocks from that in pixels; None for an orthographic camera."""
        if camera_matrix is None:
            return None
        shrunk = np.array(((1, 0, -self._shift), (0, 1, -self._shift), (0, 0, self.step))) / self.step
        return np.asarray(shrunk @ camera_matrix)

    def interpolate(self, depth: Floats, mask: Bools) -> Floats:
        """Return the depths (P,) of the pixels of a mask (H, W) from those of the blocks (h, w)."""
        if self.step == 1:
            return depth[mask]
        from scipy.ndimage import map_coordinates

        places = [(axis - self._shift) / self.step for axis in np.nonzero(mask)]
        return np.asarray(map_coordinates(self.spread(depth[self.mask]), places, order=1, mode="nearest"))

    def numbers_at(self, rows: Integers, columns: Integers) -> Integers:
        """Return the numbers (P,) of the blocks of some pixels."""
        number = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        return np.asarray(number[rows // self.step, columns // self.step])

    def spread(self, values: Array) -> Array:
        """Return the map (h, w, ...) of the values (p, ...) of the blocks; other cells have those of the nearest."""
        from scipy.ndimage import distance_transform_edt

        number = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        nearest = distance_transform_edt(~self.mask, return_distances=False, return_indices=True)
        return np.asarray(values[number[tuple(nearest)]])

    def sample(self, maps: Singles, rows: Integers, columns: Integers) -> Singles:
        """Return the values (n, F) of a map (h, w, F) at some pixels, by bilinear interpolation between the centres."""
        height, width, count = maps.shape
        found = np.zeros((len(rows), count), np.float32)
        y, x = (
            ((axis.astype(np.float32) - self._shift) / self.step).clip(0, size - 1)
            for axis, size in ((rows, height), (columns, width))
        )
        top, left = y.astype(np.intp), x.astype(np.intp)
        down, across = y - top, x - left
        cells = maps.reshape(-1, count)
        for row, down_share in ((top, 1 - down), ((top + 1).clip(max=height - 1), down)):
            for column, share in ((left, 1 - across), ((left + 1).clip(max=width - 1), across)):
                found += cells.take(row * width + column, axis=0) * (down_share * share)[:, None]
        return found

    @property
    def _shift(self) -> float:
        """The centre of the first block, in pixels."""
        return (self.step - 1) / 2
