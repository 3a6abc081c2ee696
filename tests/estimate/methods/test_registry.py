"""Methods by name, and what must not change their answers: order of lights, scale of images, size
of batches.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from scenes import FOUR_LIGHTS, assert_unit, parametrize, refuses, vectors
from splinecli.errors import ModelError, UsageError
from splinecli.estimate.methods import MethodOptions, make_estimator, method_names
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import angle_between_deg
from splinecli.workshop.save_weights import save_weights
from tiny_networks import TINY


def save_tiny(path, **settings):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_weights(SplineNet(NetworkConfig(**TINY, **settings)), path)
    return str(path)


@pytest.fixture
def weights(tmp_path):
    return save_tiny(tmp_path / "tiny.safetensors")


def test_every_method_says_what_it_is_and_estimates(weights, tmp_path):
    truth = vectors("0 0 1; 0.28 0 0.96; 0 -0.28 0.96")
    observations = np.float32(truth @ FOUR_LIGHTS.T * 0.5)
    alone = save_tiny(tmp_path / "alone.safetensors", interpolates=False)
    fingerprints = set()
    for name in method_names():
        file = alone if name == "cnn-ps" else weights
        estimator = make_estimator(
            name, MethodOptions(weights=file, device="cpu", precision="float32")
        )
        assert estimator.name == name
        assert estimator.device == "cpu"
        fingerprints.add(estimator.fingerprint)
        # A matte pixel without shadow is easy for all of them; the network starts from the
        # Lambertian fit.
        normals = estimator.estimate(observations, FOUR_LIGHTS)
        assert normals.shape == (3, 3)
        assert_unit(normals)
        assert_allclose(normals, truth, atol=0.01)
    assert len(fingerprints) == len(method_names())


def test_what_decides_the_normals_is_in_the_fingerprint(weights):
    options = MethodOptions(weights=weights, device="cpu", precision="float32")
    others = (replace(options, rotations=3), replace(options, precision="bfloat16"))
    fingerprints = {make_estimator("spline-net", o).fingerprint for o in (options, *others)}
    assert len(fingerprints) == 3
    same = make_estimator("spline-net", replace(options, batch_size=3))
    assert same.fingerprint in fingerprints


def test_weights_of_the_other_network(weights, tmp_path):
    alone = save_tiny(tmp_path / "alone.safetensors", interpolates=False)
    for method, file, message in (
        (
            "cnn-ps",
            weights,
            "'tiny' are for SPLINE-Net, so the method cnn-ps .* Use them with --method spline-net",
        ),
        (
            "spline-net",
            alone,
            "'alone' are for CNN-PS, so the method spline-net .* Use them with --method cnn-ps",
        ),
    ):
        with refuses(message, ModelError):
            make_estimator(method, MethodOptions(weights=file))


@parametrize("options", [MethodOptions(rotations=0), MethodOptions(batch_size=0)])
def test_counts_from_one(options, weights):
    with refuses("whole numbers of at least 1", UsageError):
        make_estimator("spline-net", replace(options, weights=weights))


SEE_CAPTURE = ("spline-net", "spline-net-pixelwise")
"""Methods that compare the brightness of pixels."""


def make(name, batch_size=None):
    return make_estimator(
        name, MethodOptions(device="cpu", precision="float32", batch_size=batch_size)
    )


def largest_difference_deg(a, b):
    return float(angle_between_deg(a, b).max())


@parametrize("name", method_names())
@parametrize("change", ["order of lights", "darker", "brighter", "batches", "turn"])
def test_what_changes_nothing(name, change, glossy_pixels, rng):
    """But for CNN-PS, normals turn with the lights. That is only symmetric as far as its ten
    rotations go.
    """
    _, lights, observations = glossy_pixels
    observations = observations[: 12 if name == "cnn-ps" else 60]  # which takes ten times as long
    order, turn = np.arange(len(lights)), np.eye(3)
    if change == "order of lights":
        order = rng.permutation(len(lights))
    elif change == "turn" and name != "cnn-ps":
        turn = _about_view_axis(0.7)
    factors = np.full((len(observations), 1), {"darker": 1e-3, "brighter": 1000.0}.get(change, 1.0))
    if name not in SEE_CAPTURE:
        # A factor for each pixel: albedo is unknown, so it may not matter either.
        factors *= np.linspace(0.5, 2, len(observations))[:, None]
    before = make(name).estimate(np.float32(observations), lights)
    changed = (observations * factors)[:, order].astype(np.float32)
    after = make(name, 7 if change == "batches" else None).estimate(changed, lights[order] @ turn)
    assert largest_difference_deg(before @ turn, after) < 0.05


@parametrize("name", method_names())
@parametrize("n_lights", [3, 4, 14])
def test_odd_pixels_still_get_a_normal(name, n_lights, glossy_pixels):
    _, lights, observations = glossy_pixels
    odd = observations[:6, :n_lights].astype(np.float32)
    odd[0] = 0
    odd[1] = 1
    odd[2, 1:] = 0
    odd[3] = np.where(np.arange(n_lights) < 2, odd[3] + 1, 0)
    odd[4] *= -1  # a dark frame may have been subtracted
    found = make(name).estimate(odd, lights[:n_lights])
    assert_unit(found)
    assert_array_equal(found[0], (0, 0, 1))


@parametrize("name", method_names())
def test_a_pixel_may_have_lights_of_its_own(name, glossy_pixels):
    """Two pixels at a time, with shared lights, are the oracle for all pixels at once, with lights
    of their own.

    Both see the same capture, if they see one at all.
    """
    _, lights, observations = glossy_pixels
    some = observations[:6].astype(np.float32)
    turned = np.stack(
        [lights @ _about_view_axis(angle) for angle in (0.0, 0.0, 0.4, 0.4, -1.1, -1.1)]
    )
    method = make(name).bind(
        lambda rows: PixelLighting(some[rows], turned[rows]), np.ones((1, len(some)), np.bool_)
    )
    together = method.estimate(some, turned)
    pairs = [method.estimate(some[first : first + 2], turned[first]) for first in (0, 2, 4)]
    assert largest_difference_deg(together, np.concatenate(pairs)) < 0.05
    # The lights matter: without their own, the pixels get other normals.
    assert largest_difference_deg(together[2:], method.estimate(some, lights)[2:]) > 1


def _about_view_axis(angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
