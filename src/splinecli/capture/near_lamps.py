"""Nearby lamps, modelled as point lights above an image of known scale, and checks that their
positions are plausible.

The frame is the same as for light directions: x right, y up, z to the camera. The origin is on the
object's mean plane, at the centre of the image. Positions may be in any unit, such as millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError
from splinecli.maths import Bools, Float32Array, Float64Array, Floats, Integers
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.pixel_grid import bounds
from splinecli.records.capture_warnings import LAMP_DISTANCE, NEAR_LAMPS, CaptureWarning


@dataclass(frozen=True, eq=False)
class NearLamps:
    """F lamps, modelled as point lights, above an image of known scale.

    Raises InputError if a position is not finite or not in front of the object, or if the pixel
    size is not above 0.
    """

    positions: Float64Array  # (F, 3), in any unit, in front of the object's mean plane (z > 0)
    # width of a pixel on the object's mean plane, in the unit of the positions
    pixel_size: float
    # row and column of the origin, in pixels of the window
    middle: tuple[float, float]
    # (F,), the distances along the lamps' axes at which the light intensities are valid; see `of`
    reference_distances: Float64Array
    # (3, 3) in pixels, as in OpenCV. None assumes an orthographic camera
    camera_matrix: Float64Array | None = None
    # (P, 3), the surface points at the pixels, in the unit of the positions; None if unknown
    points: Float32Array | None = None
    # (F, 4), the axis of each lamp, a unit vector towards the object, and its exponent mu. At an
    # angle a from the axis, the intensity is cos(a)^mu, as in the LED model (Quéau et al.,
    # LED-based photometric stereo, JMIV 2018, section 2.1). None for lamps that emit equally in all
    # directions
    lobes: Float64Array | None = None

    def __post_init__(self) -> None:
        shape = self.positions.shape
        if len(shape) != 2 or shape[1] != 3 or not np.isfinite(self.positions).all():
            raise InputError(f"lamp positions of shape {shape}, expected finite (F, 3)")
        if (self.positions[:, 2] <= 0).any():
            raise InputError("a lamp is behind the object (z <= 0)", hint="z points to the camera")
        if not 0 < self.pixel_size < np.inf:
            raise InputError(f"the pixel size is {self.pixel_size:g}, expected a number above 0")

    @classmethod
    def of(
        cls,
        positions: Float64Array,
        pixel_size: float,
        shape: tuple[int, ...],
        *,
        equal: bool,
        camera_matrix: Float64Array | None = None,
        lobes: Float64Array | None = None,
    ) -> NearLamps:
        """Return lamps at positions (F, 3) above whole images of shape (H, W).

        Args:
            equal: whether the light intensities are unknown; all lamps are then assumed to be
                equally bright along their axes. Otherwise, the intensities are valid at the origin,
                as if measured with a gray card there.
        """
        distances = np.linalg.norm(positions, axis=1)
        if equal:
            distances = np.full_like(distances, distances.mean())
        elif lobes is not None:
            towards = positions[None] / distances[:, None]
            distances = distances / np.sqrt(within_lobes(lobes, towards)[0])
        middle = (shape[0] - 1) / 2, (shape[1] - 1) / 2
        return cls(positions, pixel_size, middle, distances, camera_matrix, lobes=lobes)

    def within(
        self, left: float, top: float, step: int, camera_matrix: Float64Array | None
    ) -> NearLamps:
        """Return the lamps for a window that starts at (left, top) and contains every step-th
        pixel.

        The camera matrix is in pixels of the window.
        """
        middle = (self.middle[0] - top) / step, (self.middle[1] - left) / step
        return replace(
            self, pixel_size=step * self.pixel_size, middle=middle, camera_matrix=camera_matrix
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the distances from the origin, the scale, the camera and the lobes as JSON
        values.
        """
        return {
            "distances": np.linalg.norm(self.positions, axis=1).round(4).tolist(),
            "pixel_size": self.pixel_size,
            "camera": "orthographic" if self.camera_matrix is None else "perspective",
            "camera_matrix": None if self.camera_matrix is None else self.camera_matrix.tolist(),
            "lobes": None if self.lobes is None else self.lobes.round(4).tolist(),
        }

    def turned(self, directions: Float64Array) -> NearLamps:
        """Return the lamps in other directions (F, 3), at the same distances from the origin."""
        return replace(
            self, positions=directions * np.linalg.norm(self.positions, axis=1, keepdims=True)
        )

    def choose_lights(self, positions: Sequence[int]) -> NearLamps:
        """Return a selection of the lamps, in the given order."""
        chosen = list(positions)
        return replace(
            self,
            positions=self.positions[chosen],
            reference_distances=self.reference_distances[chosen],
            lobes=None if self.lobes is None else self.lobes[chosen],
        )

    def choose_pixels(self, rows: slice | Integers) -> NearLamps:
        """Return the lamps with the surface points of a selection of pixels."""
        return self if self.points is None else replace(self, points=self.points[rows])

    def plane_points(self, rows: NDArray[np.number], columns: NDArray[np.number]) -> Float64Array:
        """Return points (N, 3) on the object's mean plane, from image rows and columns (N,)."""
        middle_row, middle_column = self.middle
        across, up = columns - middle_column, middle_row - rows
        return np.stack((across, up, np.zeros(len(rows))), axis=1) * self.pixel_size

    def extent(self, mask: Bools) -> tuple[tuple[float, float], Float64Array]:
        """Return the size and the centre of the mask's bounding box on the object's mean plane.

        The size is (width, height), and the centre is a point (3,).
        """
        rows, columns = bounds(mask)
        width, height = (float(np.ptp(places) + 1) * self.pixel_size for places in (columns, rows))
        return (width, height), self.plane_points(rows.mean()[None], columns.mean()[None])[0]

    def angles_across_deg(self, mask: Bools) -> Float64Array:
        """Return the change (F,) of each lamp's direction across the object, in degrees.

        This is the largest angle between the directions at the centre and at a corner of the mask's
        bounding box, on the object's mean plane.
        """
        rows, columns = bounds(mask)
        row, column = np.meshgrid([*rows, rows.mean()], [*columns, columns.mean()])
        directions, _ = self.light_at(self.plane_points(row.ravel(), column.ravel()))
        return np.asarray(angle_between_deg(directions, directions[-1]).max(axis=0))

    def light_at(self, points: Floats) -> tuple[Float32Array, Float32Array]:
        """Return the light at points (P, 3) as unit directions (P, F, 3) and attenuations (P, F).

        The attenuation follows the inverse square of the distance, relative to the lamp's reference
        distance, and is multiplied by the lamp's lobe.
        """
        towards = (self.positions - np.asarray(points, np.float64)[:, None]).astype(np.float32)
        distance = np.sqrt(np.einsum("pfc,pfc->pf", towards, towards))
        towards /= distance[..., None]
        attenuation = np.square(self.reference_distances.astype(np.float32) / distance)
        if self.lobes is not None:
            attenuation = attenuation * within_lobes(self.lobes, towards)
        return towards, attenuation


def within_lobes(lobes: Float64Array, towards: Floats) -> Float32Array:
    """Return the intensities (P, F) of lamps relative to those on their axes, from unit directions
    (P, F, 3) towards the lamps.
    """
    cosines = np.einsum("pfc,fc->pf", towards, -lobes[:, :3])
    # Dividing observations by the lobe amplifies noise, so small values are clipped. Pixels outside
    # the lobe then appear shadowed.
    return np.asarray(cosines.clip(min=0) ** lobes[:, 3], np.float32).clip(min=0.05)


UNIT_HINT = (
    "Use the same unit, such as millimetres, for all lengths: the lamp positions or distance, and"
    " the pixel size or object width"
)


def check_distances(lamps: NearLamps, mask: Bools, positions: Path | None) -> list[CaptureWarning]:
    """Return warnings about implausible distances between the lamps and an object with mask (H, W).

    Errors name the file of positions. Raises InputError if a lamp would be inside the object.
    """
    sizes, middle = lamps.extent(mask)
    distances = np.linalg.norm(lamps.positions - middle, axis=1)
    nearest = int(distances.argmin())
    text = (
        f"lamp {nearest + 1} is {distances[nearest]:.3g} away from the centre of the object, which"
        f" is {sizes[0]:.3g} wide"
    )
    if distances[nearest] < 0.5 * min(sizes):
        raise InputError(f"{text}, so it would be inside the object", positions, hint=UNIT_HINT)
    if distances[nearest] < max(sizes):
        problem = "A lamp is very near"
    # Confusing metres with millimetres changes the distance by a factor of 1000.
    elif distances[nearest] > 300.0 * max(sizes):
        problem = "The lamps are so far away that their light is practically parallel"
    else:
        return []
    return [CaptureWarning(LAMP_DISTANCE, f"{problem}: {text}. {UNIT_HINT}.")]


def distant_lights(
    positions: Path | None, lamps: NearLamps | None, mask: Bools
) -> list[CaptureWarning]:
    """Return a warning if lights are treated as distant although a file contains their positions.

    `lamps` are the lamps in this file, or None if their scale is unknown. The mask is (H, W).
    """
    name = "the lamp positions" if positions is None else positions.name
    if lamps is None:
        text = (
            f"{name} is not used, because the size of a pixel is unknown. Add --pixel-size or"
            " --object-width."
        )
        return [CaptureWarning(NEAR_LAMPS, text)]
    if (angle_deg := lamps.angles_across_deg(mask).max()) <= 2.0:
        return []
    text = (
        f"The lights are treated as distant, but the lamps are near: according to {name}, a light"
        f" direction changes by up to {angle_deg:.0f} degrees between the centre and the edge of"
        " the object. Use --light-positions instead of --lights."
    )
    return [CaptureWarning(NEAR_LAMPS, text)]
