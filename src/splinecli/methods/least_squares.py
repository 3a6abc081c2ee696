"""LS: Lambertian least squares.

R. J. Woodham, "Photometric method for determining surface orientation from multiple images", 1980.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.fits.robust import solve_each
from splinecli.maths.normals import unit
from splinecli.methods.estimator import Directions, Observations
from splinecli.system.progress import Progress

TOWARDS_CAMERA = (0.0, 0.0, 1.0)  # the normal of a pixel that is dark under every light


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
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3); see Estimator."""
        values = observations.astype(np.float64)
        if light_directions.ndim == 2:
            scaled = values @ np.linalg.pinv(light_directions).T
        else:
            scaled = solve_each(values, light_directions)
        normals: NDArray[np.float64] = unit(scaled)
        normals[~scaled.any(axis=1)] = TOWARDS_CAMERA
        if progress is not None:
            progress(len(normals))
        return normals
