"""IW12: robust photometric stereo by sparse Bayesian learning.

S. Ikehata, D. Wipf, Y. Matsushita, K. Aizawa, "Robust photometric stereo using sparse regression", CVPR 2012,
section 3.2, with lambda = 0, as in the authors' own comparisons.
"""

import torch
from torch import Tensor

from splinecli.fits.shadows import lit_observations
from splinecli.fits.weighted_least_squares import weighted_least_squares
from splinecli.maths.observation_map import dot

SHADOW_SHARE = 0.1
"""Share of the pixel's quantile UNSHADED. Darker observations are left out as shadows, as the authors do."""

SMALLEST_VARIANCE = 1e-6
"""Smallest variance of an error, for a largest observation of 1. A camera resolves a thousandth at best."""

ITERATIONS = 20  # further iterations change the normals of real captures by only some hundredths of a degree on average


def solve(
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    shadow_share: float = SHADOW_SHARE,
    iterations: int = ITERATIONS,
) -> Tensor:
    """Return scaled normals b (P, 3) of I = L b + e with sparse e: each error has its own variance gamma.

    b = (L' W L + sigma^2)^-1 L' W I with W = diag(1 / gamma); gamma_k = e_k^2 + var(e_k), where var(e) is
    the diagonal of L (L' W L + sigma^2)^-1 L'. Where b explains an observation, its variance shrinks and its weight
    grows. Shadows and highlights keep a large variance.

    The constants require a fixed scale: the largest observation of a pixel is 1, so bright and dark pixels are treated
    alike. Variances start at 1, so the first step is least squares. sigma is 1e-6 (eq. 12), the ridge of
    weighted_least_squares.

    Args:
        observations: (P, F) float64, the largest of each pixel 1.
        light_directions: (F, 3) or (P, F, 3) float64, unit.
        valid: (P, F) bool. None means all are valid.
        shadow_share: see lit_observations. 0 keeps all observations.
    """
    lit = lit_observations(observations, shadow_share, valid).to(observations.dtype)
    variance = torch.ones_like(observations)
    for _ in range(iterations):
        scaled_normals, uncertainty = weighted_least_squares(observations, light_directions, lit / variance)
        error = observations - dot(scaled_normals, light_directions)
        variance = (error.square() + uncertainty).clamp(min=SMALLEST_VARIANCE)
    return scaled_normals
