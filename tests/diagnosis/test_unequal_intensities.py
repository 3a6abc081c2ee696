"""Unequal light intensities that the images do not determine."""

import numpy as np

from scenes import halfway, spiral_lights
from splinecli.capture import Capture
from splinecli.diagnosis.checks import check_arrays


def codes(intensities: np.ndarray) -> list[str]:
    """Return the warnings about a plane with faint bumps and broad gloss under 12 lights of these intensities."""
    rng = np.random.default_rng(0)
    lights = spiral_lights(12, 55, 15)
    normals = np.concatenate((rng.normal(0, 0.3, (900, 2)), np.ones((900, 1))), axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shaded = (0.5 * (normals @ lights.T).clip(0) + 0.6 * (normals @ halfway(lights).T).clip(0) ** 12) * intensities
    values = (shaded + rng.normal(0, 0.003, shaded.shape)).clip(0).astype(np.float32)
    capture = Capture("glossy", values, lights, tuple(range(12)), np.ones((30, 30), np.bool_))
    return [warning.code for warning in check_arrays(capture, intensities_measured=False)]


def test_unequal_intensities_that_cannot_be_estimated_are_named() -> None:
    assert "unequal_intensities" in codes(np.tile((0.6, 1.5, 1.0), 4))
    assert "unequal_intensities" not in codes(np.ones(12))
