"""The camera of a calibration: its matrix, where it is known from, and how uncertain it is."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.formats.facts import ImageFacts
from splinecli.capture.lights.lamp_files import read_camera_matrix
from splinecli.maths import Doubles
from splinecli.maths.normals import unit
from splinecli.surface.pixel_grid import ray_basis

DISTANT = 1e6  # focal length, in pixels, of a camera that counts as distant: all its rays are nearly parallel

SHORTEST_LENS = 0.7
"""Shortest usual focal length, in longer sides of the image: that of a telephone, 25 mm for 36 mm of film."""

EXIF_ERROR = 0.05
"""Standard deviation of a focal length in EXIF, as a share: numbers are rounded, and focusing changes it."""

_FOCAL_LENGTH, _WIDTH, _RESOLUTION, _UNIT, _FILM = 0x920A, 0xA002, 0xA20E, 0xA210, 0xA405
_MILLIMETRES = {2: 25.4, 3: 10.0}
_FILM_DIAGONAL = math.hypot(36, 24)


@dataclass(frozen=True, eq=False)
class View:
    """The camera of a calibration."""

    matrix: Doubles  # (3, 3) in pixels
    source: str  # "--camera-matrix", "EXIF" or "assumed distant"
    shortest: float  # the focal length of the shortest usual lens, in pixels

    @property
    def known(self) -> bool:
        return self.source != "assumed distant"

    def draw(self, generator: np.random.Generator) -> Doubles:
        """Return a matrix (3, 3) that may be the true one."""
        factor = 1.0
        if not self.known:
            # All rays of sight from parallel to those of the shortest lens, evenly.
            nearest = self.shortest / float(self.matrix[0, 0])
            factor = nearest / generator.uniform(nearest, 1)
        elif self.source == "EXIF":
            factor = math.exp(EXIF_ERROR * generator.normal())
        matrix = self.matrix.copy()
        matrix[:2, :2] *= factor
        return matrix


def unit_rays(points: Doubles, matrix: Doubles) -> Doubles:
    """Return the unit vectors (N, 3) from a camera at the origin through image points (N, 2)."""
    return unit(np.column_stack((points, np.ones(len(points)))) @ ray_basis(matrix))


def find_view(image: ImageFacts, matrix: Path | None) -> View:
    """Return the camera that a file of its matrix, or an image's EXIF tags, describe; else a distant one.

    Raises InputError where the file or the image cannot be read, or the file has no camera matrix.
    """
    height, width = image.size[0][:2]
    shortest = SHORTEST_LENS * max(width, height)
    if matrix is not None:
        given = read_camera_matrix(matrix)
        ray_basis(given)  # refuses other numbers
        return View(given, "--camera-matrix", shortest)
    found = _focal_length(image.exif or {}, width, height)
    focal = found or DISTANT
    given = np.array(((focal, 0, (width - 1) / 2), (0, focal, (height - 1) / 2), (0, 0, 1.0)))
    return View(given, "assumed distant" if found is None else "EXIF", shortest)


def _focal_length(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """Return the focal length in pixels from EXIF tags; None where they do not tell it."""
    try:
        if tags.get(_RESOLUTION) and tags.get(_FOCAL_LENGTH) and tags.get(_UNIT, 2) in _MILLIMETRES:
            pixels = float(tags[_FOCAL_LENGTH]) * float(tags[_RESOLUTION]) / _MILLIMETRES[tags.get(_UNIT, 2)]
            pixels *= width / float(tags.get(_WIDTH) or width)  # the picture may be scaled
        else:
            pixels = float(tags[_FILM]) / _FILM_DIAGONAL * math.hypot(width, height)
    except Exception:  # damaged tags cause a dozen types of errors
        return None
    return pixels if SHORTEST_LENS / 3 * width < pixels < DISTANT else None
