"""LS: Lambertian least squares.

R. J. Woodham, "Photometric method for determining surface orientation from multiple images", 1980.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.normals import unit

TOWARDS_CAMERA = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class LeastSquares:
    """Minimise |I - L b| over all observations, shadows included; n = b / |b|. In float64 on the CPU."""

    name: str = "ls"
    weights: None = None
    device: str = "cpu"
    precision: str = "float64"
    fingerprint: str = "ls"

    def estimate(
        self, observations: NDArray[np.floating], light_directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Unit normals (P, 3) from observations (P, F) under lights (F, 3)."""
        # One pseudo-inverse serves all pixels: they share the lights.
        scaled = observations.astype(np.float64) @ np.linalg.pinv(light_directions).T
        normals: NDArray[np.float64] = unit(scaled)
        normals[~scaled.any(axis=1)] = TOWARDS_CAMERA
        return normals
