"""Images that were moved by known amounts: each is found, and no other."""

import cv2
import numpy as np
from numpy.random import default_rng

from scenes import parametrize, ring_lights, tilted
from splinecli.images.registration import shifts_of_detail

SIDE, N_LIGHTS = 90, 10
LIGHTS = ring_lights(N_LIGHTS, np.degrees(np.arccos(0.8)))
GAINS = default_rng(4).uniform(0.5, 2, N_LIGHTS)


def images(*, texture, seed=0):
    """Images (H, W, F) of a matte dome with bumps and a painted pattern, under lights on a ring,
    with noise.
    """
    rng = default_rng(seed)
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    normals = tilted(0.6 * x + 0.2 * np.sin(17 * y), 0.6 * y + 0.2 * np.cos(13 * x))
    albedo = 0.6 + texture * rng.uniform(-1, 1, (SIDE, SIDE))
    shaded = albedo[..., None] * (normals @ LIGHTS.T).clip(0)
    return shaded * (1 + 0.01 * rng.normal(size=shaded.shape)) * GAINS


def disc(radius=0.85):
    """A mask away from the edges, where no picture lacks pixels."""
    y, x = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    return np.hypot(x, y) < radius


def shifts_of(pictures, mask=None, lights=LIGHTS * GAINS[:, None]):
    return shifts_of_detail(np.moveaxis(pictures, 2, 0), disc() if mask is None else mask, lights)


@parametrize("texture", [0.02, 0.3])
def test_a_fixed_camera(texture):
    assert shifts_of(images(texture=texture)) == {}


@parametrize(("right", "down"), [(1, 0), (0, -1), (-2, 1), (3, 4), (-5, 0)])
def test_one_image_is_moved(right, down):
    pictures = images(texture=0.1)
    pictures[..., 3] = np.roll(pictures[..., 3], (down, right), axis=(0, 1))
    assert shifts_of(pictures) == {3: (right, down)}


def test_highlights_that_move_are_no_shift():
    """A polished relief without paint: highlights lie elsewhere under each light."""
    relief = default_rng(2).normal(size=(SIDE, SIDE, 2))
    y, x = np.mgrid[1 : -1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    across, up = np.moveaxis(cv2.GaussianBlur(relief, (0, 0), 3), 2, 0)
    normals = tilted(0.5 * x + across, 0.5 * y + up)
    halfway = ring_lights(N_LIGHTS, np.degrees(np.arctan2(0.3, 0.95)))
    assert shifts_of((normals @ halfway.T).clip(0) ** 60, lights=halfway) == {}


def test_what_cannot_be_told_is_not_told():
    """Too few images, too small an object, and images without any detail."""
    pictures = images(texture=0.1)
    pictures[..., 3] = np.roll(pictures[..., 3], 3, axis=0)
    assert shifts_of(pictures[..., :9], lights=LIGHTS[:9]) == {}
    small = disc()
    small[:, 50:] = False
    small[:20] = False
    assert shifts_of(pictures, small) == {}
    assert shifts_of(np.zeros_like(pictures)) == {}
