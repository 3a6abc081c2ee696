"""The normals that NE-Net starts from, and what it makes of them."""

import pytest
import torch

from splinecli.methods import MethodOptions, make_estimator
from splinecli.networks.config import STARTING_FITS, NetworkConfig, fit_normals
from splinecli.networks.spline_net import Rotation, SplineNet
from tiny_networks import TINY

NAMES = tuple(STARTING_FITS)


def pixels(count: int, lights: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations (P, F), the largest of each pixel 1, and lights (P, F, 3) of its own for each pixel."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(count, lights, 3, generator=generator) + torch.tensor((0.0, 0.0, 2.0))
    directions = torch.nn.functional.normalize(directions, dim=-1)
    observations = torch.rand(count, lights, generator=generator)
    return observations / observations.amax(dim=1, keepdim=True), directions


@pytest.mark.parametrize("name", [name for name in NAMES if name != "iw12-all"])
def test_they_are_the_methods_of_these_names(name: str) -> None:
    observations, directions = pixels(20, 12)
    shared = directions[0]
    expected = make_estimator(name, MethodOptions(device="cpu")).estimate(observations.numpy(), shared.double().numpy())
    found = fit_normals([name], observations, shared)[:, 0]
    torch.testing.assert_close(found, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_each_pixel_has_its_own_lights_and_their_number(name: str) -> None:
    observations, directions = pixels(9, 12)
    count = torch.tensor([12, 11, 10, 9, 8, 7, 6, 5, 4])
    valid = torch.arange(12) < count[:, None]
    found = fit_normals([name], observations, directions, valid)
    for pixel in range(9):
        own = slice(0, int(count[pixel]))
        alone = fit_normals([name], observations[pixel : pixel + 1, own], directions[pixel, own])
        torch.testing.assert_close(found[pixel : pixel + 1], alone, atol=1e-4, rtol=0)


def test_pixels_that_no_fit_can_tell_anything_of() -> None:
    directions = pixels(1, 6)[1][0]
    observations = torch.tensor([[0.0] * 6, [1.0] + [0.0] * 5, [-0.2] * 5 + [1.0]])
    found = fit_normals(NAMES, observations, directions)
    assert torch.isfinite(found).all()
    assert not found[0].any()


def test_the_network_can_take_any_fit() -> None:
    network = SplineNet(NetworkConfig(**TINY, fits=NAMES))
    observations, directions = pixels(30, 10)
    weigh = network.ne_net.weigh
    assert isinstance(weigh, torch.nn.Linear)
    for place, name in enumerate(NAMES, start=1):
        with torch.no_grad():
            weigh.bias.copy_(torch.arange(len(NAMES) + 1) == place)
            for mirror in (False, True):
                found = network(observations, directions, rotation=Rotation(20.0, mirror=mirror)).normals
                torch.testing.assert_close(found, fit_normals([name], observations, directions)[:, 0])
