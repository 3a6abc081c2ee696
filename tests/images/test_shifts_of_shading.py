"""Images of smooth objects that were moved by known amounts: each is found, and no other."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import parametrize, shade, sphere, spiral_lights, square_grid, tilted
from splinecli.capture.sample import Sample
from splinecli.images.registration import shifts_of_shading
from splinecli.judge.evidence import Evidence, ImageShift
from splinecli.maths.normals import unit

SIDE, N_LIGHTS = 56, 12
LIGHTS = spiral_lights(N_LIGHTS, 60, 15)


def images(shape, *, gloss=0.0, lights=LIGHTS):
    """Images (H, W, F) with black background around a ball, or of a relief that fills the picture;
    and the mask.
    """
    if shape == "ball":
        normals, mask = sphere(SIDE)
    else:
        x, y = square_grid(SIDE)
        slopes = 0.4 * np.cos(4 * x) * np.cos(5 * y), 0.4 * np.sin(4 * x) * np.sin(5 * y)
        normals, mask = tilted(*slopes), np.ones((SIDE, SIDE), np.bool_)
    return shade(normals, lights, gloss=gloss, noise=0.003) * mask[..., None], mask


def sample_of(pictures, mask):
    return Sample(np.float32(pictures[mask]), mask, 1)


def shading_shifts(sample, lights):
    return shifts_of_shading(sample.images, sample.mask, lights)


def moved(pictures, shifts):
    pictures = pictures.copy()
    for place, (right, down) in shifts.items():
        padded = np.pad(
            pictures[..., place], 8, mode="edge" if pictures[0, 0, place] > 0.1 else "constant"
        )
        pictures[..., place] = np.roll(padded, (down, right), axis=(0, 1))[8:-8, 8:-8]
    return pictures


@parametrize("gloss", [0.0, 0.2, 0.5])
@parametrize("shape", "ball relief")
@parametrize("n_lights", [8, 12, 30])
def test_a_fixed_camera(shape, gloss, n_lights):
    lights = spiral_lights(n_lights, 60, 15)
    assert shading_shifts(sample_of(*images(shape, gloss=gloss, lights=lights)), lights) == {}


@parametrize("gloss", [0.0, 0.1])
@parametrize("shift", [(4, 0), (0, -3), (-5, 2)])
def test_one_image_of_a_ball_is_moved(shift, gloss):
    pictures, mask = images("ball", gloss=gloss)
    assert shading_shifts(sample_of(moved(pictures, {5: shift}), mask), LIGHTS) == {5: shift}


@parametrize("half", [range(6, 12), range(1, 12, 2)])
@parametrize("shape", "ball relief")
def test_half_of_the_images_are_moved(shape, half):
    """Either half may be called the shifted one."""
    pictures, mask = images(shape)
    found = shading_shifts(sample_of(moved(pictures, dict.fromkeys(half, (3, 0))), mask), LIGHTS)
    assert found == dict.fromkeys(half, (3, 0))


def test_rough_lights_are_no_shift(rng):
    """Lights 4 degrees off shade a ball nearly as a shift of two pixels would."""
    lights = LIGHTS + rng.normal(0, np.radians(4), LIGHTS.shape)
    lights = unit(lights)
    assert shading_shifts(sample_of(*images("ball")), lights) == {}


def test_what_is_moved_back_is_as_before():
    pictures, mask = images("ball")
    sample = sample_of(moved(pictures, {2: (3, -1)}), mask)
    names = [str(number) for number in range(N_LIGHTS)]
    seen = Evidence(names, LIGHTS, range(N_LIGHTS), sample, sample, True)
    assert seen.shifts == [ImageShift(2, 3, -1)]
    back = seen.moved_back(seen.shifts).sample
    assert 0.8 * mask.sum() < back.mask.sum() < mask.sum()
    assert back.observations == pytest.approx(pictures[back.mask], abs=1e-6)
    assert replace(seen, sample=replace(sample, step=4)).shifts == [ImageShift(2, 12, -4)]


def test_too_little_is_not_judged():
    pictures, mask = images("ball")
    pictures = moved(pictures, {5: (4, 0)})
    assert shading_shifts(sample_of(pictures[..., :7], mask), LIGHTS[:7]) == {}
    small = mask & (np.indices(mask.shape)[0] < 12)
    assert shading_shifts(sample_of(pictures, small), LIGHTS) == {}
    assert shading_shifts(sample_of(np.zeros_like(pictures), mask), LIGHTS) == {}
