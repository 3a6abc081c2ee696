"""The pixels of a map: their rays through a pinhole camera, and square blocks of pixels for coarser
scales.

A camera matrix is [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels. Columns count to the right, rows
count down, and (0, 0) is the centre of the first pixel, as in OpenCV. Rays are in the frame of
docs/files-and-frames.md: x right, y up, z to the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths import Array, Bools, Float32Array, Float64Array, Floats, Integers

Places = NDArray[np.number[Any]]
Value = TypeVar("Value", bound=np.generic)

# Largest number in a camera matrix. Larger numbers would make integration overflow or singular.
_LARGEST = 1e6


def on_map(values: NDArray[Value], mask: Bools) -> NDArray[Value]:
    """Return a map (H, W, ...) of values (P, ...) at the pixels of a mask (H, W), zero outside."""
    placed = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
    placed[mask] = values
    return placed


def thin_out(values: NDArray[Value], mask: Bools, step: int) -> tuple[NDArray[Value], Bools]:
    """Return the values (p, ...) and the mask (h, w) of every step-th row and column of a mask (H,
    W), whose pixels have values (P, ...).
    """
    if step == 1:
        return values, mask
    grid = np.zeros_like(mask)
    grid[::step, ::step] = True
    return values[grid[mask]], mask[::step, ::step]


def bounds(mask: Bools) -> tuple[Integers, Integers]:
    """Return the first and last row (2,), and the first and last column (2,), of a mask."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis))[[0, -1]] for axis in (1, 0))
    return rows, columns


def slices(count: int, size: int) -> Iterator[slice]:
    """Return slices of at most `size` items that together cover `count` items."""
    return (slice(start, start + size) for start in range(0, count, size))


def pixel_rays(mask: Bools, camera_matrix: Floats) -> Float64Array:
    """Return the points (P, 3) at depth 1, z = -1, on the camera rays of the pixels of a mask (H,
    W).

    The camera is at the origin. Raises UsageError if the camera matrix is not 3 x 3, or InputError
    if it is not a valid camera matrix.
    """
    rows, columns = np.nonzero(mask)
    return rays_at(rows, columns, camera_matrix)


def rays_at(rows: Places, columns: Places, camera_matrix: Floats) -> Float64Array:
    """Return points (N, 3) as in pixel_rays for image rows and columns (N,). Raises the same
    errors.
    """
    image = np.stack((columns, rows, np.ones(len(rows))), axis=1).astype(np.float64)
    return image @ ray_basis(camera_matrix)


def image_points(
    points: Floats, shape: tuple[int, ...], camera_matrix: Floats | None
) -> Float64Array:
    """Return the columns and rows (P, 2) of the projections of points (P, 3), relative to the
    camera.

    Without a camera matrix, the projection is orthographic, and the points are in pixels from the
    centre of the image of `shape` (H, W).
    """
    if camera_matrix is None:
        return np.asarray(
            points[:, :2] * (1, -1) + ((shape[1] - 1) / 2, (shape[0] - 1) / 2), np.float64
        )
    image = points.astype(np.float64) * (1, -1, -1) @ np.asarray(camera_matrix, np.float64).T
    return image[:, :2] / image[:, 2:]


def focal_length(camera_matrix: Floats) -> float:
    """Return the focal length in pixels, the geometric mean of its values along both axes."""
    return float(np.sqrt(np.linalg.det(np.asarray(camera_matrix, np.float64)[:2, :2])))


def ray_basis(camera_matrix: Floats) -> Float64Array:
    """Return the matrix (3, 3) by which an image point (column, row, 1) is multiplied to obtain its
    ray.

    The first row is the step of a ray from one column to the next, the second the step from one row
    to the next, and the third the ray of the image's origin. Raises the errors of pixel_rays.
    """
    matrix = np.asarray(camera_matrix, np.float64)
    if matrix.shape != (3, 3):
        raise UsageError(f"the camera matrix has shape {matrix.shape}, expected (3, 3)")
    if not (
        (np.abs(matrix) <= _LARGEST).all()  # False for NaN
        and min(matrix[0, 0], matrix[1, 1], np.linalg.det(matrix[:2, :2])) > 1 / _LARGEST
        and (matrix[2] == (0, 0, 1)).all()
    ):
        raise InputError(
            f"{matrix.tolist()} is not a camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with"
            " positive fx and fy, and numbers of at most a million",
            hint="Use pixels, with columns to the right and rows down",
        )
    return np.asarray(np.linalg.inv(matrix).T * (1, -1, -1), np.float64)


@dataclass(frozen=True)
class Blocks:
    """Blocks of step x step pixels that contain pixels of the object."""

    mask: Bools  # (h, w) bool, true for the p blocks
    step: int  # side of a block in pixels

    @classmethod
    def over(cls, mask: Bools, number: int) -> Blocks:
        """Return about `number` blocks over the pixels of a mask (H, W), and at most twice as
        many.
        """
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
        """Return the camera matrix in blocks from the matrix in pixels, or None for an orthographic
        camera.
        """
        if camera_matrix is None:
            return None
        shrunk = np.array(((1, 0, -self._shift), (0, 1, -self._shift), (0, 0, self.step)))
        return shrunk / self.step @ camera_matrix

    def interpolate(self, depth: Floats, mask: Bools) -> Floats:
        """Return the depths (P,) of the pixels of a mask (H, W) from the depths of the blocks (h,
        w).
        """
        if self.step == 1:
            return depth[mask]
        from scipy.ndimage import map_coordinates

        places = [(axis - self._shift) / self.step for axis in np.nonzero(mask)]
        return np.asarray(
            map_coordinates(self.spread(depth[self.mask]), places, order=1, mode="nearest")
        )

    def numbers_at(self, rows: Integers, columns: Integers) -> Integers:
        """Return the indices (P,) of the blocks that contain these pixels."""
        number = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        return number[rows // self.step, columns // self.step]

    def spread(self, values: Array) -> Array:
        """Return a map (h, w, ...) of the blocks' values (p, ...). Cells without a block copy the
        nearest one.
        """
        from scipy.ndimage import distance_transform_edt

        number = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)
        nearest = distance_transform_edt(~self.mask, return_distances=False, return_indices=True)
        return np.asarray(values[number[tuple(nearest)]])

    def sample(self, maps: Float32Array, rows: Integers, columns: Integers) -> Float32Array:
        """Return the values (n, F) of a map (h, w, F) at these pixels, interpolated bilinearly."""
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
        """The centre of the first block in pixels."""
        return (self.step - 1) / 2
