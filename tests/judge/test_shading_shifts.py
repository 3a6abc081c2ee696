"""Images of smooth objects that were moved by known amounts: each is found, and no other."""

import numpy as np
import pytest

from scenes import shade, sphere, spiral_lights, square_grid
from splinecli.capture.sample import Sample
from splinecli.judge.shading_shifts import moved_back, shading_shifts

SIDE, N_LIGHTS = 56, 12
LIGHTS = spiral_lights(N_LIGHTS, 60, 15)


def images(
    shape: str, *, gloss: float = 0.0, lights: np.ndarray = LIGHTS
) -> tuple[np.ndarray, np.ndarray]:
    """Images (H, W, F) with black background around a ball, or of a relief that fills the picture;
    and the mask.
    """
    if shape == "ball":
        normals, mask = sphere(SIDE)
    else:
        x, y = square_grid(SIDE)
        slopes = 0.4 * np.cos(4 * x) * np.cos(5 * y), 0.4 * np.sin(4 * x) * np.sin(5 * y)
        normals, mask = np.dstack((*slopes, np.ones_like(x))), np.ones((SIDE, SIDE), np.bool_)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return shade(normals, lights, gloss=gloss, noise=0.003) * mask[..., None], mask


def sample_of(pictures: np.ndarray, mask: np.ndarray) -> Sample:
    return Sample(pictures[mask].astype(np.float32), mask, 1)


def moved(pictures: np.ndarray, shifts: dict[int, tuple[int, int]]) -> np.ndarray:
    pictures = pictures.copy()
    for place, (right, down) in shifts.items():
        padded = np.pad(
            pictures[..., place], 8, mode="edge" if pictures[0, 0, place] > 0.1 else "constant"
        )
        pictures[..., place] = np.roll(padded, (down, right), axis=(0, 1))[8:-8, 8:-8]
    return pictures


@pytest.mark.parametrize("gloss", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("shape", ["ball", "relief"])
@pytest.mark.parametrize("n_lights", [8, 12, 30])
def test_a_fixed_camera(shape: str, gloss: float, n_lights: int) -> None:
    lights = spiral_lights(n_lights, 60, 15)
    assert shading_shifts(sample_of(*images(shape, gloss=gloss, lights=lights)), lights) == {}


@pytest.mark.parametrize("gloss", [0.0, 0.1])
@pytest.mark.parametrize("shift", [(4, 0), (0, -3), (-5, 2)])
def test_one_image_of_a_ball_is_moved(shift: tuple[int, int], gloss: float) -> None:
    pictures, mask = images("ball", gloss=gloss)
    assert shading_shifts(sample_of(moved(pictures, {5: shift}), mask), LIGHTS) == {5: shift}


@pytest.mark.parametrize("half", [range(6, 12), range(1, 12, 2)])
@pytest.mark.parametrize("shape", ["ball", "relief"])
def test_half_of_the_images_are_moved(shape: str, half: range) -> None:
    """Either half may be called the shifted one."""
    pictures, mask = images(shape)
    found = shading_shifts(sample_of(moved(pictures, dict.fromkeys(half, (3, 0))), mask), LIGHTS)
    assert found == dict.fromkeys(half, (3, 0))


def test_rough_lights_are_no_shift() -> None:
    """Lights 4 degrees off shade a ball nearly as a shift of two pixels would."""
    lights = LIGHTS + np.random.default_rng(0).normal(0, np.radians(4), LIGHTS.shape)
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    assert shading_shifts(sample_of(*images("ball")), lights) == {}


def test_what_is_moved_back_is_as_before() -> None:
    pictures, mask = images("ball")
    shifted = sample_of(moved(pictures, {2: (3, -1)}), mask)
    known, values = moved_back(shifted, {2: (3, -1)})
    assert 0.8 * mask.sum() < known.sum() < mask.sum()
    assert values[known] == pytest.approx(pictures[mask][known], abs=1e-6)


def test_too_little_is_not_judged() -> None:
    pictures, mask = images("ball")
    pictures = moved(pictures, {5: (4, 0)})
    assert shading_shifts(sample_of(pictures[..., :7], mask), LIGHTS[:7]) == {}
    small = mask & (np.indices(mask.shape)[0] < 12)
    assert shading_shifts(sample_of(pictures, small), LIGHTS) == {}
    assert shading_shifts(sample_of(np.zeros_like(pictures), mask), LIGHTS) == {}
