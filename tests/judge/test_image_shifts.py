"""Images that were moved by known amounts: each is found, and no other."""

import cv2
import numpy as np
from numpy.random import default_rng

from scenes import parametrize, ring_lights, tilted
from splinecli.capture.sample import Sample
from splinecli.judge.odd_images import ImageShift, find_shifts

SIDE, N_LIGHTS = 90, 10


def images(*, texture, seed=0):
    """Images (H, W, F) of a matte dome with bumps and a painted pattern, under lights on a ring,
    with noise.
    """
    rng = default_rng(seed)
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    normals = tilted(0.6 * x + 0.2 * np.sin(17 * y), 0.6 * y + 0.2 * np.cos(13 * x))
    albedo = 0.6 + texture * rng.uniform(-1, 1, (SIDE, SIDE))
    shaded = albedo[..., None] * (
        normals @ ring_lights(N_LIGHTS, np.degrees(np.arccos(0.8))).T
    ).clip(0)
    return shaded * (1 + 0.01 * rng.normal(size=shaded.shape)) * rng.uniform(0.5, 2, N_LIGHTS)


def sample_of(pictures, *, step=1):
    """A sample whose mask is a disc away from the edges, where no picture lacks pixels."""
    y, x = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    mask = np.hypot(x, y) < 0.85
    return Sample(np.float32(pictures[mask]), mask, step)


@parametrize("texture", [0.02, 0.3])
def test_a_fixed_camera(texture):
    assert find_shifts(sample_of(images(texture=texture))) == []


@parametrize(("right", "down"), [(1, 0), (0, -1), (-2, 1), (3, 4), (-5, 0)])
def test_one_image_is_moved(right, down):
    pictures = images(texture=0.1)
    pictures[..., 3] = np.roll(pictures[..., 3], (down, right), axis=(0, 1))
    assert find_shifts(sample_of(pictures)) == [ImageShift(3, right, down)]
    assert find_shifts(sample_of(pictures, step=4)) == [ImageShift(3, 4 * right, 4 * down)]


def test_highlights_that_move_are_no_shift():
    """A polished relief without paint: highlights lie elsewhere under each light."""
    relief = default_rng(2).normal(size=(SIDE, SIDE, 2))
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    across, up = np.moveaxis(cv2.GaussianBlur(relief, (0, 0), 3), 2, 0)
    normals = tilted(0.5 * x + across, 0.5 * y + up)
    halfway = ring_lights(N_LIGHTS, np.degrees(np.arctan2(0.3, 0.95)))
    assert find_shifts(sample_of((normals @ halfway.T).clip(0) ** 60)) == []


def test_what_cannot_be_told_is_not_told():
    """Too few images, too small an object, and images without any detail."""
    pictures = images(texture=0.1)
    pictures[..., 3] = np.roll(pictures[..., 3], 3, axis=0)
    assert find_shifts(sample_of(pictures[..., :9])) == []
    whole = sample_of(pictures)
    small = whole.mask.copy()
    small[:, 50:] = False
    small[:20] = False
    assert find_shifts(Sample(whole.observations[small[whole.mask]], small, 1)) == []
    assert find_shifts(Sample(np.zeros_like(whole.observations), whole.mask, 1)) == []
