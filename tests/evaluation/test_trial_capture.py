"""What a trial scores: pixels with ground truth, or a part of them, under lights with noise of the
stated size.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scenes import assert_unit, vectors
from splinecli.capture import Capture
from splinecli.evaluation.trials import scored_rows, tilt_lights
from splinecli.maths.normals import angle_between_deg, unit

LIGHTS = vectors("0 0 1; 0.6 0 0.8; 0 0.6 0.8")
MASK = np.random.default_rng(5).random((9, 7)) < 0.7


@pytest.fixture
def capture():
    """Observation 0 of a pixel is its flat index in the image; columns 3 and 4 have no ground
    truth.
    """
    index = np.flatnonzero(MASK)
    truth = np.zeros((9, 7, 3), np.float32)
    truth[..., 2] = 1
    truth[:, 3:5] = 0
    return Capture("c", np.stack([index] * 3, axis=1), LIGHTS, (4, 7, 9), MASK, truth)


def test_pixels_without_ground_truth_go(capture):
    wanted = MASK.copy()
    wanted[:, 3:5] = False
    rows = scored_rows(capture)
    assert_array_equal(capture.observations[rows, 0], np.flatnonzero(wanted))
    kept = capture.choose_pixels(rows)
    assert_array_equal(kept.mask, wanted)
    assert_array_equal(kept.observations[:, 0], np.flatnonzero(wanted))
    assert kept.light_indices == (4, 7, 9)


def test_a_part_of_the_pixels(capture):
    parts = [scored_rows(capture, max_pixels=10, seed=seed) for seed in (0, 0, 1)]
    for part in parts:
        assert len(part) == 10
        assert (np.diff(part) > 0).all()
        assert set(part) <= set(scored_rows(capture))
    assert_array_equal(parts[0], parts[1])
    assert (parts[0] != parts[2]).any()


def test_angles_have_the_wanted_root_mean_square(rng):
    lights = np.tile(unit(np.array([[0.3, -0.4, 1.0]])), (20_000, 1))
    tilted = tilt_lights(lights, 4.0, rng)
    angles = angle_between_deg(tilted, lights)
    # The standard error of the root mean square of n Gaussians is sigma / sqrt(2 n) = 0.02.
    assert np.sqrt((angles**2).mean()) == pytest.approx(4.0, abs=0.08)
    # No direction is preferred: the mean is the light, shortened by the mean cosine.
    assert angle_between_deg(unit(tilted.mean(axis=0)), lights[0]) < 0.15
    assert_unit(tilted)


def test_lights_stay_above_the_horizon(rng):
    azimuth = np.linspace(0, 2 * np.pi, 5000)
    lights = unit(np.stack([np.cos(azimuth), np.sin(azimuth), np.full(5000, 0.001)], axis=1))
    assert (tilt_lights(lights, 30.0, rng)[:, 2] > 0).all()
