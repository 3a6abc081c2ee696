"""SPLINE-Net as an estimator: batches, rotations, progress."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import angle_between_deg
from splinecli.methods.networks import NetworkEstimator, rotations_of
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


def test_four_rotations_of_the_paper_network_make_it_fourfold_symmetric() -> None:
    # Turning the lights by 90 degrees only changes the order of the four rotations.
    observations, lights = pixels(4)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for rotations, symmetric in ((4, True), (1, False)):
        network = estimator(random_network(size="paper", map_size=8), rotations=rotations)
        here, there = (network.estimate(observations, lights), network.estimate(observations, lights @ quarter.T))
        assert np.allclose(there, here @ quarter.T, atol=1e-4) == symmetric


def test_two_rotations_of_a_canonical_network_make_it_mirror_symmetric() -> None:
    observations, lights = pixels(10)
    for rotations, symmetric in ((2, True), (1, False)):
        network = estimator(rotations=rotations)
        here, there = (network.estimate(observations, lights), network.estimate(observations, lights * (1, -1, 1)))
        assert np.allclose(there, here * (1, -1, 1), atol=1e-4) == symmetric


def test_progress_changes_no_bit() -> None:
    observations, lights = pixels(150)
    network = estimator(batch_size=100)
    done: list[int] = []
    watched = network.estimate(observations, lights, progress=done.append)
    assert watched.tobytes() == network.estimate(observations, lights).tobytes()
    assert done == [100, 50]


def test_networks_in_several_threads_count_apart() -> None:
    observations, lights = pixels(60)
    network = estimator(batch_size=20)
    done: list[list[int]] = [[], [], []]
    with ThreadPoolExecutor() as pool:
        for counts in done:
            pool.submit(network.estimate, observations, lights, progress=counts.append)
    assert [sum(counts) for counts in done] == [60, 60, 60]
    assert done[0] == done[1] == done[2]
