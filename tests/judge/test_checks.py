"""The sample that checks see, and checks of single facts: equal images, crowded lights, unequal
intensities.
"""

import numpy as np
from pytest import approx

from judged import warnings_of
from scenes import (
    cap_directions,
    directions_at,
    on_sphere,
    parametrize,
    ring_lights,
    shade,
    spiral_lights,
)
from splinecli.capture.arrays import open_arrays
from splinecli.capture.sample import CLOSEUP_SIDE, Sample, closeup_of, leave_out_background
from splinecli.judge.checks import light_spread, repeated_images
from splinecli.recipe import prepare_capture


def test_the_same_image_twice():
    observations = shade(
        cap_directions(5000, 60), spiral_lights(10, 50, 12), gloss=0.2, noise=0.004
    )
    assert repeated_images(observations) == []
    observations[:, [5, 7]] = observations[:, [2]]
    assert repeated_images(observations) == [(2, 5), (2, 7)]


def test_the_spread_of_lights():
    # x and y have a mean square of 1/4, z of 1/2.
    assert light_spread(ring_lights(8, 45))[0] == approx(0.5)
    arc = np.array(
        [(np.sin(a), 0.02 * (-1) ** k, np.cos(a)) for k, a in enumerate(np.linspace(-0.8, 0.8, 8))]
    )
    assert light_spread(arc)[0] == approx(0.02, abs=1e-3)
    assert not light_spread(arc)[1]
    cone = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), 1) for a in np.linspace(0, 6, 9)])
    spread, in_cone = light_spread(cone)
    assert in_cone and spread < 0.1


def ball_before(background, size=80):
    """Return images (F, H, W) of a matte ball before a noisy plane of some brightness, lights and
    its mask.
    """
    lights = directions_at(np.arange(12) * 2.4, np.arccos(0.8))
    y, x = np.mgrid[2.2 : -2.2 : size * 1j, -2.2 : 2.2 : size * 1j]
    mask = np.hypot(x, y) < 0.97
    normals = on_sphere(x, y)
    images = np.random.default_rng(0).uniform(0, 2 * background, (12, size, size))
    images[:, mask] = 0.8 * np.maximum(normals[mask] @ lights.T, 0).T
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
