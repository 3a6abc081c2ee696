"""Overexposed Lambertian pixels come back as bright as they were."""

import numpy as np
import pytest

from splinecli.restoration.images import find_saturated, restore_saturated

LIGHTS = np.array([(x, y, 1.4) for x in (-1, 0, 1) for y in (-1, 0, 1)], dtype=float)
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)


def matte(pixels: int) -> np.ndarray:
    """Observations (pixels, 9) of matte surfaces that look to the camera, of every albedo."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(pixels, 3)) * (0.3, 0.3, 0.1) + (0, 0, 1)
    normals *= rng.uniform(0.3, 1, (pixels, 1)) / np.linalg.norm(normals, axis=1, keepdims=True)
    return np.maximum(normals @ LIGHTS.T, 0)


def clipped_at(level: float) -> tuple[np.ndarray, ...]:
    """500 matte pixels: true, which of their observations are saturated, and all as stored and as restored."""
    truth = matte(500)
    stored = np.minimum(truth, level).astype(np.float32)
    restored = stored.copy()
    restore_saturated(restored, truth >= level, LIGHTS)
    return truth, truth >= level, stored, restored


def test_matte_pixels_come_back():
    truth, saturated, stored, restored = clipped_at(0.6)
    np.testing.assert_array_equal(restored[~saturated], stored[~saturated])
    assert (restored >= stored).all()
    known = saturated.any(axis=1) & ((~saturated).sum(axis=1) >= 4)
    assert known.sum() > 50
    # Stored, they are off by up to 0.4; a pixel's four others tell three unknowns.
    np.testing.assert_allclose(restored[known], truth[known], atol=0.015)
    assert np.abs(stored - truth)[known].max() > 0.2


def test_fewer_than_three_others_still_bound_them():
    truth, saturated, stored, restored = clipped_at(0.25)
    few = ((~saturated).sum(axis=1) > 0) & ((~saturated).sum(axis=1) < 3)
    assert few.sum() > 20
    assert np.isfinite(restored).all()
    assert np.abs(restored - truth)[few].mean() < 0.9 * np.abs(stored - truth)[few].mean()


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.array([[255, 3, 3], [254, 254, 254]], np.uint8), [True, False]),
        (np.array([[65_535], [255]], np.uint16), [True, False]),
        (np.array([[1.0], [1e9]], np.float32), [False, False]),
    ],
)
def test_full_scale_is_saturated(pixels, expected):
    assert find_saturated(pixels).tolist() == expected
