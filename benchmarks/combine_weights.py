"""Combine weights of spline-net.

    python benchmarks/combine_weights.py join PIXELWISE REFINED OUT
    python benchmarks/combine_weights.py mean WEIGHTS... OUT

`join` takes the pixelwise networks with their error head from one file and the refinement nets from
another, which can then be trained further. `mean` averages the weights of runs with the same start,
which is often more accurate on unseen scenes than any of them.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from splinecli.estimate.networks.weights import resolve_weights
from splinecli.workshop.save_weights import save_weights


def join(pixelwise: str, refined: str, out: Path) -> None:
    """Write the pixelwise networks of some weights, which have an error head, with the refinement
    nets of others.
    """
    network = resolve_weights(refined).network
    parts = (resolve_weights(pixelwise).network, False), (network, True)
    network.load_state_dict(
        {
            name: values
            for part, refines in parts
            for name, values in part.state_dict().items()
            if name.startswith("refine_net.") == refines
        }
    )
    save_weights(network, out)


def mean(weights: list[str], out: Path) -> None:
    """Write the means of all parameters."""
    networks = [resolve_weights(name).network for name in weights]
    for name, network in zip(weights, networks, strict=True):
        assert network.config == networks[0].config, f"{name} is of another network"
    parameters = [network.state_dict() for network in networks]
    networks[0].load_state_dict(
        {
            name: torch.stack([each[name] for each in parameters]).mean(dim=0)
            for name in parameters[0]
        }
    )
    save_weights(networks[0], out)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    joining = commands.add_parser("join")
    joining.add_argument("pixelwise")
    joining.add_argument("refined")
    joining.add_argument("out", type=Path)
    averaging = commands.add_parser("mean")
    averaging.add_argument("weights", nargs="+")
    averaging.add_argument("out", type=Path)
    options = vars(parser.parse_args(arguments))
    if options.pop("command") == "join":
        join(**options)
    else:
        mean(**options)


if __name__ == "__main__":
    main()
