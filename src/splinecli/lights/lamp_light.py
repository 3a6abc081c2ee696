"""The light of near lamps on a surface: points in space, and observations as distant lamps would give them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from splinecli.capture.near_lamps import NearLamps
from splinecli.maths import Floats, Integers, Singles
from splinecli.maths.normals import unit
from splinecli.surface.pixel_grid import focal_length, ray_basis, rays_at


def surface_points(lamps: NearLamps, rows: Floats, columns: Floats, depth: Floats) -> Singles:
    """Return the points (N, 3) of a surface, in the unit of the lamps' positions.

    Args:
        rows, columns: (N,), in pixels; (0, 0) is the centre of the first pixel.
        depth: (N,), as integrate_normals returns it: the height in pixels, or with a camera matrix the depth, here in
            multiples of the mean plane's depth.
    """
    if lamps.camera_matrix is None:
        middle_row, middle_column = lamps.middle
        points = np.stack((columns - middle_column, middle_row - rows, depth), axis=1) * lamps.pixel_size
    else:
        rays = rays_at(rows, columns, lamps.camera_matrix)
        points = rays * (depth * _plane_distance(lamps))[:, None] + _camera_position(lamps)
    return points.astype(np.float32)


def flat_depth(lamps: NearLamps) -> float:
    """Return the depth of the object's mean plane; see surface_points."""
    return 0.0 if lamps.camera_matrix is None else 1.0


@dataclass(frozen=True)
class LampLight:
    """Observations as distant lamps would give them, with the light directions of each pixel."""

    observations: Singles  # (P, F), without the falloff of the lamps
    # unit; (P, F, 3) in each pixel's own frame, whose z axis points to the camera, or (F, 3) for distant lights and an
    # orthographic camera
    directions: Floats
    turns: Singles | None = None  # (P, 3, 3), rotations from the capture's frame to these; None if all are equal

    @classmethod
    def of(cls, observations: Singles, lamps: NearLamps) -> LampLight:
        """Return the light on the points of `lamps`, from observations (P, F)."""
        assert lamps.points is not None
        directions, attenuation = lamps.light_at(lamps.points)
        turns = None
        if lamps.camera_matrix is not None:
            turns = _turns_to_view(unit(_camera_position(lamps) - lamps.points)).astype(np.float32)
            directions = np.einsum("pij,pfj->pfi", turns, directions)
        return cls(observations / attenuation, directions, turns)

    @classmethod
    def distant(cls, observations: Singles, directions: Floats, rays: Floats) -> LampLight:
        """Return the light of distant lamps, from directions (F, 3), on pixels with rays (P, 3) from the camera."""
        turns = _turns_to_view(unit(-rays)).astype(np.float32)
        return cls(observations, np.einsum("pij,fj->pfi", turns, directions.astype(np.float32)), turns)

    def in_frame_of_pixels(self, normals: Floats) -> Floats:
        """Return normals (P, 3), given in the capture's frame, in the pixels' own."""
        return normals if self.turns is None else np.einsum("pij,pj->pi", self.turns, normals)

    def in_frame_of_capture(self, vectors: Floats) -> Floats:
        """Return normals (P, 3) or directions (P, F, 3), given in the pixels' own frames, in the capture's."""
        return vectors if self.turns is None else np.einsum("pji,p...j->p...i", self.turns, vectors)


Rows = Integers  # numbers of some of a capture's pixels, in the order of its mask
LightOf = Callable[[Rows], LampLight]  # from rows of a capture's pixels to their observations and light directions
LIT_AT_ONCE = 1 << 14  # pixels whose light is requested at once: under near lamps, each has its own lights


def parts_of_rows(count: int, size: int = LIT_AT_ONCE, *, step: int = 1) -> Iterator[Rows]:
    """Yield every step-th of the rows below `count`, `size` at a time."""
    for start in range(0, count, step * size):
        yield np.arange(start, min(start + step * size, count), step)


def _plane_distance(lamps: NearLamps) -> float:
    """Return the distance of the mean plane from the camera, from the width of a pixel there."""
    assert lamps.camera_matrix is not None
    return focal_length(lamps.camera_matrix) * lamps.pixel_size


def _camera_position(lamps: NearLamps) -> Floats:
    """Return the camera's place (3,): the image's middle shows the origin, at the distance of the mean plane."""
    assert lamps.camera_matrix is not None
    row, column = lamps.middle
    middle = np.array((column, row, 1.0)) @ ray_basis(lamps.camera_matrix)
    return np.asarray(-middle * _plane_distance(lamps))


def _turns_to_view(views: Floats) -> Floats:
    """Return the shortest rotations (P, 3, 3) of unit vectors (P, 3) with z > 0 onto the z axis."""
    x, y, z = views.T
    a, b, c = x * x / (1 + z), x * y / (1 + z), y * y / (1 + z)
    return np.stack((1 - a, -b, -x, -b, 1 - c, -y, x, y, z), axis=1).reshape(-1, 3, 3)
