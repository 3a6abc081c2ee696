"""Compare variants of the refinement nets after equal training on the same captures.

    python benchmarks/refinement_pilots.py draw CAPTURES SET... --count 600
    python benchmarks/refinement_pilots.py draw UNSEEN SET... --count 120 --seed 1
    python benchmarks/refinement_pilots.py join PIXELWISE REFINED START
    python benchmarks/refinement_pilots.py train CAPTURES UNSEEN RUN --variant wide --start START
    python benchmarks/refinement_pilots.py report RUN...

`draw` photographs scenes and stores the features of the nets, half of the cost of training. `join`
writes the refinement nets of some weights after the pixelwise networks of others. `train` continues
the nets of the start, and writes weights. It and `draw` continue after an interruption. `report`
prints the errors on the unseen captures, and their changes relative to the nets at the start, with
the standard errors over captures.
"""

import argparse
import csv
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splinecli.estimate.networks.config import NetworkConfig
from splinecli.estimate.networks.refine_net import split_features
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.maths.normals import angle_between_deg
from splinecli.system.machine import choose_precision
from splinecli.workshop.pixel_sets.store import open_pixel_set
from splinecli.workshop.save_weights import save_weights
from splinecli.workshop.synthesis import stream_seed
from splinecli.workshop.training.config import PRESETS
from splinecli.workshop.training.loop import learning_rate, start_network
from splinecli.workshop.training.refinement import (
    SceneMaps,
    ScenePool,
    refinement_losses,
    stack_maps,
)

VARIANTS = {
    "today": {},
    "blur": {"refine_reads_blur": True},
    "wide": {"refine_widths": (48, 96, 144, 96)},
    "global": {"refine_layers": 2},
    "all": {"refine_reads_blur": True, "refine_widths": (48, 96, 144, 96), "refine_layers": 2},
}
CAPTURES_PER_STEP = 4
RATE = 2e-4
SAVE_SECONDS, VALIDATE_SECONDS = 60, 600


def draw(folder: Path, sets: Sequence[Path], count: int, seed: int, weights: str) -> None:
    """Store the captures that the folder does not have, after the pixelwise networks of some
    weights.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [number for number in range(count) if not (folder / f"{number:05}.npz").exists()]
    opened = [open_pixel_set(path) for path in sets]
    scenes = [(found, found.entries, float(len(found.entries))) for found in opened]
    network = resolve_weights(weights).network
    for number in missing:
        pool = ScenePool(scenes, network, PRESETS["refine"].pixels, seed, first=number)
        pool.add()
        new = folder / f"{number:05}.tmp.npz"
        np.savez(
            new, **{name: values.numpy() for name, values in pool.examples[0]._asdict().items()}
        )
        new.replace(folder / f"{number:05}.npz")
        print(number, flush=True)
    found = [pixelwise_error_deg(capture) for capture in load(folder)]
    print(f"{len(found)} captures, {np.mean(found):.3f} deg before refinement")


def join(pixelwise: Path, refined: str, start: Path) -> None:
    """Write weights with the pixelwise networks of some, which have an error head, and the
    refinement nets of others.
    """
    network = resolve_weights(refined).network
    parts = (resolve_weights(str(pixelwise)).network, False), (network, True)
    network.load_state_dict(
        {
            name: values
            for part, refines in parts
            for name, values in part.state_dict().items()
            if name.startswith("refine_net.") == refines
        }
    )
    save_weights(network, start)


def load(folder: Path) -> list[SceneMaps]:
    """Return the captures in a folder and its subfolders."""
    found = []
    for path in sorted(folder.rglob("*[0-9].npz")):
        with np.load(path) as stored:
            found.append(SceneMaps(*(torch.from_numpy(stored[name]) for name in SceneMaps._fields)))
    return found


def sharpness(capture: SceneMaps) -> float:
    """Return the mean difference of the normals of neighbouring pixels."""
    normals, known = capture.normals.float(), capture.normals.any(dim=0)
    both = known[:, 1:] & known[:, :-1]
    return float(normals.diff(dim=2).norm(dim=0)[both].mean()) if both.any() else 0.0


def pixelwise_error_deg(capture: SceneMaps) -> float:
    """Return the mean error of the pixelwise networks."""
    known = capture.normals.any(dim=0)
    normals = split_features(capture.features[None].float())[0][0, :, known].T.numpy()
    return float(angle_between_deg(normals, capture.normals[:, known].T.float().numpy()).mean())


@torch.no_grad()
def errors_deg(network: SplineNet, captures: Sequence[SceneMaps]) -> list[float]:
    """Return the mean error of each capture."""
    network.eval()
    return [
        math.degrees(float(refinement_losses(network, stack_maps([one])).angle)) for one in captures
    ]


def train(
    captures: Path,
    unseen: Path,
    run: Path,
    variant: str,
    start: str,
    seed: int,
    core_seconds: float,
    edge_weight: float,
) -> None:
    """Train a variant until its time on the cores is spent, with the smoother captures first."""
    config = PRESETS["refine"]
    network_config: NetworkConfig = replace(config.network, **VARIANTS[variant])
    config = replace(config, network=network_config, learning_rate=RATE, minutes=1.0)
    torch.manual_seed(0)
    network = SplineNet(network_config)
    start_network(start, network)
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name.startswith("refine_net."))
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    average: dict[str, Tensor] = {
        name: values.clone() for name, values in network.state_dict().items()
    }
    optimizer = torch.optim.AdamW(
        trained, lr=RATE, betas=(0.9, 0.99), weight_decay=config.weight_decay
    )
    step, spent = 0, 0.0
    run.mkdir(parents=True, exist_ok=True)
    checkpoint = run / "checkpoint.pt"
    if checkpoint.exists():
        stored = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(stored["network"])
        optimizer.load_state_dict(stored["optimizer"])
        average, step, spent = stored["average"], stored["step"], stored["spent"]
    training, held = load(captures), load(unseen)
    training.sort(key=sharpness)
    pool = ScenePool((), network, config.pixels, 0)
    evaluated = SplineNet(network_config)
    bfloat16 = choose_precision("auto", torch.device("cpu")) == "bfloat16"
    before = spent - time.process_time()
    saved = validated = spent

    def validate() -> None:
        evaluated.load_state_dict(average)
        found = errors_deg(evaluated, held)
        with (run / "errors.csv").open("a", newline="") as file:
            csv.writer(file).writerow([round(spent), step, *(round(error, 4) for error in found)])
        print(variant, round(spent), step, round(float(np.mean(found)), 4), flush=True)

    if not step:
        validate()
    while spent < core_seconds:
        progress = spent / core_seconds
        # A curriculum: at first the smoother half of the captures, from a third of the time on all.
        share = min(1.0, 0.5 + 1.5 * progress)
        pool.examples.clear()
        pool.examples.extend(training[: max(CAPTURES_PER_STEP, round(share * len(training)))])
        generator = torch.Generator().manual_seed(stream_seed(seed, step))
        network.train()
        maps = pool.draw(CAPTURES_PER_STEP, generator)
        losses = refinement_losses(
            network, maps, detail_weight=1.0, edge_weight=edge_weight, bfloat16=bfloat16
        )
        optimizer.zero_grad()
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(trained, config.gradient_limit)
        optimizer.param_groups[0]["lr"] = learning_rate(config, step, progress)
        optimizer.step()
        for name, values in network.state_dict().items():
            average[name].lerp_(values, 1 - config.average_decay)
        step += 1
        spent = before + time.process_time()
        if spent - saved > SAVE_SECONDS:
            saved = spent
            state = {
                "network": network.state_dict(),
                "optimizer": optimizer.state_dict(),
                "average": average,
            }
            torch.save({**state, "step": step, "spent": spent}, run / "checkpoint.tmp")
            (run / "checkpoint.tmp").replace(checkpoint)
        if spent - validated > VALIDATE_SECONDS:
            validated = spent
            validate()
    validate()
    save_weights(evaluated, run / "weights.safetensors")
    (run / "result.json").write_text(
        json.dumps({"variant": variant, "steps": step, "core_seconds": spent})
    )


def report(runs: Sequence[Path]) -> None:
    """Print the errors of the runs."""
    for run in runs:
        with (run / "errors.csv").open() as file:
            rows = [[float(value) for value in row] for row in csv.reader(file)]
        start, end = np.array(rows[0][2:]), np.array(rows[-1][2:])
        change = 100 * np.log(end / start)
        print(
            f"{run.name}: {rows[-1][0]:.0f} core-seconds, {rows[-1][1]:.0f} steps,"
            f" {start.mean():.3f} -> {end.mean():.3f} deg, {change.mean():+.2f} %"
            f" ({change.std() / math.sqrt(len(change)):.2f})"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw")
    drawing.add_argument("folder", type=Path)
    drawing.add_argument("sets", type=Path, nargs="+")
    drawing.add_argument("--count", type=int, default=600)
    drawing.add_argument("--seed", type=int, default=0)
    drawing.add_argument("--weights", default="spline-net")
    training = commands.add_parser("train")
    for name in ("captures", "unseen", "run"):
        training.add_argument(name, type=Path)
    training.add_argument("--variant", choices=VARIANTS, default="today")
    training.add_argument("--start", default="spline-net")
    training.add_argument("--seed", type=int, default=0)
    training.add_argument("--core-seconds", type=float, default=7200)
    training.add_argument("--edge-weight", type=float, default=0.0)
    joining = commands.add_parser("join")
    joining.add_argument("pixelwise", type=Path)
    joining.add_argument("refined")
    joining.add_argument("start", type=Path)
    commands.add_parser("report").add_argument("runs", type=Path, nargs="+")
    options = vars(parser.parse_args(arguments))
    torch.set_num_threads(1)
    run: Any = {"draw": draw, "join": join, "train": train, "report": report}[
        options.pop("command")
    ]
    run(**options)


if __name__ == "__main__":
    main()
