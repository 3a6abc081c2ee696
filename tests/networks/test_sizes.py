"""How large and how costly the networks are: the paper's figures, and the budget of a laptop."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from splinecli.networks.config import NetworkConfig
from splinecli.networks.li_net import PaperLINet
from splinecli.networks.ne_net import PaperNENet
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import save_weights


def parameters(network: nn.Module) -> int:
    return sum(parameter.numel() for parameter in network.parameters())


def test_paper_li_net_has_the_published_number_of_parameters() -> None:
    # Weights: 1*64*7*7, 64*128*4*4, 128*256*4*4; 12 times 256*256*3*3; 256*128*4*4, 128*64*4*4, 64*1*7*7.
    weights = 3_136 + 131_072 + 524_288 + 12 * 589_824 + 524_288 + 131_072 + 3_136
    # A scale and an offset for each normalised channel.
    norms = 2 * (64 + 128 + 256 + 12 * 256 + 128 + 64)
    expected = weights + norms
    assert parameters(PaperLINet()) == expected == 8_402_304
    assert expected / 1e6 == pytest.approx(8.40, abs=0.01)


def test_paper_ne_net_has_the_published_number_of_parameters() -> None:
    # 2*16*9 + 16; dense block 16*16*9 + 16, 32*16*9 + 16; 48*48 + 48; dense block 48*16*9 + 16, 64*16*9 + 16;
    # 80*80 + 80; 80*16*16 * 128 + 128; 128*3 + 3.
    expected = 304 + 2_320 + 4_624 + 2_352 + 6_928 + 9_232 + 6_480 + 2_621_568 + 387
    assert parameters(PaperNENet(2, 32)) == expected == 2_654_195
    assert expected / 1e6 == pytest.approx(2.65, abs=0.01)


def multiply_adds(network: SplineNet) -> int:
    """Multiply-adds of one pixel, counted where they happen."""
    count = 0

    def add(module: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        nonlocal count
        if isinstance(module, nn.Linear):
            count += module.in_features * module.out_features
        elif isinstance(module, nn.Conv2d):
            taps = module.in_channels // module.groups * math.prod(module.kernel_size)
            count += output[0].numel() * taps
        elif isinstance(module, nn.ConvTranspose2d):
            count += inputs[0][0].numel() * module.out_channels * math.prod(module.kernel_size)

    hooks = [module.register_forward_hook(add) for module in network.modules()]
    lights = torch.nn.functional.normalize(torch.tensor([[0.3, 0, 1], [-0.3, 0.2, 1], [0, -0.4, 1]]), dim=1)
    with torch.no_grad():
        network.eval()(torch.rand(1, 3), lights)
    for hook in hooks:
        hook.remove()
    return count


def test_counting_by_hand_on_the_paper_size() -> None:
    # LI-Net, position by position: 32*32 of 49*64, 16*16 of 64*128*16, 8*8 of 128*256*16 and of 12 times 256*256*9;
    # the way back from 8*8 of 256*128*16, 16*16 of 128*64*16, 32*32 of 49*64.
    li_net = (
        2 * 32**2 * 49 * 64 + 2 * 16**2 * 64 * 128 * 16 + 2 * 8**2 * 128 * 256 * 16 + 12 * 8**2 * 256**2 * 9
    )
    # NE-Net: 32*32 of 2*16*9, (16 + 32)*16*9, 48*48; 16*16 of (48 + 64)*16*9, 80*80; 20480*128, 128*3.
    ne_net = 32**2 * (288 + 48 * 144 + 48**2) + 16**2 * (112 * 144 + 80**2) + 20480 * 128 + 128 * 3
    assert multiply_adds(SplineNet(NetworkConfig(size="paper"))) == li_net + ne_net


def test_compact_size_fits_a_laptop(tmp_path: Path) -> None:
    network = SplineNet(NetworkConfig(size="compact"))
    # Ten times fewer than the paper's 0.6 billion, and some to spare.
    assert multiply_adds(network) <= 45e6
    save_weights(network, tmp_path / "weights.safetensors")
    assert (tmp_path / "weights.safetensors").stat().st_size <= 8e6
