"""LS with shadows and highlights trimmed: least squares over the observations of middling intensity."""

from __future__ import annotations

from torch import Tensor

from splinecli.fits.shadows import lit_observations
from splinecli.fits.weighted_least_squares import weighted_least_squares

TRIMMED_SHARE = 0.2
"""Of the observations, at either end. With ten lights the two darkest and the two brightest go."""

SHADOW_SHARE = 0.1
"""Of the pixel's quantile UNSHADED, as IW12 has it."""

FEWEST = 4
"""Observations that stay: one more than a normal and an albedo need."""


def solve(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Scaled normals b (P, 3): |I - L b| is minimised without shadows and without the darkest and brightest.

    Equal observations stay or go together, so that the order of the lights does not matter.

    Args:
        observations: (P, F) float64, the largest of each pixel 1.
        light_directions: (F, 3) float64, unit.
    """
    count = observations.shape[1]
    trimmed = max(0, min(int(TRIMMED_SHARE * count), (count - FEWEST) // 2))
    ordered = observations.sort(dim=1).values
    darkest, brightest = ordered[:, trimmed, None], ordered[:, count - 1 - trimmed, None]
    middling = (observations >= darkest) & (observations <= brightest)
    weight = lit_observations(observations, SHADOW_SHARE, middling)
    scaled_normals, _ = weighted_least_squares(observations, light_directions, weight.to(observations.dtype))
    return scaled_normals
