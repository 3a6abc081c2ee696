"""A network that sees the capture: pixels see all pixels of their own capture, and no others."""

import pytest
import torch
from torch import Tensor

from distributions import generator as seeded
from splinecli.networks.config import NetworkConfig
from splinecli.networks.set_branch import ContextLayer
from splinecli.networks.spline_net import SplineNet
from tiny_networks import TINY, random_network

SEES = TINY | {"map_size": 16, "set_width": 16, "set_layers": 2, "error_head": True}


def pixels(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Random observations under seven lights."""
    lights = torch.nn.functional.normalize(torch.rand(7, 3, generator=seeded(seed)) + 0.2, dim=1)
    return torch.rand(count, 7, generator=seeded(seed + 1)), lights


@pytest.fixture(scope="module")
def network() -> SplineNet:
    return random_network(**SEES, sees_capture=True)


def test_at_first_a_capture_says_nothing() -> None:
    alone, seeing = (SplineNet(NetworkConfig(**SEES, sees_capture=sees)).eval() for sees in (False, True))
    for parameter in alone.parameters():  # the layers that are zero at first, too
        torch.nn.init.normal_(parameter, std=0.1) if not parameter.any() else None
    assert not seeing.load_state_dict(alone.state_dict(), strict=False).unexpected_keys
    assert alone.encode_context(*pixels(3)) is None
    observations, lights = pixels(12)
    for found, expected in zip(seeing(observations, lights), alone(observations, lights), strict=True):
        assert torch.equal(found, expected)


def test_a_sample_of_all_pixels_is_the_capture_itself(network: SplineNet) -> None:
    observations, lights = pixels(20)
    context = network.encode_context(observations, lights)
    whole = network(observations, lights)
    parts = [network(part, lights, context=context) for part in observations.split(7)]
    torch.testing.assert_close(torch.cat([part.normals for part in parts]), whole.normals, atol=3e-5, rtol=0)
    torch.testing.assert_close(torch.cat([part.error for part in parts]), whole.error, atol=1e-4, rtol=0)
    # It does say something, and the order of the sample does not matter.
    other = network(observations, lights, context=network.encode_context(*pixels(20, 5)))
    assert (other.normals - whole.normals).abs().max() > 1e-3
    shuffled = network.encode_context(observations.flip(0), lights)
    again = network(observations, lights, context=shuffled)
    torch.testing.assert_close(again.normals, whole.normals, atol=3e-5, rtol=0)


def test_captures_of_a_batch_do_not_see_each_other(network: SplineNet) -> None:
    captures = [pixels(9, seed) for seed in (0, 10, 20)]
    # Pixel p belongs to capture p % 3.
    observations = torch.stack([seen for seen, _ in captures], dim=1).flatten(0, 1)
    lights = torch.stack([lights.expand(9, 7, 3) for _, lights in captures], dim=1).flatten(0, 1)
    maps = network.build_maps(observations, lights)
    together = network.estimate(maps, network.interpolate(maps), captures=3)
    for number, (seen, own) in enumerate(captures):
        maps = network.build_maps(seen, own)
        alone = network.estimate(maps, network.interpolate(maps))
        # Processors with AMX round sums of other sizes of batches differently; another capture would change 0.01.
        torch.testing.assert_close(together.normals[number::3], alone.normals, atol=3e-4, rtol=0)


def test_the_exposure_of_a_capture_does_not_matter_but_the_brightness_of_a_pixel_does(network: SplineNet) -> None:
    observations, lights = pixels(16)
    whole = network(observations, lights).normals
    torch.testing.assert_close(network(37 * observations, lights).normals, whole, atol=1e-5, rtol=0)
    darker = observations * torch.linspace(0.1, 1, 16)[:, None]
    assert (network(darker, lights).normals - whole).abs().max() > 1e-3


def test_attention_and_mean_are_those_of_the_formulas() -> None:
    """One capture, computed once more pixel by pixel and head by head in float64."""
    torch.manual_seed(0)
    layer = ContextLayer(16).double()
    torch.nn.init.normal_(layer.join[2].weight)
    tokens, level = torch.randn(5, 16).double(), torch.randn(5, 1).double()
    found, _ = layer(tokens, level, 1, None)
    embedded = layer.embed(torch.cat((tokens, level), dim=1))
    sample, queries = layer.key_norm(embedded), layer.query_norm(embedded)
    keys, values = layer.keys_values(sample).chunk(2, dim=1)
    for pixel in range(5):
        heads = []
        for head in range(4):
            part = slice(4 * head, 4 * head + 4)
            asked = layer.queries(queries)[pixel, part]
            weights = torch.softmax(keys[:, part] @ asked / 2, dim=0)
            heads.append(weights @ values[:, part])
        seen = torch.cat((queries[pixel], *heads, layer.pooled(sample).mean(dim=0)))
        torch.testing.assert_close(found[pixel], tokens[pixel] + layer.join(seen), atol=1e-5, rtol=1e-5)
