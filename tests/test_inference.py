"""From a capture to a normal map, mostly with least squares, whose result is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.inference import estimate_normals
from splinecli.methods.estimator import LeastSquares

LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.48, -0.36, 0.8]])


def bowl(height: int = 13, width: int = 11) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Normals (H, W, 3) that all lights reach, and a mask with holes."""
    y, x = np.mgrid[1 : -1 : height * 1j, -1 : 1 : width * 1j]
    normals = np.stack((0.2 * x, 0.2 * y, np.ones_like(x)), axis=-1)
    mask = x**2 + y**2 < 1
    mask[height // 2, width // 2] = False
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True), mask


def capture(ground_truth: NDArray[np.float64] | None = None) -> Capture:
    normals, mask = bowl()
    return Capture("bowl", 0.7 * normals[mask] @ LIGHTS.T, LIGHTS, (0, 1, 2, 3), mask, ground_truth)


def test_normals_stand_where_their_pixels_are() -> None:
    normals, mask = bowl()
    estimate = estimate_normals(capture(), LeastSquares())
    assert estimate.normal_map.dtype == np.float32
    # The observations were rounded to float32.
    np.testing.assert_allclose(estimate.normal_map[mask], normals[mask], atol=1e-6)
    assert not estimate.normal_map[~mask].any()
    assert estimate.error_map_deg is None
    assert estimate.errors is None


@pytest.mark.parametrize("tile_pixels", [1, 7, 10_000])
def test_tiles_change_nothing_but_the_progress(tile_pixels: int) -> None:
    whole = estimate_normals(capture(), LeastSquares())
    done: list[int] = []
    estimator = LeastSquares()
    estimator.tile_pixels = tile_pixels
    tiled = estimate_normals(capture(), estimator, progress=done.append)
    # Matrix products of other heights may add up in another order.
    np.testing.assert_allclose(tiled.normal_map, whole.normal_map, atol=1e-6)
    n_pixels = capture().n_pixels
    assert sum(done) == n_pixels
    assert len(done) == -(-n_pixels // tile_pixels)
    assert max(done) <= tile_pixels
