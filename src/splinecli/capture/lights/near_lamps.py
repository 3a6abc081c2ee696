"""Lamps at arm's length: their positions, and the scale that ties pixels to the unit of the positions.

The frame is that of light directions: x right, y up, z to the camera. The origin lies on the object's mean plane, at
the centre of the image. Positions may be in any unit, such as millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.maths import Bools, Doubles, Floats, Integers, Singles
from splinecli.maths.normals import angle_between_deg

_LEAST_SHARE = 0.05
"""Least intensity of a lobe. Observations are divided by it, and so is their noise. Outside, a pixel looks shadowed."""


@dataclass(frozen=True, eq=False)
class NearLamps:
    """F lamps as points of light, over an image of known scale.

    Raises:
        InputError: a position is not finite or not in front of the object, or the pixel size is not above 0.
    """

    positions: Doubles  # (F, 3), in any unit, in front of the object's mean plane (z > 0)
    pixel_size: float  # the width of a pixel on the object's mean plane, in the unit of the positions
    middle: tuple[float, float]  # row and column of the origin, in pixels of what was read
    # (F,), the distances along each lamp's axis at which the observations' light intensities hold. See `of`
    reference_distances: Doubles
    camera_matrix: Doubles | None = None  # (3, 3) in pixels, as in OpenCV. None is an orthographic camera
    points: Singles | None = None  # (P, 3), the surface in the pixels, in this unit; None if unknown
    # (F, 4), for each lamp its axis, a unit vector towards the object, and mu: at an angle a to the axis, its intensity
    # is cos(a)^mu, as that of an LED (Quéau et al., LED-based photometric stereo, JMIV 2018, section 2.1). None for
    # lamps that shine alike in all directions
    lobes: Doubles | None = None

    def __post_init__(self) -> None:
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or not np.isfinite(self.positions).all():
            raise InputError(f"lamp positions of shape {self.positions.shape}, expected finite (F, 3)")
        if (self.positions[:, 2] <= 0).any():
            raise InputError("a lamp lies behind the object (z <= 0)", hint="z points to the camera")
        if not 0 < self.pixel_size < np.inf:
            raise InputError(f"the pixel size is {self.pixel_size:g}, expected a number above 0")

    @classmethod
    def of(
        cls,
        positions: Doubles,
        pixel_size: float,
        shape: tuple[int, ...],
        *,
        equal: bool,
        camera_matrix: Doubles | None = None,
        lobes: Doubles | None = None,
    ) -> NearLamps:
        """Return lamps at positions (F, 3) over whole images of this shape (H, W).

        Args:
            equal: whether the light intensities are unknown, so that all lamps count as equally strong along their
                axes. Otherwise each intensity holds at the origin, where a gray card would measure it.
        """
        distances = np.linalg.norm(positions, axis=1)
        if equal:
            distances = np.full_like(distances, distances.mean())
        elif lobes is not None:
            distances = distances / np.sqrt(_within_lobes(lobes, positions[None] / distances[:, None])[0])
        middle = (shape[0] - 1) / 2, (shape[1] - 1) / 2
        return cls(positions, pixel_size, middle, distances, camera_matrix, lobes=lobes)

    def within(self, left: float, top: float, step: int, camera_matrix: Doubles | None) -> NearLamps:
        """Return the lamps over every step-th pixel from (left, top) on, with the camera matrix of these pixels."""
        middle = (self.middle[0] - top) / step, (self.middle[1] - left) / step
        return replace(self, pixel_size=step * self.pixel_size, middle=middle, camera_matrix=camera_matrix)

    def as_dict(self) -> dict[str, Any]:
        """Return the lamps as JSON values: their distances from the origin, and the scale."""
        distances = np.linalg.norm(self.positions, axis=1)
        return {
            "distances": distances.round(4).tolist(),
            "pixel_size": self.pixel_size,
            "camera": "orthographic" if self.camera_matrix is None else "perspective",
            "camera_matrix": None if self.camera_matrix is None else self.camera_matrix.tolist(),
            "lobes": None if self.lobes is None else self.lobes.round(4).tolist(),
        }

    def turned(self, directions: Doubles) -> NearLamps:
        """Return the lamps at the same distances from the origin, in other directions (F, 3)."""
        distances = np.linalg.norm(self.positions, axis=1, keepdims=True)
        return replace(self, positions=directions * distances)

    def choose_lights(self, positions: Sequence[int]) -> NearLamps:
        """Return some of the lamps, in the order given."""
        chosen = list(positions)
        lobes, distances = None if self.lobes is None else self.lobes[chosen], self.reference_distances[chosen]
        return replace(self, positions=self.positions[chosen], reference_distances=distances, lobes=lobes)

    def choose_pixels(self, rows: slice | Integers) -> NearLamps:
        """Return the lamps with the surface in some of the pixels."""
        return self if self.points is None else replace(self, points=self.points[rows])

    def plane_points(self, rows: NDArray[np.number], columns: NDArray[np.number]) -> Doubles:
        """Return the points (N, 3) of the object's mean plane at rows and columns (N,) of the image."""
        middle_row, middle_column = self.middle
        across, up = columns - middle_column, middle_row - rows
        return np.stack((across, up, np.zeros(len(rows))), axis=1) * self.pixel_size

    def extent(self, mask: Bools) -> tuple[tuple[float, float], Doubles]:
        """Return width and height of the rectangle around the mask (H, W), and its middle (3,) on the mean plane."""
        rows, columns = (np.flatnonzero(mask.any(axis=axis))[[0, -1]] for axis in (1, 0))
        width, height = (float(np.ptp(places) + 1) * self.pixel_size for places in (columns, rows))
        return (width, height), self.plane_points(rows.mean()[None], columns.mean()[None])[0]

    def angles_across_deg(self, mask: Bools) -> Doubles:
        """Return for each lamp (F,) how far its direction differs, at most, from that at the middle of the object.

        Only the corners of the rectangle around the mask (H, W) are compared, as points of the mean plane.
        """
        rows, columns = (np.flatnonzero(mask.any(axis=axis))[[0, -1]] for axis in (1, 0))
        row, column = np.meshgrid([*rows, rows.mean()], [*columns, columns.mean()])
        directions, _ = self.light_at(self.plane_points(row.ravel(), column.ravel()))
        return np.asarray(angle_between_deg(directions, directions[-1]).max(axis=0))

    def light_at(self, points: Floats) -> tuple[Singles, Singles]:
        """Return the light at points (P, 3): unit directions (P, F, 3), and strengths (P, F).

        A strength is the inverse square of the distance, relative to the light at the lamp's reference distance, times
        the share of the lamp's lobe.
        """
        towards = (self.positions - np.asarray(points, np.float64)[:, None]).astype(np.float32)
        distance = np.sqrt(np.einsum("pfc,pfc->pf", towards, towards))
        towards /= distance[..., None]
        strengths = np.square(self.reference_distances.astype(np.float32) / distance)
        return towards, strengths if self.lobes is None else strengths * _within_lobes(self.lobes, towards)


def _within_lobes(lobes: Doubles, towards: Floats) -> Singles:
    """Return the lamps' intensities (P, F) at points in unit directions (P, F, 3) to the lamps; along the axes 1."""
    cosines = np.einsum("pfc,fc->pf", towards, -lobes[:, :3])
    return np.asarray(cosines.clip(min=0) ** lobes[:, 3], np.float32).clip(min=_LEAST_SHARE)
