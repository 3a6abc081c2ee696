"""Checks of single facts: the same image twice, lights that crowd, unequal intensities that nothing determines."""

import numpy as np
import pytest

from scenes import cap_directions, halfway, ring_lights, shade, spiral_lights
from splinecli.capture import Capture
from splinecli.diagnosis.checks import check_arrays, light_spread, repeated_images


def test_the_same_image_twice() -> None:
    observations = shade(cap_directions(5000, 60), spiral_lights(10, 50, 12), gloss=0.2, noise=0.004)
    assert repeated_images(observations) == []
    observations[:, 7] = observations[:, 2]
    assert repeated_images(observations) == [(2, 7)]


def test_the_spread_of_lights() -> None:
    # x and y have a mean square of 1/4, z of 1/2.
    assert light_spread(ring_lights(8, 45))[0] == pytest.approx(0.5)
    arc = np.array([(np.sin(a), 0.02 * (-1) ** k, np.cos(a)) for k, a in enumerate(np.linspace(-0.8, 0.8, 8))])
    assert light_spread(arc)[0] == pytest.approx(0.02, abs=1e-3)
    assert not light_spread(arc)[1]
    cone = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), 1) for a in np.linspace(0, 6, 9)])
    spread, in_cone = light_spread(cone)
    assert in_cone and spread < 0.1


def codes(intensities: np.ndarray) -> list[str]:
    """Return the warnings about a plane with faint bumps and broad gloss under 12 lights of these intensities."""
    rng = np.random.default_rng(0)
    lights = spiral_lights(12, 55, 15)
    normals = np.concatenate((rng.normal(0, 0.3, (900, 2)), np.ones((900, 1))), axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shaded = (0.5 * (normals @ lights.T).clip(0) + 0.6 * (normals @ halfway(lights).T).clip(0) ** 12) * intensities
    values = (shaded + rng.normal(0, 0.003, shaded.shape)).clip(0).astype(np.float32)
    capture = Capture("glossy", values, lights, tuple(range(12)), np.ones((30, 30), np.bool_))
    return [warning.code for warning in check_arrays(capture)]


def test_unequal_intensities_that_cannot_be_estimated_are_named() -> None:
    assert "unequal_intensities" in codes(np.tile((0.6, 1.5, 1.0), 4))
    assert "unequal_intensities" not in codes(np.ones(12))
