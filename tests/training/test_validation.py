"""The validation error, and the sample maps of maps.png."""

import numpy as np
import pytest
import torch

from splinecli.maths.observation_map import cell_directions
from splinecli.networks.spline_net import SplineNet
from splinecli.synthesis.batches import PixelBatch
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training.config import TrainingConfig
from splinecli.training.tasks import SHOWN_PIXELS, PixelTask


@pytest.fixture
def network(tiny: TrainingConfig) -> SplineNet:
    torch.manual_seed(0)
    return SplineNet(tiny.network)


@pytest.fixture
def batch(tiny: TrainingConfig) -> PixelBatch:
    return PixelGenerator(tiny.pixels, torch.Generator().manual_seed(3)).draw(40)


@pytest.fixture
def task(tiny: TrainingConfig, batch: PixelBatch) -> PixelTask:
    made = PixelTask(tiny, range(1), torch.device("cpu"))
    made.validation = [batch]
    return made


def errors_deg(network: SplineNet, batch: PixelBatch) -> torch.Tensor:
    with torch.no_grad():
        normals = network(batch.observations, batch.light_directions, batch.valid).normals
    return (normals.double() * batch.truth.normals).sum(dim=1).clamp(-1, 1).acos().rad2deg()


def test_validation_is_the_mean_angle_to_the_truth(task: PixelTask, network: SplineNet, batch: PixelBatch) -> None:
    network.train()
    found = task.validation_deg(network, bfloat16=False)
    assert not network.training
    assert found == pytest.approx(errors_deg(network, batch).mean().item(), abs=1e-3)
    assert all(parameter.grad is None for parameter in network.parameters())


def test_the_maps_of_some_pixels(task: PixelTask, network: SplineNet, batch: PixelBatch) -> None:
    shown = task.sample_maps(network)
    assert len(shown.sparse) == len(shown.dense) == len(shown.truth) == len(shown.error_deg) == SHOWN_PIXELS
    views = network.build_maps(batch.observations, batch.light_directions, batch.valid)
    inside, errors = cell_directions()[1].numpy(), errors_deg(network, batch)
    with torch.no_grad():
        dense = network.interpolate(views)
    for index in range(SHOWN_PIXELS):
        pixel = 5 * index  # spread over the 40
        occupied = views.occupied[pixel, 0].numpy() > 0
        np.testing.assert_array_equal(np.isfinite(shown.sparse[index]), occupied)
        np.testing.assert_array_equal(shown.sparse[index][occupied], views.sparse[pixel, 0].numpy()[occupied])
        np.testing.assert_array_equal(np.isfinite(shown.dense[index]), inside)
        np.testing.assert_allclose(shown.dense[index][inside], dense[pixel, 0].numpy()[inside], atol=1e-6)
        np.testing.assert_array_equal(np.isfinite(shown.truth[index]), inside)
        assert shown.error_deg[index] == pytest.approx(errors[pixel].item(), abs=0.01)
