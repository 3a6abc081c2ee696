"""The sample of pixels that checks see."""

import numpy as np
import pytest

from scenes import directions_at
from splinecli.capture.reader import capture_from_arrays
from splinecli.diagnosis.checks import check_arrays
from splinecli.diagnosis.summary import CLOSEUP_SIDE, Sample, closeup_of, leave_out_background


def ball_before(background: float, size: int = 80) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return images (F, H, W) of a matte ball before a noisy plane of some brightness, lights and its mask."""
    lights = directions_at(np.arange(12) * 2.4, np.arccos(0.8))
    y, x = np.mgrid[2.2 : -2.2 : size * 1j, -2.2 : 2.2 : size * 1j]
    mask = np.hypot(x, y) < 0.97
    normals = np.stack((x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))), axis=2)
    images = np.random.default_rng(0).uniform(0, 2 * background, (12, size, size))
    images[:, mask] = 0.8 * np.maximum(normals[mask] @ lights.T, 0).T
    return images, lights, mask


def test_a_closeup_is_around_the_median_pixel_of_the_mask():
    rng = np.random.default_rng(0)
    for share in (0.001, 0.3, 1.0):
        mask = rng.uniform(size=(700, 900)) < share * np.linspace(0, 1, 900)
        for part, places in zip(closeup_of(mask), np.nonzero(mask), strict=True):
            assert part.stop - part.start == CLOSEUP_SIDE
            assert abs(part.start + CLOSEUP_SIDE // 2 - np.median(places)) <= 1  # of an even number, the lower middle


def test_a_dark_background_is_left_out():
    images, _, mask = ball_before(0.01)
    observations, everything = images.reshape(12, -1).T, np.ones_like(mask)
    sample, share = leave_out_background(Sample(observations, everything, 1))
    # A median filter of 3 x 3 pixels moves the outline by a pixel at most.
    assert np.count_nonzero(sample.mask != mask) < 0.05 * mask.sum()
    assert share == pytest.approx(1 - sample.mask.mean())
    np.testing.assert_array_equal(sample.observations, observations[sample.mask.ravel()])
    for kept in (Sample(observations[mask.ravel()], mask, 1), Sample(observations[:5], everything[:1, :5], 1)):
        assert leave_out_background(kept) == (kept, 0.0)
    bright = Sample(ball_before(0.3)[0].reshape(12, -1).T, everything, 1)
    assert leave_out_background(bright) == (bright, 0.0)


@pytest.mark.parametrize("masked", [True, False])
def test_wrong_lights_are_named_without_a_mask(masked):
    images, lights, mask = ball_before(0.01)
    for signs, expected in (((-1, 1, 1), ["light_frame"]), ((1, 1, 1), [])):
        capture = capture_from_arrays(images, lights * signs, mask if masked else np.ones_like(mask))
        codes = [warning.code for warning in check_arrays(capture, intensities=np.ones(capture.n_lights))]
        assert codes == expected + ([] if masked else ["no_mask"])
