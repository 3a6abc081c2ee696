"""Compare weights of spline-net on captures of rendered scenes that none of them was trained on.

    python benchmarks/unseen_scenes.py SET... --weights OLD NEW...

SET is a pixel set of `splinecli prepare`, such as unseen-groups of render_training_scenes.sh. A
capture is a part of a scene, or an engraved piece, with the lights, faults and camera of training
captures. The changes are relative to the first weights, with their standard errors over captures.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.maths import Floats
from splinecli.workshop.pixel_sets.store import open_pixel_set
from splinecli.workshop.training.config import PRESETS
from splinecli.workshop.training.refinement import (
    SceneMaps,
    ScenePool,
    refinement_losses,
    stack_maps,
)


@torch.no_grad()
def errors_deg(network: SplineNet, captures: Sequence[SceneMaps]) -> Floats:
    """Return the mean errors of captures before and after refinement (N, 2)."""
    losses = [refinement_losses(network, stack_maps([capture])) for capture in captures]
    return np.degrees([(found.before, found.angle) for found in losses])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--weights", nargs="+", default=["spline-net"])
    parser.add_argument("--captures", type=int, default=120)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    opened = [open_pixel_set(path) for path in options.sets]
    scenes = [(found, found.entries, float(len(found.entries))) for found in opened]
    # by the pixelwise networks, because several weights may differ only in the refinement nets
    captures: dict[str, list[SceneMaps]] = {}
    first = None
    for weights in options.weights:
        network = resolve_weights(weights).network.eval()
        pool = ScenePool(scenes, network, PRESETS["refine"].pixels, options.seed)
        pixelwise = pool.sha256()
        if pixelwise not in captures:
            captures[pixelwise] = [pool.photograph(number) for number in range(options.captures)]
        found = errors_deg(network, captures[pixelwise])
        first = found if first is None else first
        print(weights)
        for stage, errors, before in zip(("pixelwise", "refined"), found.T, first.T, strict=True):
            change = 100 * np.log(errors / before)
            deviation = change.std() / math.sqrt(len(change))
            print(
                f"  {stage:9} {errors.mean():.3f} deg, median {np.median(errors):.3f},"
                f" {change.mean():+.2f} % ({deviation:.2f})"
            )


if __name__ == "__main__":
    main()
