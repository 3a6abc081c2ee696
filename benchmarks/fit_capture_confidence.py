"""Fit the correction of the confidence by the capture as a whole, and say what it changes.

    python benchmarks/fit_capture_confidence.py FOLDER [--write | --shipped]

FOLDER is that of benchmarks/faulty_captures.py. Prints, by kind of capture: the share of normals
within 5 degrees that is claimed before and after the correction, and the true one; the mean
differences of a capture's claim from its truth; and the share of the worst tenth that the least
confident tenth holds, before and after. Scenes were not seen by the fit that they are judged with.
--write fits to all scenes, and puts the result into the package. --shipped judges the correction
that is in the package.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.estimate.confidence import capture_features
from splinecli.estimate.methods.estimator import CONFIDENT_DEG
from splinecli.estimate.networks.li_ne_net import CaptureHead, probability_within
from splinecli.estimate.networks.weights import HEAD_FORMAT, capture_head, manifest
from splinecli.lights.lighting import PixelIndices, PixelLighting, PixelPlaces
from splinecli.system.files import file_sha256
from splinecli.system.weight_files import SHIPPED, tensors_sha256
from splinecli.workshop.save_weights import serialise
from splinecli.workshop.training.objective import error_negative_log_likelihood

Floats = NDArray[np.floating]

PIXELS, STEPS = 80, 500
HEADS, HIDDEN = 8, 6
"""The mean of so many heads, of so many hidden units each, is one head of all their units."""

FEATURE_NOISE = 0.2
"""Standard deviation of the noise on the features of captures in the fit, in their spread. It keeps
the fit smooth.
"""

WEIGHTS = {"right": 2.0, "near lamps": 2.0}
"""Weights of captures in the fit, otherwise 1. Most captures are right; scenes of pixel sets have
no near lamps.
"""


class Example(NamedTuple):
    """What the fit needs of some pixels of an estimated capture: see CaptureHead.forward.
    errors_deg: true.
    """

    kind: str
    scene: int
    errors: Tensor
    pixels: Tensor
    capture: Tensor
    errors_deg: Tensor


def read_examples(folder: Path) -> Iterator[Example]:
    """Yield each capture of a folder twice: with and without refinement."""
    for path in sorted(folder.glob("*.npz")):
        found = dict(np.load(path))
        observations, directions, mask = found["observations"], found["directions"], found["mask"]
        rng = np.random.default_rng(0)
        lit = np.flatnonzero(observations.max(axis=1) > 0)
        rows = rng.choice(lit, min(len(lit), PIXELS), replace=False)

        def lighting_at(
            rows: PixelIndices, seen: Floats = observations, lights: Floats = directions
        ) -> PixelLighting:
            return PixelLighting(seen[rows], lights if lights.ndim == 2 else lights[rows])

        for name in ("", "pixelwise_"):
            normals, errors = found[f"{name}normals"], found[f"{name}errors"]
            features = capture_features(mask, lighting_at, normals, errors, found["lights"])
            if features is None:
                continue
            places = PixelPlaces(mask).places(rows)
            pixels = features[1].features(observations[rows].mean(axis=1), normals[rows], *places)
            yield Example(
                f"{found['kind']}{', pixelwise' if name else ''}",
                int(found["scene"]),
                torch.from_numpy(errors[rows]),
                torch.from_numpy(pixels).float(),
                torch.tensor(features[0]).float(),
                torch.from_numpy(found[f"{name}error_deg"][rows]),
            )


def fit_head(examples: Sequence[Example]) -> CaptureHead:
    """Fit some heads, and return their mean."""
    heads = [fit_one(examples, seed) for seed in range(HEADS)]
    mean = CaptureHead(HEADS * HIDDEN).requires_grad_(False)
    for name, target in mean.state_dict().items():
        values = [head.state_dict()[name] for head in heads]
        if name == "last.weight":
            target.copy_(torch.cat(values, dim=1) / HEADS)
        elif name.startswith("hidden."):
            target.copy_(torch.cat(values))
        else:
            target.copy_(torch.stack(values).mean(dim=0))
    return mean


def fit_one(examples: Sequence[Example], seed: int) -> CaptureHead:
    """Fit by maximum likelihood of the errors, and of being within CONFIDENT_DEG."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    head = CaptureHead(HIDDEN)
    number = torch.cat([torch.full((len(e.errors),), place) for place, e in enumerate(examples)])
    errors, pixels, errors_deg = (
        torch.cat([getattr(e, name) for e in examples])
        for name in ("errors", "pixels", "errors_deg")
    )
    captures = torch.stack([e.capture for e in examples])
    weights = torch.tensor([WEIGHTS.get(e.kind.partition(",")[0], 1.0) for e in examples])[number]
    inputs = torch.cat((errors, pixels, captures[number]), dim=1).numpy()
    known = np.ma.masked_invalid(inputs)  # a feature may be unknown in all captures
    head.mean.copy_(torch.from_numpy(known.mean(axis=0).filled(0)))
    head.spread.copy_(torch.from_numpy(known.std(axis=0).filled(0) + 1e-3))
    blur = FEATURE_NOISE * head.spread[-captures.shape[1] :]
    optimiser = torch.optim.AdamW(head.parameters(), lr=1e-2, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2, total_steps=STEPS + 1)
    for _ in range(STEPS):
        chosen = (torch.rand(len(examples), generator=generator) < 0.5)[number]
        noisy = captures + blur * torch.randn(captures.shape, generator=generator)
        found = head(errors[chosen], pixels[chosen], noisy[number[chosen]])
        loss = error_negative_log_likelihood(found, errors_deg[chosen].deg2rad())
        within = probability_within(found, CONFIDENT_DEG).clamp(1e-4, 1 - 1e-4)
        true = (errors_deg[chosen] <= CONFIDENT_DEG).float()
        loss = loss + 0.5 * torch.nn.functional.binary_cross_entropy(within, true, reduction="none")
        optimiser.zero_grad()
        (loss * weights[chosen]).mean().backward()
        optimiser.step()
        schedule.step()
    return head.requires_grad_(False)


def print_table(examples: Sequence[Example], shipped: CaptureHead | None) -> None:
    """Print what is claimed of scenes that the fit did not see, as five fits to four fifths of them
    give it, or the shipped one.
    """
    rows: dict[str, list[list[float]]] = {}
    for fold in range(5):
        head = shipped or fit_head([e for e in examples if e.scene % 5 != fold])
        for e in (e for e in examples if e.scene % 5 == fold):
            claims = [e.errors, head(e.errors, e.pixels, e.capture)]
            before, after = (
                probability_within(claim, CONFIDENT_DEG).detach().numpy() for claim in claims
            )
            true = float((e.errors_deg <= CONFIDENT_DEG).float().mean())
            worst = np.argsort(-e.errors_deg.numpy())[: len(before) // 10]
            ranks = [
                float(np.isin(worst, np.argsort(claim)[: len(worst)]).mean())
                for claim in (before, after)
            ]
            rows.setdefault(e.kind, []).append(
                [float(before.mean()), float(after.mean()), true, *ranks]
            )
    print(
        "| capture | number | claimed before | after | true | off before | after | worst tenth"
        " before | after |"
    )
    print("|---|" + "---:|" * 8)
    for kind, found in sorted(rows.items()):
        before, after, true, *ranks = np.array(found).T
        columns = [before, after, true, np.abs(before - true), np.abs(after - true), *ranks]
        print(
            f"| {kind} | {len(found)} |"
            + "".join(f" {100 * column.mean():.0f} % |" for column in columns)
        )


def write_head(head: CaptureHead) -> None:
    tensors = {name: tensor.clone() for name, tensor in head.state_dict().items()}
    metadata = {"format": HEAD_FORMAT, "tensors_sha256": tensors_sha256(tensors)}
    path = Path(str(SHIPPED)) / "capture-head.safetensors"
    path.write_bytes(serialise(tensors, metadata))
    entries = manifest()
    entries["spline-net"]["capture_head"] = {"file": path.name, "sha256": file_sha256(path)}
    path.with_name("weights.json").write_text(json.dumps(entries, indent=2) + "\n", "utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    task = parser.add_mutually_exclusive_group()
    task.add_argument("--write", action="store_true")
    task.add_argument("--shipped", action="store_true")
    options = parser.parse_args(arguments)
    examples = list(read_examples(options.folder))
    own = capture_head(manifest()["spline-net"]["sha256"]) if options.shipped else None
    print_table(examples, own)
    if options.write:
        write_head(fit_head(examples))


if __name__ == "__main__":
    main()
