"""From a capture to a normal map, mostly with least squares, whose result is known."""

import numpy as np
from numpy.testing import assert_allclose

from scenes import FOUR_LIGHTS, as_capture, parametrize
from splinecli.estimate.inference import estimate_normals, estimate_pixels
from splinecli.estimate.methods.estimator import TILE_PIXELS, LeastSquares
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import unit


def bowl(height=13, width=11):
    """Normals (H, W, 3) that all lights reach, and a mask with holes."""
    y, x = np.mgrid[1 : -1 : height * 1j, -1 : 1 : width * 1j]
    normals = np.stack((0.2 * x, 0.2 * y, np.ones_like(x)), axis=-1)
    mask = x**2 + y**2 < 1
    mask[height // 2, width // 2] = False
    return unit(normals), mask


def capture(ground_truth=None):
    normals, mask = bowl()
    values = 0.7 * normals[mask] @ FOUR_LIGHTS.T
    return as_capture(values, FOUR_LIGHTS, mask, ground_truth=ground_truth)


def test_normals_stand_where_their_pixels_are():
    normals, mask = bowl()
    estimate = estimate_normals(capture(), LeastSquares())
    assert estimate.normal_map.dtype == np.float32
    # The observations were rounded to float32.
    assert_allclose(estimate.normal_map[mask], normals[mask], atol=1e-6)
    assert not estimate.normal_map[~mask].any()
    assert estimate.error_map_deg is None
    assert estimate.errors is None


@parametrize("tile_pixels", [1, 7, 10_000])
def test_tiles_change_nothing_but_the_progress(tile_pixels):
    whole = estimate_normals(capture(), LeastSquares())
    done = []
    estimator = LeastSquares()
    estimator.tile_pixels = tile_pixels
    tiled = estimate_normals(capture(), estimator, progress=done.append)
    # Matrix products of other heights may add up in another order.
    assert_allclose(tiled.normal_map, whole.normal_map, atol=1e-6)
    n_pixels = capture().n_pixels
    assert sum(done) == n_pixels
    assert len(done) == -(-n_pixels // tile_pixels)
    assert max(done) <= tile_pixels


@parametrize(
    "near, n_lights, most", [(False, 10, 1 << 19), (True, 10, 1 << 18), (True, 40, 1 << 16)]
)
def test_an_estimator_gets_fewer_pixels_at_once_if_each_has_many_numbers(near, n_lights, most):
    """Under near lamps, every pixel has its own directions, which would take gigabytes."""
    asked = []

    class Counting(LeastSquares):
        tile_pixels = 1 << 20

        def estimate(self, observations, light_directions, **options):
            asked.append(len(observations))
            return np.tile(np.float32((0, 0, 1)), (len(observations), 1))

    mask = np.ones((1, 400_000), np.bool_)
    directions = np.broadcast_to(np.float32((0, 0, 1)), (mask.size, n_lights, 3))

    def lighting(_, pixels):
        return PixelLighting(observations[pixels], directions[pixels] if near else directions[0])

    observations = np.ones((mask.size, n_lights), np.float32)
    estimate_pixels(mask, observations, lighting, Counting())
    assert TILE_PIXELS <= max(asked) <= most
    assert sum(asked) == mask.size
