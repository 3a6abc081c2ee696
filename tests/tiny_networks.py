"""Networks small enough for tests."""

from typing import Any

import torch

from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.spline_net import SplineNet

TINY: dict[str, Any] = {"width": 8, "li_blocks": 1, "ne_blocks": 1, "head_width": 16}


def random_network(**settings):
    """Make a network all of whose layers are random: the last ones start at zero, where every
    symmetry holds.
    """
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = SplineNet(NetworkConfig.from_dict(TINY | settings)).eval()
        for parameter in network.parameters():
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
    return network
