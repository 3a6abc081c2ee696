"""Refinement of a whole capture: tiles, masks, dark pixels, scores of single pixels, and detail
that is real.
"""

import shutil
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from torch.nn.functional import normalize, pad
from torch.testing import assert_close

from distributions import seeded
from scenes import (
    as_capture,
    assert_unit,
    evaluate,
    parametrize,
    read_image,
    ring_lights,
    spiral_lights,
    vectors,
    write_image,
)
from splinecli.estimate.fits.least_squares import alternating_signs
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.estimate.methods.batched import NetworkEstimator
from splinecli.estimate.methods.estimator import UNKNOWN_ERROR
from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.refine_net import FEATURE_CHANNELS, RefineNet, channels
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import LoadedNetwork
from splinecli.estimate.refinement.detail import DETAIL_REACH, restore_detail
from splinecli.estimate.refinement.features import refine_features
from splinecli.estimate.refinement.refiner import NetworkRefiner
from splinecli.evaluation.protocol import Protocol
from splinecli.evaluation.trials import scored_rows
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import unit
from splinecli.recipe import read_capture
from tiny_networks import TINY

LIGHTS = spiral_lights(6, 60)
REACH = RefineNet().reach
Network = TypeVar("Network", bound=torch.nn.Module)


def lively(network):
    """Fill every parameter with small random numbers."""
    generator = seeded(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.08 * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def distant(observations, lights=LIGHTS):
    return lambda rows: PixelLighting(observations[rows], lights)


def refine(mask, tile, *, dark=None):
    """Return the normals before, and normals and errors after refinement of a random map."""
    rng = default_rng(1)
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


@parametrize("shape", [(2 * REACH + 70, 40), (40, 2 * REACH + 70)])
def test_tiles_change_nothing(shape, rng):
    """Three tiles in a row or in a column. Seams of tiles on all sides:
    test_shipped_refinement.py.
    """
    mask = rng.random(shape) < 0.95
    mask[30:60, 10:30] = False
    _, normals, errors = refine(mask, 512)
    _, tiled, tiled_errors = refine(mask, REACH)
    assert_allclose(tiled, normals, atol=1e-4)
    assert_allclose(tiled_errors, errors, rtol=1e-4, atol=1e-3)
    assert_unit(normals)


@parametrize("shape", [(1, 1), (1, 40), (37, 1), (5, 6)])
def test_small_and_thin_masks(shape):
    before, normals, _ = refine(np.ones(shape, np.bool_), 512)
    assert_unit(normals)
    assert np.abs(normals - before).max() > 1e-3


def test_dark_pixels_stay():
    before, normals, errors = refine(np.ones((8, 9), np.bool_), 512, dark=20)
    assert_array_equal(normals[20], before[20])
    assert_allclose(errors[20], UNKNOWN_ERROR, rtol=1e-6)
    assert (normals[21] != before[21]).any()


def test_a_turned_capture_gets_turned_normals():
    """The mean over four turns does not depend on how the camera was held."""
    rng = default_rng(3)
    mask = rng.random((24, 32)) < 0.9
    normals = unit(rng.normal((0, 0, 3), 1, (*mask.shape, 3))).astype(np.float32)
    net = lively(RefineNet())

    def refined(turns):
        """Refine the map turned counterclockwise by quarters, and turn the result back."""
        turn = np.round(vectors("0 -1 0; 1 0 0; 0 0 1")) if turns else np.eye(3)
        seen, lights = np.rot90(mask, turns), LIGHTS @ turn.T
        found = np.float32(np.rot90(normals, turns)[seen] @ turn.T)
        observations = (found @ lights.T).clip(0).astype(np.float32)
        errors = np.tile(np.float32((-3, 1)), (len(found), 1))
        NetworkRefiner(net, "float32").refine(
            seen, observations, distant(observations, lights), found, errors
        )
        result = np.zeros((*seen.shape, 3), np.float32)
        result[seen] = found @ turn
        return np.rot90(result, -turns)

    # The cells of the coarse scales begin at the map's corner, so both sides are multiples of them
    # in this test.
    assert_allclose(refined(1), refined(0), atol=1e-3)


def estimator(*, refines):
    network = lively(SplineNet(NetworkConfig(**TINY, error_head=True, refines=True)))
    name = "spline-net" if refines else "spline-net-pixelwise"
    return NetworkEstimator(
        name, LoadedNetwork(network, "tiny", "0"), precision="float32", refines=refines
    )


def test_the_pixelwise_method_leaves_the_refinement_out():
    rng = default_rng(2)
    mask = np.ones((7, 8), np.bool_)
    capture = as_capture(rng.uniform(0.1, 1, (56, 6)), LIGHTS, mask)
    pixelwise, refined = (
        estimate_normals(capture, estimator(refines=refines)) for refines in (False, True)
    )
    alone = estimator(refines=True).estimate(capture.observations, LIGHTS)
    assert_array_equal(pixelwise.normal_map[mask], alone)
    assert np.abs(refined.normal_map - pixelwise.normal_map).max() > 1e-3
    assert np.abs(refined.confidence_map - pixelwise.confidence_map).max() > 1e-3


@parametrize("of_package", [False, True])
def test_scored_pixels_are_estimated_among_all(tmp_path, of_package):
    """Refinement and context need the whole capture: 50 pixels score as they do in the map of
    `infer`.
    """
    folder = shutil.copytree(Path(__file__).parents[3] / "examples/medallion", tmp_path / "a")
    mask = read_image(folder / "mask.png")
    mask[:40], mask[80:] = 0, 0  # for speed
    write_image(folder / "mask.png", mask)
    method = make_estimator("spline-net-pixelwise") if of_package else estimator(refines=True)
    protocol = Protocol(n_lights=None, trials=1, max_pixels=50)
    (result,) = evaluate([folder], [method], protocol).results
    capture = read_capture(folder)
    errors_deg = estimate_normals(capture, method).error_map_deg
    rows = scored_rows(capture, max_pixels=50, seed=protocol.seed)
    assert result.mae_deg == pytest.approx(errors_deg[capture.mask][rows].mean(), abs=1e-4)


SIDE = 48
FEW_LIGHTS = torch.tensor(spiral_lights(10, 55), dtype=torch.float32)
SQUARE = torch.tensor(ring_lights(4, 40), dtype=torch.float32)
FLAT = torch.tensor((0.0, 0.0, 1.0))[:, None, None].repeat(1, SIDE, SIDE)
EVERYWHERE = torch.ones(1, SIDE, SIDE)

SLOPE = 0.2 * (1 - 2.0 * (torch.arange(SIDE) % 2)).expand(SIDE, SIDE)
GROOVES = normalize(torch.stack((-SLOPE, torch.zeros_like(SLOPE), torch.ones_like(SLOPE))), dim=0)
"""True normals of grooves of one pixel."""


def photographed(truth, noise, lights=FEW_LIGHTS, *, seen=None):
    """Features (CHANNELS, SIDE, SIDE) of a matte surface, where SPLINE-Net has seen the normals
    `seen` (the truth).
    """
    generator = seeded(4)
    errors = noise * torch.randn(SIDE**2, len(lights), generator=generator)
    observations = (truth.flatten(1).T @ lights.T + errors).clamp(min=0)
    normals = (truth if seen is None else seen).flatten(1).T
    signs = alternating_signs(lights)
    features = refine_features(observations, lights, normals, torch.zeros(SIDE**2, 2), 1.0, signs)
    return features.T.reshape(FEATURE_CHANNELS, SIDE, SIDE)


def photographed_with_noise(truth, noise, lights=FEW_LIGHTS):
    """The same features where SPLINE-Net has the noise of least squares."""
    features = photographed(truth, noise, lights)
    features[:3] += features[channels("plain")]
    features[channels("plain")] = 0
    return features


def restored(refined, features, mask):
    """What restore_detail makes of refined normals and features."""
    normals = features[channels("normal")]
    return restore_detail(
        refined, normals, normals + features[channels("plain")], features[channels("noise")], mask
    )


@parametrize("noise, least, most", [(0.005, 0.975, 0.985), (0.03, 0.9, 0.985), (0.4, -0.001, 0.01)])
def test_grooves_come_back_where_they_exceed_the_noise(noise, least, most):
    """All of x comes back. Its share of the unit vector is smaller by the cosine, because z is no
    detail.
    """
    found = restored(FLAT, photographed(GROOVES, noise), EVERYWHERE)
    # near the border, the mean around a pixel has more of one side
    middle = slice(DETAIL_REACH, -DETAIL_REACH)
    assert least < float((found[0] / GROOVES[0])[:, middle].mean()) < most


def test_nothing_comes_back_that_least_squares_does_not_show():
    """SPLINE-Net has seen the opposite of the grooves."""
    features = photographed(GROOVES, 0.005, seen=torch.roll(GROOVES, 1, dims=-1))
    assert_close(restored(FLAT, features, EVERYWHERE), FLAT, atol=1e-4, rtol=0)


@parametrize("creased", [False, True])
@parametrize("lights", [FEW_LIGHTS, FEW_LIGHTS[:6], SQUARE])
def test_noise_stays_removed(lights, creased):
    """Also beside a crease, which is detail that is not missing."""
    slope = torch.where(torch.arange(SIDE) < SIDE // 2, 0.4, -0.4).expand(SIDE, SIDE)
    crease = normalize(
        torch.stack((-slope, torch.zeros_like(slope), torch.ones_like(slope))), dim=0
    )
    truth = crease if creased else FLAT
    noisy = photographed_with_noise(truth, 0.03, lights)
    found = restored(truth, noisy, EVERYWHERE)
    assert (found - truth).square().mean() < 0.01 * (noisy[:3] - truth).square().mean()


def test_black_pixels_change_nothing_beside_them():
    """Their zero vectors are no detail."""
    black = torch.arange(SIDE) < SIDE // 2
    truth = torch.where(black, 0.0, FLAT)
    noisy = photographed_with_noise(truth, 0.03)
    noisy[:, :, black] = 0
    found = restored(FLAT, noisy, EVERYWHERE)
    assert_close(found[..., black], FLAT[..., black])
    assert (found - FLAT).square().mean() < 0.01 * (noisy[:3] - truth).square().mean()


def test_outside_of_the_mask_is_outside_of_the_image():
    wide = (9, 3, 4, 8)
    mask = torch.rand(1, SIDE, SIDE, generator=seeded(6)) < 0.9
    maps = FLAT * mask, photographed(GROOVES, 0.05) * mask, mask.float()
    alone, within = restored(*maps), restored(*(pad(values, wide) for values in maps))
    assert (alone - FLAT * mask).abs().mean() > 0.03
    assert_close(within, pad(alone, wide), atol=1e-5, rtol=0)
