"""The surface that decides from where, and how strongly, each near lamp lights each pixel.

Fit normals, integrate them, move the pixels onto the surface, and fit again with the light directions and the
inverse-square falloff that the lamps have there. The surface begins as the object's mean plane. (Logothetis et al., "A
CNN based approach for the point-light photometric stereo problem", arXiv 2210.04655, alternate alike.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.methods.lamp_light import estimate_under_lamps, flat_depth, surface_points
from splinecli.surface.integration import integrate_normals

Floats = NDArray[np.floating]

ROUNDS = 2
"""Fits on the way. An error of the surface counts only as a share of the distance of the lamps, so few are enough."""

METHOD = "iw12"
"""The fit on the way: fast, and robust against shadows and highlights."""

PIXELS_ON_THE_WAY = 40_000
"""Larger captures are fitted on the way at about this size: fine detail hardly moves the surface."""

SOLVES = 10
"""Solves of the integration on the way. The first is least squares; the others let the surface tear at edges."""


def find_surface(capture: Capture, *, rounds: int = ROUNDS) -> Capture:
    """Return the capture with the points of its surface. One that has them, or distant lights, stays as it is.

    Args:
        rounds: number of fits. 0 leaves the surface a plane.
    """
    lamps = capture.lamps
    if lamps is None or lamps.points is not None:
        return capture
    from splinecli.methods import make_estimator

    estimator = make_estimator(METHOD)
    blocks = Blocks.over(capture.mask, PIXELS_ON_THE_WAY)
    observations = blocks.average(capture.observations, capture.mask)
    depth = np.full(blocks.mask.shape, flat_depth(lamps))
    for _ in range(rounds):
        points = surface_points(lamps, *blocks.centres(), depth[blocks.mask])
        normals = estimate_under_lamps(estimator, observations, replace(lamps, points=points))
        depth = blocks.integrate(normals, lamps.camera_matrix)
    rows, columns = (places.astype(np.float64) for places in np.nonzero(capture.mask))
    points = surface_points(lamps, rows, columns, blocks.interpolate(depth, capture.mask))
    return replace(capture, lamps=replace(lamps, points=points))


@dataclass(frozen=True)
class Blocks:
    """The blocks of step x step pixels that contain a pixel of the object.

    Args:
        mask: (h, w) bool, true for these blocks; p of them.
        step: pixels along a side of a block.
    """

    mask: NDArray[np.bool_]
    step: int

    @classmethod
    def over(cls, mask: NDArray[np.bool_], number: int) -> Blocks:
        """Return about `number` blocks or fewer over the pixels of a mask (H, W)."""
        step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(mask) / number))))
        height, width = mask.shape
        blocks = np.zeros((-(-height // step), -(-width // step)), np.bool_)
        rows, columns = np.nonzero(mask)
        blocks[rows // step, columns // step] = True
        return cls(blocks, step)

    def centres(self) -> tuple[Floats, Floats]:
        """Return the rows and columns (p,) of the centres, in pixels of the capture."""
        rows, columns = np.nonzero(self.mask)
        return rows * self.step + self._shift, columns * self.step + self._shift

    def average(self, values: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return the means (p, F) over the blocks of the values (P, F) of a mask's pixels."""
        if self.step == 1:
            return values
        rows, columns = np.nonzero(mask)
        block = (np.cumsum(self.mask) - 1).reshape(self.mask.shape)[rows // self.step, columns // self.step]
        sums = np.stack([np.bincount(block, column) for column in values.T], axis=1)
        return (sums / np.bincount(block)[:, None]).astype(np.float32)

    def integrate(self, normals: Floats, camera_matrix: Floats | None) -> Floats:
        """Return the depth map (h, w) of normals (p, 3), in pixels of the capture as integrate_normals gives it."""
        normal_map = np.zeros((*self.mask.shape, 3))
        normal_map[self.mask] = normals
        if camera_matrix is None:
            return self.step * integrate_normals(normal_map, self.mask, max_iterations=SOLVES)
        shrunk = np.array(((1, 0, -self._shift), (0, 1, -self._shift), (0, 0, self.step))) / self.step
        return integrate_normals(normal_map, self.mask, shrunk @ camera_matrix, max_iterations=SOLVES)

    def interpolate(self, depth: Floats, mask: NDArray[np.bool_]) -> Floats:
        """Return the depths (P,) of the pixels of a mask (H, W) from those of the blocks (h, w)."""
        if self.step == 1:
            return depth[mask]
        from scipy.ndimage import distance_transform_edt, map_coordinates

        nearest = distance_transform_edt(~self.mask, return_distances=False, return_indices=True)
        places = [(axis - self._shift) / self.step for axis in np.nonzero(mask)]
        return np.asarray(map_coordinates(depth[tuple(nearest)], places, order=1, mode="nearest"))

    @property
    def _shift(self) -> float:
        """The centre of the first block, in pixels."""
        return (self.step - 1) / 2
