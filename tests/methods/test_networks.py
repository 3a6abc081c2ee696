"""SPLINE-Net as an estimator: batches, rotations, progress."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.lights.lighting import LightingAt, PixelLighting
from splinecli.maths.normals import angle_between_deg
from splinecli.methods import make_estimator
from splinecli.methods.batched import NetworkEstimator, rotations_of
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import LoadedNetwork
from tiny_networks import random_network


def pixels(count: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    rng = np.random.default_rng(0)
    lights = rng.normal(size=(10, 3)) + np.array((0, 0, 3))
    observations = rng.uniform(size=(count, 10)).astype(np.float32)
    return observations, lights / np.linalg.norm(lights, axis=1, keepdims=True)


def estimator(network: SplineNet | None = None, **options: Any) -> NetworkEstimator:
    loaded = LoadedNetwork(network or random_network(), "random", "0" * 64)
    return NetworkEstimator("spline-net", loaded, **{"precision": "float32", **options})


def test_bfloat16_costs_little() -> None:
    observations, lights = pixels(50)
    exact = estimator().estimate(observations, lights)
    coarse = estimator(precision="bfloat16").estimate(observations, lights)
    error = angle_between_deg(coarse, exact)
    # 8 bits of mantissa on the correction alone, not on the fit.
    assert 0 < error.max() < 1


def test_rotations_of_a_canonical_network() -> None:
    assert rotations_of(1, canonical=True) == [(0, False)]
    assert rotations_of(2, canonical=True) == [(0, False), (0, True)]
    assert rotations_of(4, canonical=True) == [(-10, False), (-10, True), (10, False), (10, True)]
    assert rotations_of(6, canonical=True) == [(t, m) for t in (-10.0, 0.0, 10.0) for m in (False, True)]
    for rotations in range(1, 20):
        several = rotations_of(rotations, canonical=True)
        assert len(set(several)) == rotations
        # Training turns by up to 15 degrees.
        assert max(abs(turn) for turn, _ in several) <= 15


SEES = {"map_size": 16, "set_width": 16, "set_layers": 1, "error_head": True, "sees_capture": True}
PAPER = {"size": "paper", "map_size": 8}
QUARTER, MIRROR = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.diag((1.0, -1, 1))


@pytest.mark.parametrize(
    ("settings", "turn", "symmetric_from"), [(PAPER, QUARTER, 4), ({}, MIRROR, 2), (SEES, MIRROR, 2)]
)
def test_rotations_make_a_network_symmetric(settings, turn, symmetric_from) -> None:
    """Four make the paper's fourfold symmetric, for turned lights only change their order; two make ours a mirror."""
    observations, lights = pixels(4)
    for rotations in (symmetric_from, 1):
        network = estimator(random_network(**settings), rotations=rotations)
        here, there = network.estimate(observations, lights), network.estimate(observations, lights @ turn.T)
        assert np.allclose(there, here @ turn.T, atol=1e-4) == (rotations > 1)


def test_progress_changes_no_bit() -> None:
    observations, lights = pixels(150)
    network = estimator(batch_size=100)
    done: list[int] = []
    watched = network.estimate(observations, lights, progress=done.append)
    assert watched.tobytes() == network.estimate(observations, lights).tobytes()
    assert done == [100, 50]


def lighting_at(observations: NDArray[np.float32], lights: NDArray[np.float64]) -> LightingAt:
    return lambda rows: PixelLighting(observations[rows], lights)


def test_pixels_see_their_capture_and_not_their_tile() -> None:
    observations, lights = pixels(600)
    network = estimator(random_network(**SEES), batch_size=100)
    whole = network.bind(lighting_at(observations, lights), 600)
    expected, errors = whole.estimate_with_error(observations, lights)
    for tile in (slice(0, 30), slice(250, 600)):
        found, found_errors = whole.estimate_with_error(observations[tile], lights)
        assert angle_between_deg(found, expected[tile]).max() < 0.01
        assert np.allclose(found_errors, errors[tile], atol=1e-3)
    # Alone, the pixels of a call are a capture.
    assert angle_between_deg(network.estimate(observations, lights), expected).max() < 0.01
    assert angle_between_deg(network.estimate(observations[:30], lights), expected[:30]).max() > 0.1
    # The network that was given sees nothing of this capture.
    assert whole is not network and network._contexts == [None]


def test_a_black_background_says_nothing_of_the_object() -> None:
    observations, lights = pixels(200)
    network = estimator(random_network(**SEES))
    expected = network.estimate(observations, lights)
    dark = np.random.default_rng(1).uniform(0, 1e-3, (800, 10)).astype(np.float32)
    with_background = np.concatenate((dark[:400], observations, dark[400:]))
    found = network.bind(lighting_at(with_background, lights), 1000).estimate(with_background, lights)
    assert angle_between_deg(found[400:600], expected).max() < 0.01
    assert np.array_equal(network.estimate(0 * dark, lights), np.tile((0, 0, 1), (800, 1)))


def test_methods_that_see_no_capture_stay_as_they_are() -> None:
    observations, lights = pixels(20)
    for method in (estimator(), make_estimator("ls")):
        assert method.bind(lighting_at(observations, lights), 20) is method
