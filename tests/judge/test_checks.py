"""The sample that checks use, of captures with and without a mask."""

import numpy as np
from pytest import approx

from judged import warnings_of
from scenes import ball, parametrize, shade, spiral_lights
from splinecli.capture.arrays import open_arrays
from splinecli.capture.sample import CLOSEUP_SIDE, Sample, closeup_of, leave_out_background
from splinecli.recipe import prepare_capture


def ball_before(background, size=80):
    """Return images (F, H, W) of a matte ball before a noisy plane of some brightness, lights and
    its mask.
    """
    lights = spiral_lights(12, 45, 30)
    normals, mask = ball((size, size), (size - 1) / 2, (size - 1) / 2, size / 4.5)
    images = np.random.default_rng(0).uniform(0, 2 * background, (12, size, size))
    images[:, mask] = 0.8 * shade(normals[mask], lights).T
    return images, lights, mask


def test_a_closeup_is_around_the_median_pixel_of_the_mask(rng):
    for share in (0.001, 0.3, 1.0):
        mask = rng.uniform(size=(700, 900)) < share * np.linspace(0, 1, 900)
        for part, places in zip(closeup_of(mask), np.nonzero(mask), strict=True):
            assert part.stop - part.start == CLOSEUP_SIDE
            # of an even number, the lower middle
            assert abs(part.start + CLOSEUP_SIDE // 2 - np.median(places)) <= 1


def test_a_dark_background_is_left_out():
    images, _, mask = ball_before(0.01)
    observations, everything = images.reshape(12, -1).T, np.ones_like(mask)
    sample, share = leave_out_background(Sample(observations, everything, 1))
    # A median filter of 3 x 3 pixels moves the outline by a pixel at most.
    assert np.count_nonzero(sample.mask != mask) < 0.05 * mask.sum()
    assert share == approx(1 - sample.mask.mean())
    np.testing.assert_array_equal(sample.observations, observations[sample.mask.ravel()])
    for kept in (
        Sample(observations[mask.ravel()], mask, 1),
        Sample(observations[:5], everything[:1, :5], 1),
    ):
        assert leave_out_background(kept) == (kept, 0.0)
    bright = Sample(ball_before(0.3)[0].reshape(12, -1).T, everything, 1)
    assert leave_out_background(bright) == (bright, 0.0)


@parametrize("masked", [True, False])
def test_wrong_lights_are_named_without_a_mask(masked):
    images, lights, mask = ball_before(0.01)
    for signs, expected in (((-1, 1, 1), ["light_frame"]), ((1, 1, 1), [])):
        capture = prepare_capture(
            open_arrays(images, lights * signs, mask if masked else np.ones_like(mask))
        )
        codes = [
            warning.code for warning in warnings_of(capture, intensities=np.ones(capture.n_lights))
        ]
        assert sorted(codes) == expected + ([] if masked else ["no_mask"])
