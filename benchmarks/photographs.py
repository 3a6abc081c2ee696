"""Measure how splinecli handles overexposure and unknown light intensities.

    python benchmarks/photographs.py CAPTURE... [--draws 2] [--pixels 1500]

The captures need ground truth. Each is measured under draws of ten lights (seed 0) on a random
subset of its pixels:

1. the errors of overexposed pixels, if a fifth of the observations is cut off;
2. the estimated light intensities, if the measured ones are withheld.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.capture import open_capture
from splinecli.estimate.networks.set_branch import sample_of
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.images.lamps import estimate_light_intensities
from splinecli.images.saturation import restore_saturated
from splinecli.lights.draws import draw_lights
from splinecli.maths.normals import angle_between_deg
from splinecli.recipe import RecipeOptions, prepare_capture

N_LIGHTS = 10
OVEREXPOSED = 0.2
"""Share of the observations of a draw that is cut off."""


class Draw(NamedTuple):
    """Observations (P, F), light directions (F, 3) and intensities (F,), and true normals (P,
    3).
    """

    observations: NDArray[np.float32]
    lights: NDArray[np.float64]
    intensities: NDArray[np.float64]
    normals: NDArray[np.float32]


def read_draws(folder: Path, n_draws: int, n_pixels: int) -> list[Draw]:
    source = open_capture(folder)
    capture = prepare_capture(source, options=RecipeOptions(as_stored=True))
    assert capture.ground_truth is not None, f"{folder} has no ground truth"
    normals = capture.ground_truth[capture.mask]
    known = np.flatnonzero(normals.any(axis=1))
    rows = np.sort(np.random.default_rng(5).choice(known, min(n_pixels, len(known)), replace=False))
    intensities = source.light_intensities.mean(axis=1)
    return [
        Draw(
            capture.observations[rows][:, d],
            capture.light_directions[list(d)],
            intensities[list(d)],
            normals[rows],
        )
        for d in draw_lights(capture.light_directions, N_LIGHTS, trials=n_draws, seed=0)
    ]


@torch.inference_mode()
def estimate(
    network: SplineNet,
    observations: NDArray[np.float32],
    draw: Draw,
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Return the errors (P,) in degrees."""
    seen, lights = torch.from_numpy(observations), torch.from_numpy(draw.lights).float()
    context = network.encode_context(seen[sample_of(observations)], lights)
    normals, _ = network(
        seen, lights, None if valid is None else torch.from_numpy(valid), context=context
    )
    return angle_between_deg(normals.numpy(), draw.normals)


def overexposed(network: SplineNet, draw: Draw) -> list[float]:
    """Return mean errors of the pixels cut off: well exposed, as stored, without the saturated
    values, restored.
    """
    limit = np.quantile(draw.observations, 1 - OVEREXPOSED)
    stored, saturated = np.minimum(draw.observations, limit), draw.observations >= limit
    restored = stored.copy()
    restore_saturated(restored, saturated, draw.lights)
    affected = saturated.any(axis=1)
    return [
        float(errors[affected].mean())
        for errors in (
            estimate(network, draw.observations, draw),
            estimate(network, stored, draw),
            estimate(network, np.where(saturated, 0, stored), draw, ~saturated),
            estimate(network, restored, draw),
        )
    ]


def without_intensities(network: SplineNet, draw: Draw) -> tuple[bool, list[float]]:
    """Return whether intensities were estimated, the errors of the intensities, and those of the
    normals.

    The errors of the intensities are standard deviations of the logarithm in %: of equal ones and
    of the estimated ones. Those of the normals are for the measured, equal and estimated
    intensities.
    """
    raw = (draw.observations * draw.intensities).astype(np.float32)
    estimated = estimate_light_intensities(raw, None, draw.lights)
    used = np.ones(N_LIGHTS) if estimated is None else estimated
    spreads = [100 * float(np.std(np.log(s / draw.intensities))) for s in (np.ones(N_LIGHTS), used)]
    errors = [
        estimate(network, o, draw).mean()
        for o in (draw.observations, raw, (raw / used).astype(np.float32))
    ]
    return estimated is not None, [*spreads, *(float(error) for error in errors)]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--pixels", type=int, default=1500)
    args = parser.parse_args(arguments)
    network = resolve_weights("spline-net").network
    captures = {
        folder.name: read_draws(folder, args.draws, args.pixels) for folder in args.captures
    }

    print(
        "overexposed: MAE of the pixels cut off       well exposed    as stored     left out    "
        " restored"
    )
    for name, draws in captures.items():
        means = np.mean([overexposed(network, draw) for draw in draws], axis=0)
        print(f"{name:44} " + " ".join(f"{mean:12.2f}" for mean in means))

    print(
        "\nintensities unknown: estimated   % off: equal, estimated   MAE: measured, equal,"
        " estimated"
    )
    for name, draws in captures.items():
        results = [without_intensities(network, draw) for draw in draws]
        means = np.mean([numbers for _, numbers in results], axis=0)
        estimated = sum(is_estimated for is_estimated, _ in results)
        print(
            f"{name:18} {estimated:3} of {len(draws):3}"
            + " ".join(f"{mean:10.2f}" for mean in means)
        )


if __name__ == "__main__":
    main()
