"""IW12: robust photometric stereo by sparse Bayesian learning.

S. Ikehata, D. Wipf, Y. Matsushita, K. Aizawa, "Robust photometric stereo using sparse regression", CVPR 2012,
section 3.2, with lambda = 0, as in the authors' own comparisons.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.fits.shadows import lit_observations
from splinecli.fits.weighted_least_squares import weighted_least_squares
from splinecli.observation_map import dot

SHADOW_SHARE = 0.1
"""Of the pixel's quantile UNSHADED: what is darker is left out as shadow; the authors threshold shadows, too."""

SMALLEST_VARIANCE = 1e-6
"""Of an error, where the largest intensity is 1: a camera resolves a thousandth of it at best."""

ITERATIONS = 20
"""Further ones turn the normals of real captures by some hundredths of a degree on average."""


def solve(
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    shadow_share: float = SHADOW_SHARE,
    iterations: int = ITERATIONS,
) -> Tensor:
    """Scaled normals b (P, 3) of I = L b + e with sparse e: one variance gamma for each observation's error.

    b = (L' W L + sigma^2)^-1 L' W I with W = diag(1 / gamma); gamma_k = e_k^2 + var(e_k), where var(e) is
    the diagonal of L (L' W L + sigma^2)^-1 L'. An error that b explains loses its variance, and its observation
    then pulls harder; shadows and highlights keep theirs.

    The constants mean something only for a fixed scale of the intensities: here the pixel's largest is 1, so that
    bright and dark pixels are treated alike. Variances start at 1, which says nothing about the errors yet: the
    first step is least squares. sigma is 1e-6 (eq. 12), the ridge of weighted_least_squares.

    Args:
        observations: (P, F) float64, the largest of each pixel 1.
        light_directions: (F, 3) or (P, F, 3) float64, unit.
        valid: (P, F) bool, all by default.
        shadow_share: see lit_observations. The authors threshold shadows as well; 0 keeps all observations.
    """
    lit = lit_observations(observations, shadow_share, valid).to(observations.dtype)
    variance = torch.ones_like(observations)
    for _ in range(iterations):
        scaled_normals, uncertainty = weighted_least_squares(observations, light_directions, lit / variance)
        error = observations - dot(scaled_normals, light_directions)
        variance = (error.square() + uncertainty).clamp(min=SMALLEST_VARIANCE)
    return scaled_normals
