"""How accurate lights are that are estimated from the images, on rendered scenes.

    python benchmarks/unknown_lights.py SET... [--captures 120] [--lights 10]

SET is a pixel set that the light network was not trained on, such as unseen-groups of
render_training_scenes.sh. The captures have the faults of training captures, except errors of the
lights; in every second one, the intensities are unknown. Prints, by kind of shape: the share that
is answered; of these, the mean and median error of the lights in degrees, and the share that is
closer to the lights with x and y negated; and the mean error of the others if an answer is
enforced. Then prints the expected errors.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from splinecli.errors import InputError
from splinecli.estimate.light_descent import best_lights
from splinecli.lights.least_curl import OPPOSITE
from splinecli.lights.unknown_lights import find_lights
from splinecli.maths.normals import angle_between_deg
from splinecli.workshop.pixel_sets.store import Entry, PixelSet, open_pixel_set
from splinecli.workshop.synthesis.batches import CaptureConfig
from splinecli.workshop.synthesis.lights import choose_in_cone
from splinecli.workshop.synthesis.whole_capture import photograph_scene


class Row(NamedTuple):
    """Errors in degrees; inverted: whether the opposite lights are closer to the true ones."""

    answered: bool
    error: float
    inverted: bool
    expected: float


def judge(pixel_set: PixelSet, entry: Entry, count: int, generator: torch.Generator) -> Row:
    """Photograph a scene under `count` lights, and estimate them."""
    pixels, is_known = pixel_set.load(entry), generator.initial_seed() % 2 == 0
    lights = torch.from_numpy(np.array(pixels.light_directions))
    chosen = choose_in_cone(lights, count, generator)
    radiance = torch.from_numpy(pixels.observations[:, chosen.numpy()].astype(np.float32))
    if not is_known:
        radiance = radiance * (0.25 * torch.randn(count, generator=generator)).exp()
    config = CaptureConfig(light_direction_error_share=0, light_intensity_error_share=0)
    images = photograph_scene(radiance, lights[chosen], config, generator).observations.numpy()
    mask, true, answered = np.array(pixels.mask), lights[chosen].double().numpy(), True
    try:
        found = find_lights(images, mask, is_known, best_lights)
    except InputError:
        found, answered = find_lights(images, mask, is_known, best_lights, refuse=False), False
    error, opposite = (
        float(angle_between_deg(found.directions * sign, true).mean()) for sign in (1.0, OPPOSITE)
    )
    return Row(answered, error, opposite < error, float(found.errors_deg.mean()))


def report(rows: dict[str, list[Row]]) -> None:
    """Print the tables."""
    rows = rows | {"all": [row for each in rows.values() for row in each]}
    print(
        "| shape | captures | answered | mean | median | inverted | others, mean |"
        "\n|---|---:|---:|---:|---:|---:|---:|"
    )
    for shape, each in rows.items():
        answered, errors, inverted, expected = np.array(each).T
        kept = answered > 0
        cells = [f"{len(each)}", f"{kept.mean():.0%}", "-", "-", "-", "-"]
        if kept.any():
            cells[2] = f"{errors[kept].mean():.1f}"
            cells[3] = f"{np.median(errors[kept]):.1f}"
            cells[4] = f"{inverted[kept].mean():.0%}"
        if not kept.all():
            cells[5] = f"{errors[~kept].mean():.1f}"
        print(f"| {shape} | {' | '.join(cells)} |")
    ratio = np.abs(np.log(errors[kept] / expected[kept]))
    shares = ", ".join(f"{np.mean(ratio < np.log(most)):.0%} of {most}" for most in (1.6, 2, 3))
    factor = (errors[kept] / expected[kept]).mean()  # most likely one if errors are exponential
    print(
        f"mean expected error {expected[kept].mean():.1f} (best fit: times {factor:.2f});"
        f" within a factor: {shares}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--captures", type=int, default=120)
    parser.add_argument("--lights", type=int, default=10)
    options = parser.parse_args(arguments)
    scenes = [
        (found, entry) for found in map(open_pixel_set, options.sets) for entry in found.entries
    ]
    rows: dict[str, list[Row]] = {}
    order = np.random.default_rng(0).permutation(len(scenes))[: options.captures]
    for number, (pixel_set, entry) in enumerate(scenes[place] for place in order):
        generator = torch.Generator().manual_seed(number)
        row = judge(pixel_set, entry, options.lights, generator)
        rows.setdefault(entry.source.removeprefix("rendered: "), []).append(row)
        print(number, entry.name, *row, flush=True)
    report(rows)


if __name__ == "__main__":
    main()
