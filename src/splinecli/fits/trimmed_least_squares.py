"""Trimmed LS: least squares without shadows and without the darkest and brightest observations."""

from torch import Tensor

from splinecli.fits.shadows import lit_observations
from splinecli.fits.weighted_least_squares import weighted_least_squares

TRIMMED_SHARE = 0.2
"""Share of the observations that is left out at each end: with ten lights, the two darkest and the two brightest."""

SHADOW_SHARE = 0.1  # Share of the pixel's quantile UNSHADED, as in IW12. Darker observations are shadows.
FEWEST = 4  # smallest number of observations that stay: one more than a normal and an albedo need


def solve(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Return scaled normals b (P, 3) that minimise |I - L b| over the remaining observations.

    Equal observations are kept or left out together, so the order of the lights does not matter.
    """
    count = observations.shape[1]
    trimmed = max(0, min(int(TRIMMED_SHARE * count), (count - FEWEST) // 2))
    ordered = observations.sort(dim=1).values
    darkest, brightest = ordered[:, trimmed, None], ordered[:, count - 1 - trimmed, None]
    middling = (observations >= darkest) & (observations <= brightest)
    weight = lit_observations(observations, SHADOW_SHARE, middling)
    scaled_normals, _ = weighted_least_squares(observations, light_directions, weight.to(observations.dtype))
    return scaled_normals
