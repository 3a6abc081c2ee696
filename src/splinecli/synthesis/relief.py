"""Relief on the surface of a mesh: a tileable normal map that turns the visible normals.

Meshes of scenes are smooth from one pixel to the next. Stone, cloth and leather are not, and networks that were trained
without such detail smooth it away. Shadows stay those of the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from splinecli.capture.formats.images import read_image
from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.synthesis.meshes import Floats
from splinecli.synthesis.shapes import draw_rotation

_LEAST_Z = 0.1  # lowest z to which a relief turns a normal that was higher
_STEEPEST = 4.0  # largest slope that is read from a normal map


def read_relief(path: Path) -> Floats:
    """Read a tileable normal map, RGB = (n + 1) / 2, as the slopes (h, w, 2) of its height along its columns and rows.

    Whether green points up or down is found from the slopes: those of a surface have no curl. Raises InputError if the
    file is not a colour image. The vectors need no unit length.
    """
    normals = 2 * read_image(path) - 1
    if normals.shape[2] != 3:
        raise InputError("found a gray image, expected a normal map", path=path)
    slopes = -normals[..., :2] / np.maximum(normals[..., 2:], 1 / _STEEPEST)
    slopes = (slopes - slopes.mean(axis=(0, 1))).clip(-_STEEPEST, _STEEPEST)
    along_rows, along_columns = np.gradient(slopes[..., 0], axis=0), np.gradient(slopes[..., 1], axis=1)
    down = np.square(along_rows - along_columns).sum() < np.square(along_rows + along_columns).sum()
    return np.asarray(slopes if down else slopes * np.array((1, -1)), np.float32)


@dataclass(frozen=True)
class Relief:
    """A relief, projected along three axes: each point of a surface uses the axis that is nearest to its normal."""

    slopes: Floats  # (h, w, 2), of the height along the columns and the rows
    axes: Floats  # (3, 3), orthonormal rows
    period: float  # width of one tile; the camera's square is 2 wide

    def bend(self, normals: Floats, positions: Floats) -> Floats:
        """Return the normals (N, 3) of points (N, 3) of a surface with this relief.

        A normal that would turn away from the camera is turned by less.
        """
        local, places = normals @ self.axes.T, positions @ self.axes.T / np.float32(self.period)
        first = (np.abs(local).argmax(axis=1) + 1) % 3
        second, rows = (first + 1) % 3, np.arange(len(normals))
        height, width = self.slopes.shape[:2]
        columns, lines = (places[rows, axis] % 1 for axis in (first, second))
        slopes = self.slopes[
            np.minimum((lines * height).astype(int), height - 1), np.minimum((columns * width).astype(int), width - 1)
        ]
        rise = slopes[:, :1] * self.axes[first] + slopes[:, 1:] * self.axes[second]
        rise -= (rise * normals).sum(axis=1, keepdims=True) * normals
        turned = unit(normals - rise)
        lowest = np.minimum(normals[:, 2:], _LEAST_Z)
        fall = np.maximum(normals[:, 2:] - turned[:, 2:], 1e-6)
        return unit(normals + np.minimum(1, (normals[:, 2:] - lowest) / fall) * (turned - normals))


def draw_relief(slopes: Floats, size: int, rng: np.random.Generator) -> Relief:
    """Draw a relief from the slopes of a normal map, for images of `size` pixels a side.

    A tile is 10^U(-0.6, 0.4) wide, in units of half the frame. The root mean square of the slopes, in the resolution of
    a third of a pixel, is U(0.05, 0.6). The axes are uniform over all rotations.
    """
    period = float(10 ** rng.uniform(-0.6, 0.4))
    side = max(8, round(1.5 * size * period))
    if side < min(slopes.shape[:2]):
        slopes = np.asarray(cv2.resize(slopes, (side, side), interpolation=cv2.INTER_AREA))
    steepness = rng.uniform(0.05, 0.6) / max(float(np.sqrt(np.square(slopes).sum(axis=2).mean())), 1e-3)
    return Relief(slopes * np.float32(steepness), draw_rotation(rng), period)
