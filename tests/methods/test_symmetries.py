"""What must not change a method's answer: the order of the lights, the scale of the images, the size of batches."""

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import Estimator, MethodOptions, make_estimator, method_names

Pixels = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


SEE_CAPTURE = ("spline-net", "spline-net-pixelwise")
"""Methods that compare the brightness of pixels."""


def make(name: str, batch_size: int | None = None) -> Estimator:
    return make_estimator(name, MethodOptions(device="cpu", precision="float32", batch_size=batch_size))


def largest_difference_deg(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(angle_between_deg(a, b).max())


@pytest.mark.parametrize("name", method_names())
@pytest.mark.parametrize("change", ["order of lights", "darker", "brighter", "batches", "turn"])
def test_what_changes_nothing(name: str, change: str, glossy_pixels: Pixels) -> None:
    """But for CNN-PS, normals turn with the lights. That is only symmetric as far as its ten rotations go."""
    _, lights, observations = glossy_pixels
    order, turn = np.arange(len(lights)), np.eye(3)
    if change == "order of lights":
        order = np.random.default_rng(0).permutation(len(lights))
    elif change == "turn" and name != "cnn-ps":
        turn = _about_view_axis(0.7)
    factors = np.full((len(observations), 1), {"darker": 1e-3, "brighter": 1000.0}.get(change, 1.0))
    if name not in SEE_CAPTURE:
        # A factor for each pixel: albedo is unknown, so it may not matter either.
        factors *= np.linspace(0.5, 2, len(observations))[:, None]
    before = make(name).estimate(observations.astype(np.float32), lights)
    changed = (observations * factors)[:, order].astype(np.float32)
    after = make(name, 7 if change == "batches" else None).estimate(changed, lights[order] @ turn)
    assert largest_difference_deg(before @ turn, after) < 0.05


@pytest.mark.parametrize("name", method_names())
@pytest.mark.parametrize("n_lights", [3, 4, 14])
def test_odd_pixels_still_get_a_normal(name: str, n_lights: int, glossy_pixels: Pixels) -> None:
    _, lights, observations = glossy_pixels
    odd = observations[:6, :n_lights].astype(np.float32)
    odd[0] = 0
    odd[1] = 1
    odd[2, 1:] = 0
    odd[3] = np.where(np.arange(n_lights) < 2, odd[3] + 1, 0)
    odd[4] *= -1  # a dark frame may have been subtracted
    found = make(name).estimate(odd, lights[:n_lights])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    np.testing.assert_array_equal(found[0], (0, 0, 1))


@pytest.mark.parametrize("name", method_names())
def test_a_pixel_may_have_lights_of_its_own(name: str, glossy_pixels: Pixels) -> None:
    """Two pixels at a time, with shared lights, are the oracle for all pixels at once, with lights of their own.

    Both see the same capture, if they see one at all.
    """
    _, lights, observations = glossy_pixels
    some = observations[:6].astype(np.float32)
    turned = np.stack([lights @ _about_view_axis(angle) for angle in (0.0, 0.0, 0.4, 0.4, -1.1, -1.1)])
    method = make(name).bind(lambda rows: PixelLighting(some[rows], turned[rows]), len(some))
    together = method.estimate(some, turned)
    pairs = [method.estimate(some[first : first + 2], turned[first]) for first in (0, 2, 4)]
    assert largest_difference_deg(together, np.concatenate(pairs)) < 0.05
    # The lights matter: without their own, the pixels get other normals.
    assert largest_difference_deg(together[2:], method.estimate(some, lights)[2:]) > 1


def _about_view_axis(angle: float) -> NDArray[np.float64]:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
