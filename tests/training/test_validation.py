"""The validation error, and the sample maps of maps.png."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splinecli.networks.spline_net import SplineNet
from splinecli.observation_map import cell_directions
from splinecli.pixel_sets.source import SampledPixels
from splinecli.synthesis.batches import PixelBatch
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training.config import TrainingConfig
from splinecli.training.validation import SHOWN_PIXELS, sample_maps, validation_deg


@pytest.fixture
def network(tiny: TrainingConfig) -> SplineNet:
    torch.manual_seed(0)
    return SplineNet(tiny.network)


@pytest.fixture
def batch(tiny: TrainingConfig) -> PixelBatch:
    return PixelGenerator(tiny.pixels, torch.Generator().manual_seed(3)).draw(40)


def test_validation_is_the_mean_angle_to_the_truth(network: SplineNet, batch: PixelBatch) -> None:
    network.train()
    found = validation_deg(network, batch)
    assert not network.training
    with torch.no_grad():
        normals = network(batch.observations, batch.light_directions, batch.valid).normals
    cosine = (normals.double() * batch.truth.normals).sum(dim=1).clamp(-1, 1)
    assert found == pytest.approx(cosine.acos().rad2deg().mean().item(), abs=1e-3)
    assert all(parameter.grad is None for parameter in network.parameters())


def test_bfloat16_is_near(network: SplineNet, batch: PixelBatch) -> None:
    exact, rounded = (validation_deg(network, batch, bfloat16=value) for value in (False, True))
    assert rounded == pytest.approx(exact, abs=0.5)


def test_the_maps_of_some_pixels(network: SplineNet, batch: PixelBatch) -> None:
    shown = sample_maps(network, batch)
    assert len(shown.sparse) == len(shown.dense) == len(shown.truth) == len(shown.error_deg) == SHOWN_PIXELS
    views = network.build_maps(batch.observations, batch.light_directions, batch.valid)
    inside = cell_directions()[1].numpy()
    with torch.no_grad():
        dense = network.interpolate(views)
        normals = network(batch.observations, batch.light_directions, batch.valid).normals
    cosine = (normals.double() * batch.truth.normals).sum(dim=1).clamp(-1, 1)
    for index in range(SHOWN_PIXELS):
        pixel = 5 * index  # spread over the 40
        occupied = views.occupied[pixel, 0].numpy() > 0
        np.testing.assert_array_equal(np.isfinite(shown.sparse[index]), occupied)
        np.testing.assert_array_equal(shown.sparse[index][occupied], views.sparse[pixel, 0].numpy()[occupied])
        np.testing.assert_array_equal(np.isfinite(shown.dense[index]), inside)
        np.testing.assert_allclose(shown.dense[index][inside], dense[pixel, 0].numpy()[inside], atol=1e-6)
        np.testing.assert_array_equal(np.isfinite(shown.truth[index]), inside)
        assert shown.error_deg[index] == pytest.approx(cosine[pixel].acos().rad2deg().item(), abs=0.01)


def test_gaps_of_the_truth_are_shown_as_gaps(network: SplineNet) -> None:
    # One light for the whole map: no more than 7 x 7 cells of it can be known.
    light = torch.tensor([[[0.0, 0.0, 1.0], [0.3, 0.0, 0.95], [0.0, 0.3, 0.95]]]).expand(4, 3, 3)
    light = torch.nn.functional.normalize(light, dim=-1)
    ones = torch.ones(4, 3)
    scene = SampledPixels(light[:, 0], ones, light, ones > 0)
    batch = PixelBatch(ones, light, ones > 0, scene, ones[:, :1])
    shown = sample_maps(network, batch)
    assert len(shown.truth) == 4
    assert (np.isfinite(shown.truth).sum(axis=(1, 2)) <= 3 * 49).all()
    assert np.nanmax(shown.truth) == pytest.approx(1)


def test_fewer_pixels_than_are_shown(tiny: TrainingConfig, network: SplineNet) -> None:
    generator = PixelGenerator(replace(tiny.pixels, max_lights=5, usual_lights=5), torch.Generator())
    assert len(sample_maps(network, generator.draw(3)).sparse) == 3
