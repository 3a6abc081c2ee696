"""Checks of images against each other: the same image twice, images that are not linear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.lights.light_fit import Factors, find_factors

Array = NDArray[np.float64]

SAME_IMAGE = 1e-12
"""One minus the cosine between two images that are the same, up to rounding. Noise gives 1e-6 and more."""

DISPLAY_EXPONENT = 2.2
"""An image of this gamma is close to sRGB."""

DISPLAY_RATIO = 0.75
"""Images count as display-encoded if decoding them leaves less than this share of what the lights cannot explain. For
linear captures, rendered and real ones, the share is 0.99 or more."""


def repeated_images(observations: NDArray[np.floating]) -> list[tuple[int, int]]:
    """Return the pairs of images among observations (P, F) that are equal up to a scale, and not uniform."""
    values = observations.astype(np.float64)
    values = values / np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    varied = np.ptp(values, axis=0) > 0
    same = (1 - values.T @ values < SAME_IMAGE) & varied & varied[:, None]
    return [(int(first), int(second)) for first, second in np.argwhere(np.triu(same, 1))]


def decoding_ratio(
    observations: NDArray[np.floating], factors: Factors | None, light_directions: Array
) -> float | None:
    """Return what the lights cannot explain of the images once they are decoded, as a share of that as they are.

    Returns None where there are too few lit pixels.

    Args:
        observations: (P, F).
        factors: of the observations; see find_factors.
        light_directions: (F, 3).
    """
    if factors is None:
        return None
    decoded = np.maximum(observations, 0).astype(np.float64) ** DISPLAY_EXPONENT
    after = find_factors(decoded, intensities_known=factors.intensities_known)
    if after is None:
        return None
    left, before = (np.hypot(k.misfits(light_directions[None])[0], k.residual) for k in (after, factors))
    return float(left / max(before, 1e-3))
