"""Random errors of light directions, as from an inaccurate calibration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import unit

LARGEST_SIGMA_DEG = 30.0
"""Largest standard deviation that an evaluation accepts."""

_LARGEST_TILT_DEG = 89.0


def tilt_lights(
    light_directions: NDArray[np.float64], sigma_deg: float, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return unit light directions (F, 3), each turned by an angle from N(0, sigma_deg) in a random direction.

    The root mean square of the angles is sigma_deg. A light that would fall below the horizon (z <= 0) is turned the
    opposite way and stays above it, so that a capture may have any of the directions.
    """
    n_lights = len(light_directions)
    angle = np.radians(generator.normal(0.0, sigma_deg, n_lights).clip(-_LARGEST_TILT_DEG, _LARGEST_TILT_DEG))
    # A Gaussian vector without its part along the light: every perpendicular direction is equally likely.
    across = generator.normal(size=(n_lights, 3))
    along = np.einsum("fi,fi->f", across, light_directions)
    across = unit(across - along[:, None] * light_directions)
    sunk = np.cos(angle) * light_directions[:, 2] + np.sin(angle) * across[:, 2] <= 0
    angle = np.where(sunk, -angle, angle)[:, None]
    tilted: NDArray[np.float64] = unit(np.cos(angle) * light_directions + np.sin(angle) * across)
    return tilted
