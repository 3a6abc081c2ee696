"""Fit the estimate of the lens blur to rendered captures, and print its constants for
images/lens_blur.py.

    python benchmarks/fit_lens_blur.py SET ... [--captures 1600] [--seed 41]

SET are pixel sets of scenes with neighbours, such as `splinecli prepare --random 80` makes. Each
capture is photographed through its own optics (synthesis/whole_capture.py), with noise and, in a
third of the captures, 8 bits. The wanted number is the sigma whose inverse filter brings the images
closest to those without a lens; a Bayer pattern has one, too.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn.functional import pad

from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.images import lens_blur
from splinecli.maths import Bools, Float32Array
from splinecli.workshop.pixel_sets.store import open_pixel_set
from splinecli.workshop.synthesis import draw_number, stream_seed
from splinecli.workshop.synthesis.batches import add_sensor_noise
from splinecli.workshop.synthesis.whole_capture import add_background, draw_optics
from splinecli.workshop.training import refinement
from splinecli.workshop.training.config import PRESETS

BACKGROUND_SHARE = 0.3
ENGRAVED_SHARE = 0.08
MARGIN = 8  # dark pixels around the other scenes
SIGMAS = np.arange(0, 1.26, 0.05)
EIGHT_BIT_SHARE = 0.3
PENALTY = 3.0  # of the squares of the coefficients


def photograph(
    scene: refinement.Scene, generator: torch.Generator
) -> tuple[Float32Array, Float32Array, Bools]:
    """Return images (F, H, W), 0 to 1, of a scene through a lens, the same without it, and the
    object's mask (H, W).
    """
    maps, lights, mask = scene
    if draw_number(generator) < BACKGROUND_SHARE:
        maps, mask = add_background(maps, mask, lights, generator)
    else:
        maps, mask = pad(maps * mask, (MARGIN,) * 4), pad(mask, (MARGIN,) * 4)
    images = maps[:-3]
    bright = images[:, mask].flatten().kthvalue(max(1, int(0.995 * images[:, mask].numel()))).values
    images = images / bright.clamp(min=1e-9) * 10 ** draw_number(generator, -0.5, 0)
    optics = draw_optics(generator)
    seen = optics.through_lens(images).clamp(max=1)
    seen = optics.develop(add_sensor_noise(seen.reshape(1, -1), generator).view_as(seen))
    if draw_number(generator) < EIGHT_BIT_SHARE:
        seen = (seen * 255).round() / 255
    return seen.numpy(), images.clamp(max=1).numpy(), mask.numpy()


FILTERS = [lens_blur.inverse_filter(sigma) for sigma in SIGMAS]


def wanted_sigma(seen: Float32Array, sharp: Float32Array, mask: Bools) -> float:
    """Return the sigma whose inverse filter brings images closest to sharp ones at the pixels of
    the mask.
    """
    off = np.zeros(len(SIGMAS))
    for image, true in zip(seen[:8], sharp[:8], strict=True):
        found = [
            cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in FILTERS
        ]
        off += [np.mean((each - true)[mask] ** 2) for each in found]
    best = int(off.argmin())
    if best in (0, len(SIGMAS) - 1):
        return float(SIGMAS[best])
    before, least, after = off[best - 1 : best + 2]
    return float(
        SIGMAS[best] + (SIGMAS[1] - SIGMAS[0]) * (before - after) / (before - 2 * least + after) / 2
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--captures", type=int, default=1600)
    parser.add_argument("--seed", type=int, default=41)
    options = parser.parse_args()
    sets = [(opened, opened.entries, 1.0) for opened in map(open_pixel_set, options.sets)]
    config = PRESETS["refine"]
    scenes = refinement.ScenePool(sets, SplineNet(config.network), config.pixels, options.seed)
    numbers, sigmas = [], []
    for capture in range(options.captures):
        generator = torch.Generator().manual_seed(stream_seed(options.seed, capture))
        seen, sharp, mask = photograph(scenes.draw_scene(generator, ENGRAVED_SHARE), generator)
        around = lens_blur.surroundings(mask)
        observations = np.concatenate((seen[:, mask].T, seen[:, around].T))
        found = lens_blur.edge_numbers(observations, mask, lens_blur.pixel_rows(mask, around))
        if found is not None:
            numbers.append(found)
            sigmas.append(wanted_sigma(seen, sharp, mask))
    known, wanted = np.array(numbers), np.array(sigmas)
    kept_back = np.arange(len(known)) % 4 == 0
    for part, name in (
        (~kept_back, "three quarters, checked on the others"),
        (np.ones_like(kept_back), "all"),
    ):
        means, deviations = known[part].mean(axis=0), known[part].std(axis=0)
        terms = lens_blur.polynomial(known, means, deviations)
        square = terms[part].T @ terms[part] + PENALTY * np.eye(terms.shape[1])
        coefficients = np.linalg.solve(square, terms[part].T @ wanted[part])
        off = (terms @ coefficients).clip(0, lens_blur.WIDEST_SIGMA) - wanted
        print(
            f"fitted to {name}: error {np.sqrt((off[kept_back] ** 2).mean()):.3f} pixels (root"
            " mean square)"
        )
    for name, values in (
        ("_MEANS", means),
        ("_DEVIATIONS", deviations),
        ("_COEFFICIENTS", coefficients),
    ):
        print(f"{name} = ({', '.join(f'{value:.4g}' for value in values)})")


if __name__ == "__main__":
    main()
