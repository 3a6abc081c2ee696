"""A report and a sphere for the tests of the page of results."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SIDE = 256  # pixels, of the sphere
REPORT: dict[str, Any] = {
    "capture": "ball",
    "method": "spline-net",
    "weights": {"name": "blobby-7", "sha256": "0123456789ab" * 5},
    "n_lights": 10,
    "light_indices": list(range(10)),
    "n_pixels": 45200,
    "image_size": [296, 321],
    "device": "cpu",
    "precision": "float32",
    "seconds": {"read": 0.6, "estimate": 0.008},
    "peak_memory_mib": 86,
    "warnings": [],
    "expected_under_5": 0.8123,
    "angular_error_deg": {"mean": 9.063, "median": 6.24, "p90": 18.1, "under_5": 0.3725, "under_10": 0.75},
    "version": "0.1.0",
}


def sphere(side: int = SIDE) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Normals (side, side, 3) and mask of a sphere that nearly fills the picture."""
    steps = (np.arange(side) + 0.5 - side / 2) / (0.47 * side)
    x, y = np.meshgrid(steps, -steps)
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    return (np.stack((x, y, z), axis=2) * mask[..., None]).astype(np.float32), mask
