"""Lights of matte surfaces of known shape, up to the choice of bump or hollow."""

import numpy as np
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from scenes import bumps, cap_directions, parametrize, shade, sphere
from splinecli.estimate.light_descent import best_lights
from splinecli.lights.least_curl import (
    Lights,
    differ_by_deg,
    lights_of_least_curl,
)
from splinecli.maths.normals import unit

SIZE = 64


@parametrize("spread", [0.0, 0.1])
def test_a_relief_shows_its_lights_whatever_the_guess(spread):
    """A guess that is 40 degrees off does not matter, but lamps that differ by a tenth do."""
    normals, mask = bumps(SIZE).reshape(-1, 3), np.ones((SIZE, SIZE), np.bool_)
    rng = default_rng(2)
    true = cap_directions(12, 50, 3, even=True)
    intensities = np.exp(spread * rng.normal(size=12))
    intensities /= intensities.mean()
    albedo = np.where(np.arange(len(normals)) % 96 < 40, 0.3, 0.8)[:, None]
    images = albedo * (normals @ true.T).clip(0) * intensities
    images += 0.002 * rng.normal(size=images.shape)
    guess = Lights(Rotation.from_euler("xz", (25, 35), degrees=True).apply(true), np.ones(12))
    found = lights_of_least_curl(
        images.clip(0), mask, guess, np.full(12, 25.0), intensities_known=not spread
    )
    assert differ_by_deg(found[0].directions, true) < (4 if not spread else 8)
    if spread:
        away = np.abs(found[0].intensities / intensities - 1).mean()
        assert away < 0.7 * np.abs(intensities - 1).mean()


def test_pixels_that_are_dark_show_nothing():
    mask = np.ones((6, 6), np.bool_)
    guess = Lights(cap_directions(8, 50, 3), np.ones(8))
    values = np.ones((36, 8))
    assert not lights_of_least_curl(values, mask, guess, np.full(8, 9.0), intensities_known=True)


def test_the_network_expects_smaller_errors_under_lights_nearer_to_the_true_ones():
    """A glossy ball, and lights with errors of their own and one in common."""
    normals, mask = sphere(SIZE)
    true = cap_directions(10, 50, 4, even=True)
    images = shade(normals[mask], true, gloss=0.4, exponent=60)
    rng = default_rng(1)
    start = unit(true @ Rotation.from_euler("x", 8, degrees=True).as_matrix().T)
    start = unit(start + 0.06 * rng.normal(size=start.shape))
    far = np.roll(true, 3, axis=0)  # in a wrong order
    starts = [Lights(far, np.ones(10)), Lights(start, np.ones(10))]
    errors = np.full(10, 9.0)
    found = best_lights(images, mask, starts, start, errors, errors, intensities_known=True)
    assert found.start == 1
    assert differ_by_deg(found.lights.directions, true) < 0.75 * differ_by_deg(start, true)
