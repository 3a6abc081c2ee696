"""Refinement of a whole capture: tiles, masks, dark pixels, and the scores of single pixels."""

from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from scenes import evaluate, spiral_lights
from splinecli.capture import Capture, read_capture
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.trials import scored_rows
from splinecli.inference import estimate_normals
from splinecli.lights.lighting import LightingAt, PixelLighting
from splinecli.maths.normals import unit
from splinecli.methods.batched import NetworkEstimator
from splinecli.methods.estimator import UNKNOWN_ERROR
from splinecli.networks.config import NetworkConfig
from splinecli.networks.refine_net import RefineNet
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import LoadedNetwork
from splinecli.refinement.refiner import NetworkRefiner
from tiny_networks import TINY

LIGHTS = spiral_lights(6, 60)
REACH = RefineNet().reach
Network = TypeVar("Network", bound=torch.nn.Module)


def lively(network: Network) -> Network:
    """Fill every parameter with small random numbers."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.08 * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def distant(observations: NDArray[np.float32], lights: NDArray[np.float64] = LIGHTS) -> LightingAt:
    return lambda rows: PixelLighting(observations[rows], lights)


def refine(
    mask: NDArray[np.bool_], tile: int, *, dark: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the normals before, and normals and errors after refinement of a random map."""
    rng = np.random.default_rng(1)
    count = np.count_nonzero(mask)
    normals = unit(rng.normal((0, 0, 3), 1, (count, 3))).astype(np.float32)
    errors = rng.normal((-3, 1), 0.3, (count, 2)).astype(np.float32)
    observations = (normals @ LIGHTS.T).clip(0).astype(np.float32)
    if dark is not None:
        observations[dark], errors[dark] = 0, UNKNOWN_ERROR
    refined, done = normals.copy(), []
    refiner = NetworkRefiner(lively(RefineNet()), "float32", tile=tile, margin=REACH)
    refiner.refine(mask, observations, distant(observations), refined, errors, progress=done.append)
    assert sum(done) == count
    return normals, refined, errors


@pytest.mark.parametrize("shape", [(2 * REACH + 70, 40), (40, 2 * REACH + 70)])
def test_tiles_change_nothing(shape: tuple[int, int]) -> None:
    """Three tiles in a row or in a column. Seams of tiles on all sides: test_shipped_refinement.py."""
    mask = np.random.default_rng(0).random(shape) < 0.95
    mask[30:60, 10:30] = False
    _, normals, errors = refine(mask, 512)
    _, tiled, tiled_errors = refine(mask, REACH)
    np.testing.assert_allclose(tiled, normals, atol=1e-4)
    np.testing.assert_allclose(tiled_errors, errors, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (37, 1), (5, 6)])
def test_small_and_thin_masks(shape: tuple[int, int]) -> None:
    before, normals, _ = refine(np.ones(shape, np.bool_), 512)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert np.abs(normals - before).max() > 1e-3


def test_dark_pixels_stay() -> None:
    before, normals, errors = refine(np.ones((8, 9), np.bool_), 512, dark=20)
    np.testing.assert_array_equal(normals[20], before[20])
    np.testing.assert_allclose(errors[20], UNKNOWN_ERROR, rtol=1e-6)
    assert (normals[21] != before[21]).any()


def test_a_turned_capture_gets_turned_normals() -> None:
    """The mean over four turns does not depend on how the camera was held."""
    rng = np.random.default_rng(3)
    mask = rng.random((24, 32)) < 0.9
    normals = unit(rng.normal((0, 0, 3), 1, (*mask.shape, 3))).astype(np.float32)
    net = lively(RefineNet())

    def refined(turns: int) -> NDArray[np.float32]:
        """Refine the map turned counterclockwise by quarters, and turn the result back."""
        turn = np.round(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])) if turns else np.eye(3)
        seen, lights = np.rot90(mask, turns), LIGHTS @ turn.T
        found = (np.rot90(normals, turns)[seen] @ turn.T).astype(np.float32)
        observations = (found @ lights.T).clip(0).astype(np.float32)
        errors = np.tile(np.float32((-3, 1)), (len(found), 1))
        NetworkRefiner(net, "float32").refine(seen, observations, distant(observations, lights), found, errors)
        result = np.zeros((*seen.shape, 3), np.float32)
        result[seen] = found @ turn
        return np.rot90(result, -turns)

    # The cells of the coarse scales begin at the map's corner, so both sides are multiples of them in this test.
    np.testing.assert_allclose(refined(1), refined(0), atol=1e-3)


def estimator(*, refines: bool) -> NetworkEstimator:
    network = lively(SplineNet(NetworkConfig(**TINY, error_head=True, refines=True)))
    name = "spline-net" if refines else "spline-net-pixelwise"
    return NetworkEstimator(name, LoadedNetwork(network, "tiny", "0"), precision="float32", refines=refines)


def test_the_pixelwise_method_leaves_the_refinement_out() -> None:
    rng = np.random.default_rng(2)
    mask = np.ones((7, 8), np.bool_)
    capture = Capture("c", rng.uniform(0.1, 1, (56, 6)).astype(np.float32), LIGHTS, tuple(range(6)), mask)
    pixelwise, refined = (estimate_normals(capture, estimator(refines=refines)) for refines in (False, True))
    alone = estimator(refines=True).estimate(capture.observations, LIGHTS)
    np.testing.assert_array_equal(pixelwise.normal_map[mask], alone)
    assert np.abs(refined.normal_map - pixelwise.normal_map).max() > 1e-3
    assert np.abs(refined.confidence_map - pixelwise.confidence_map).max() > 1e-3


def test_scored_pixels_are_refined_among_all() -> None:
    """Scoring 50 pixels needs the whole map: they score as they do in the map of `infer`."""
    folder = Path(__file__).parents[2] / "examples/medallion"
    method = estimator(refines=True)
    protocol = Protocol(n_lights=None, trials=1, max_pixels=50)
    (result,) = evaluate([folder], [method], protocol).results
    capture = read_capture(folder)
    errors_deg = estimate_normals(capture, method).error_map_deg
    rows = scored_rows(capture, max_pixels=50, seed=protocol.seed)
    assert result.mae_deg == pytest.approx(errors_deg[capture.mask][rows].mean(), abs=1e-4)
