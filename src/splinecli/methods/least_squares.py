"""LS: Lambertian least squares.

R. J. Woodham, "Photometric method for determining surface orientation from multiple images", 1980.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.methods.estimator import Directions, Observations, Progress
from splinecli.normals import unit

TOWARDS_CAMERA = (0.0, 0.0, 1.0)
"""The normal of a pixel that is dark under every light."""


@dataclass(frozen=True)
class LeastSquares:
    """Minimise |I - L b| over all observations, including shadows; n = b / |b|. In float64 on the CPU."""

    name: str = "ls"
    weights: None = None
    device: str = "cpu"
    precision: str = "float64"
    fingerprint: str = "ls"

    def estimate(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> NDArray[np.float64]:
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3); see Estimator."""
        # All pixels have the same lights, so one pseudo-inverse is enough.
        scaled = observations.astype(np.float64) @ np.linalg.pinv(light_directions).T
        normals: NDArray[np.float64] = unit(scaled)
        normals[~scaled.any(axis=1)] = TOWARDS_CAMERA
        if progress is not None:
            progress(len(normals))
        return normals
