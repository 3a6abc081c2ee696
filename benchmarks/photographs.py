"""What splinecli does for photographs of one's own, measured on captures with ground truth.

    python benchmarks/photographs.py CAPTURE... [--draws 2] [--pixels 1500]

For each capture, under draws of ten lights (seed 0) and a seeded subset of its pixels: how far normals are off where a
fifth of the observations is overexposed; what comes of the lights' strengths when they are withheld; and whether the
confidence is what it says. The last table puts all captures together.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.capture import open_capture
from splinecli.capture.lights.draws import draw_lights
from splinecli.capture.restore.light_intensities import estimate_light_intensities
from splinecli.capture.restore.saturation import restore_saturated
from splinecli.methods.estimator import CONFIDENT_DEG
from splinecli.networks.error_head import probability_within
from splinecli.networks.spline_net import SplineNet
from splinecli.networks.weights import resolve_weights
from splinecli.normals import angle_between_deg

N_LIGHTS = 10
OVEREXPOSED = 0.2
"""Share of a draw's observations that are cut off."""


class Draw(NamedTuple):
    """Observations (P, F), lights (F, 3), their strengths (F,), and true normals (P, 3)."""

    observations: NDArray[np.float32]
    lights: NDArray[np.float64]
    strengths: NDArray[np.float64]
    normals: NDArray[np.float32]


def read_draws(folder: Path, n_draws: int, n_pixels: int) -> list[Draw]:
    source = open_capture(folder)
    capture = source.read(as_stored=True)
    assert capture.ground_truth is not None, f"{folder} has no ground truth"
    normals = capture.ground_truth[capture.mask]
    known = np.flatnonzero(normals.any(axis=1))
    rows = np.sort(np.random.default_rng(5).choice(known, min(n_pixels, len(known)), replace=False))
    strengths = source.light_intensities.mean(axis=1)
    return [
        Draw(
            capture.observations[rows][:, d],
            capture.light_directions[list(d)],
            strengths[list(d)],
            normals[rows],
        )
        for d in draw_lights(capture.light_directions, N_LIGHTS, trials=n_draws, seed=0)
    ]


@torch.inference_mode()
def estimate(
    network: SplineNet, observations: NDArray[np.float32], draw: Draw, valid: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Errors (P,) in degrees and confidences (P,)."""
    normals, error = network(
        torch.from_numpy(observations),
        torch.from_numpy(draw.lights).float(),
        None if valid is None else torch.from_numpy(valid),
    )
    assert error is not None
    return angle_between_deg(normals.numpy(), draw.normals), probability_within(error, CONFIDENT_DEG).numpy()


def overexposed(network: SplineNet, draw: Draw) -> list[float]:
    """Mean errors of the pixels concerned: properly exposed, as stored, saturated ones left out, restored."""
    limit = np.quantile(draw.observations, 1 - OVEREXPOSED)
    stored, saturated = np.minimum(draw.observations, limit), draw.observations >= limit
    restored = stored.copy()
    restore_saturated(restored, saturated, draw.lights)
    concerned = saturated.any(axis=1)
    return [
        float(errors[concerned].mean())
        for errors, _ in (
            estimate(network, draw.observations, draw),
            estimate(network, stored, draw),
            estimate(network, np.where(saturated, 0, stored), draw, ~saturated),
            estimate(network, restored, draw),
        )
    ]


def withheld(network: SplineNet, draw: Draw) -> tuple[bool, list[float]]:
    """Whether unequal strengths were found; spread of the log strengths' error in %, if equal and as found; errors."""
    raw = (draw.observations * draw.strengths).astype(np.float32)
    found = estimate_light_intensities(raw, None, draw.lights)
    used = np.ones(N_LIGHTS) if found is None else found
    spreads = [100 * float(np.std(np.log(s / draw.strengths))) for s in (np.ones(N_LIGHTS), used)]
    errors = [
        estimate(network, o, draw)[0].mean()
        for o in (draw.observations, raw, (raw / used).astype(np.float32))
    ]
    return found is not None, [*spreads, *(float(error) for error in errors)]


def share_found(confidence: NDArray[np.float32], errors_deg: NDArray[np.float64]) -> float:
    """Of the largest tenth of the errors, the share in the tenth of the pixels with the least confidence."""
    large = errors_deg > np.quantile(errors_deg, 0.9)
    return float(large[confidence <= np.quantile(confidence, 0.1)].sum() / large.sum())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--pixels", type=int, default=1500)
    args = parser.parse_args()
    network = resolve_weights("spline-net").network
    captures = {folder.name: read_draws(folder, args.draws, args.pixels) for folder in args.captures}

    print("overexposed: MAE of the pixels concerned      exposed well   as stored     left out     restored")
    for name, draws in captures.items():
        means = np.mean([overexposed(network, draw) for draw in draws], axis=0)
        print(f"{name:44} " + " ".join(f"{mean:12.2f}" for mean in means))

    print("\nstrengths withheld: found   % off: if equal, as found    MAE: given, if equal, as found")
    for name, draws in captures.items():
        results = [withheld(network, draw) for draw in draws]
        means = np.mean([numbers for _, numbers in results], axis=0)
        told = sum(found for found, _ in results)
        print(f"{name:18} {told:3} of {len(draws):3}" + " ".join(f"{mean:10.2f}" for mean in means))

    print("\nconfidence: share under 5 degrees expected, found; share of the large errors in the worst tenth")
    everything: list[tuple[NDArray[np.float64], NDArray[np.float32]]] = []
    for name, draws in captures.items():
        errors, confidence = map(
            np.concatenate, zip(*(estimate(network, d.observations, d) for d in draws), strict=True)
        )
        everything.append((errors, confidence))
        print_confidence(name, errors, confidence)
    print_confidence("all", *map(np.concatenate, zip(*everything, strict=True)))


def print_confidence(name: str, errors: NDArray[np.float64], confidence: NDArray[np.float32]) -> None:
    found = (errors <= CONFIDENT_DEG).mean()
    print(f"{name:18} {confidence.mean():6.2f} {found:6.2f} {share_found(confidence, errors):6.2f}")


if __name__ == "__main__":
    main()
