"""A check of images against each other: the same image twice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAME_IMAGE = 1e-12
"""One minus the cosine between two images that are the same, up to rounding. Noise gives 1e-6 and more."""


def repeated_images(observations: NDArray[np.floating]) -> list[tuple[int, int]]:
    """Return the pairs of images among observations (P, F) that are equal up to a scale, and not uniform."""
    values = observations.astype(np.float64)
    values = values / np.maximum(np.linalg.norm(values, axis=0), 1e-300)
    varied = np.ptp(values, axis=0) > 0
    same = (1 - values.T @ values < SAME_IMAGE) & varied & varied[:, None]
    return [(int(first), int(second)) for first, second in np.argwhere(np.triu(same, 1))]
