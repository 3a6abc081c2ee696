"""A map in tiles that overlap, so that memory does not grow with the map."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.estimate.networks.refine_net import COARSEST, Box
from splinecli.maths import Bools, Float32Array, Integers
from splinecli.maths.pixel_grid import bounds


@dataclass(frozen=True)
class Tile:
    """A part of the map with a margin."""

    box: Box  # where it is in the map, with the margin
    # (h, w), of the box; multiples of COARSEST, so that a rotated tile has the same cells
    mask: Bools
    rows: Integers  # (h, w), the rows of its pixels in the capture
    inner: Box  # the part of the box without the margin


class Band:
    """The refined normals and errors of a row of tiles, until the tiles below no longer need those
    from before.

    The pixels follow one another in the capture, of which the normals (P, 3) and errors (P, 2) are.
    """

    def __init__(self, pixels: slice, normals: Float32Array, errors: Float32Array) -> None:
        self._pixels = pixels
        self._pairs = [(values, values[pixels].copy()) for values in (normals, errors)]

    def put(self, rows: Integers, *refined: Float32Array) -> None:
        """Keep refined normals and errors of some of the band's pixels."""
        for (_, kept), found in zip(self._pairs, refined, strict=True):
            kept[rows - self._pixels.start] = found

    def write(self) -> None:
        """Write the kept values into the arrays of the whole capture."""
        for whole, kept in self._pairs:
            whole[self._pixels] = kept


def rows_of_tiles(mask: Bools, tile: int, margin: int) -> Iterator[tuple[slice, Iterator[Tile]]]:
    """Yield the pixels of each row of tiles, and its tiles that have pixels.

    The sides of the mask (H, W) and of a tile, and the context around it, are multiples of
    COARSEST.
    """
    above = pixels_before(mask)
    for top in range(0, mask.shape[0], tile):
        bottom = min(top + tile, len(mask))
        pixels = slice(int(above[top]), int(above[bottom]))
        band = slice(max(0, top - margin), min(top + tile + margin, len(mask)))
        rows = mask[band].cumsum(dtype=np.int32).reshape(mask[band].shape)
        rows += int(above[band.start]) - 1
        yield (
            pixels,
            _tiles_of_band(
                mask[band], rows, band, slice(top - band.start, bottom - band.start), tile, margin
            ),
        )


def _tiles_of_band(
    mask: Bools,
    rows: Integers,
    band: slice,
    inside: slice,
    tile: int,
    margin: int,
) -> Iterator[Tile]:
    for left in range(0, mask.shape[1], tile):
        outer = slice(max(0, left - margin), min(left + tile + margin, mask.shape[1]))
        inner = inside, slice(left - outer.start, left - outer.start + tile)
        if mask[:, outer][inner].any():
            yield Tile((band, outer), mask[:, outer], rows[:, outer], inner)


def pixels_before(mask: Bools) -> NDArray[np.int64]:
    """Return how many pixels of a mask (H, W) are above each of its rows, and in all of them (H +
    1,).
    """
    return np.concatenate(([0], np.count_nonzero(mask, axis=1).cumsum()))


def around_object(mask: Bools) -> Bools:
    """Return the part of a mask that has pixels, between multiples of COARSEST. Behind the map it
    has a margin.
    """
    (top, bottom), (left, right) = (
        (first // COARSEST * COARSEST, -(-(last + 1) // COARSEST) * COARSEST)
        for first, last in bounds(mask)
    )
    part = mask[top:bottom, left:right]
    height, width = part.shape
    return np.pad(part, ((0, bottom - top - height), (0, right - left - width)))


def turned_part(part: Box, shape: tuple[int, ...], quarters: int) -> Box:
    """Return where a part of a map of this shape is after a counterclockwise rotation by `quarters`
    quarter turns.
    """
    rows, columns = (slice(*side.indices(length)) for side, length in zip(part, shape, strict=True))
    height, width = shape
    for _ in range(quarters):
        rows, columns = slice(width - columns.stop, width - columns.start), rows
        height, width = width, height
    return rows, columns
