"""Render scenes for the light network and train it: how assets/light-net.safetensors was made.

    python benchmarks/train_light_net.py render FOLDER --scenes 2400
    python benchmarks/train_light_net.py train FOLDER --minutes 85 -o light-net.safetensors

Both go on after an interruption. The shipped weights saw 1,880 scenes in three classes of materials
each, in two legs of 22,000 and 11,000 steps: about 300,000 captures. The second leg began from the
first with a rate of 0.0012, and had twice the scenes. These scenes had no groups and few hollows,
and the captures up to 100 lights.
"""

import argparse
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import DataLoader, IterableDataset

from splinecli.lights.light_net import LIGHT_FORMAT, LightNet, network_inputs, square_images
from splinecli.workshop.save_weights import save_module
from splinecli.workshop.synthesis import draw_number, groups, shapes
from splinecli.workshop.synthesis.draw_materials import CLASSES
from splinecli.workshop.synthesis.lights import choose_in_cone, draw_light_directions
from splinecli.workshop.synthesis.meshes import (
    Mesh,
    ellipsoid,
    fit_to_frame,
    smooth_union,
    triangulate,
)
from splinecli.workshop.synthesis.scenes import SceneConfig, draw_scene, render_scene
from splinecli.workshop.synthesis.whole_capture import add_background

CONFIG = SceneConfig(size=72, lights=64, samples=2, directions=24, bounces=2)
SPACING, FEWEST_FACES = 0.025, 1500  # coarser than other scenes: the network sees 48 pixels
# Shares of smooth shapes, and of bowls, niches and bodies beside each other; the others are random
# shapes.
SMOOTH_SHARE, GROUP_SHARE = 0.35, 0.35
HELD_SHARE = 0.04
IMAGES_PER_STEP, MOST_CAPTURES = 96, 16
RATE = 2e-3


def render(folder: Path, scenes: int, seed: int = 1) -> None:
    """Render scenes that the folder does not have: random shapes, smooth ones, and groups."""
    shapes.SPACING, shapes.FEWEST_FACES = SPACING, FEWEST_FACES
    groups.SPACING, groups.FEWEST_FACES = 0.04, 500
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(scenes):
        path = folder / f"{index:05d}.npz"
        if path.exists():
            continue
        rng = np.random.default_rng([seed, index, 77])
        kind, mesh = rng.random(), None
        if kind < SMOOTH_SHARE:
            mesh = draw_smooth(rng)
        elif kind < SMOOTH_SHARE + GROUP_SHARE:
            _, mesh = groups.draw_group(rng, (), rng.random())
        scene = draw_scene(seed, index, CONFIG, mesh)
        done = render_scene(scene, CONFIG)
        observations = {
            name: values.astype(np.float16) for name, values in done.observations.items()
        }
        new = path.with_suffix(".tmp.npz")
        np.savez(
            new,
            mask=done.mask,
            lights=scene.lights,
            normals=done.normals.astype(np.float16),
            **observations,
        )
        new.replace(path)
        print(path, flush=True)


def draw_smooth(rng: np.random.Generator) -> Mesh:
    """Draw a sphere, an ellipsoid, or a union of up to five ellipsoids."""
    count = 1 if rng.random() < 0.4 else int(rng.integers(2, 6))
    if count == 1 and rng.random() < 0.5:
        solids = [ellipsoid(np.full(3, 0.6, np.float32))]
    else:
        radii = [rng.uniform(0.25, 0.6) * rng.uniform(0.5, 1.3, 3) for _ in range(count)]
        solids = [
            shapes.place_solid(ellipsoid(radius.astype(np.float32)), rng, (0.0, 0.45))
            for radius in radii
        ]
    blend = rng.uniform(0.03, 0.3)

    def distance(points: np.ndarray) -> np.ndarray:
        found = solids[0](points)
        for solid in solids[1:]:
            found = smooth_union(found, solid(points), blend)
        return found

    mesh = triangulate(distance, (1.25, 1.25, 1.25), 0.02)
    assert mesh is not None
    return fit_to_frame(shapes.turn(mesh, shapes.draw_rotation(rng)))


class Captures(IterableDataset):
    """Endless batches of captures: inputs (B, F, C, S, S), directions (B, F, 3), log intensities
    (B, F), bumps (B,).
    """

    def __init__(self, folder: Path, first: int, *, held: bool) -> None:
        files = sorted(folder.glob("*[0-9].npz"))
        n_held = max(1, round(HELD_SHARE * len(files)))
        self.files = files[:n_held] if held else files[n_held:]
        self.first, self.held = first, held

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        torch.set_num_threads(1)
        step = self.first
        while True:
            generator = torch.Generator().manual_seed(1_000_003 * (1 + self.held) + step)
            lights = int(4 * (31 / 4) ** draw_number(generator))
            captures: list[tuple[Tensor, ...]] = []
            while len(captures) < max(2, min(MOST_CAPTURES, IMAGES_PER_STEP // lights)):
                file = self.files[int(torch.randint(len(self.files), (), generator=generator))]
                captures += photograph(file, lights, generator)
            yield tuple(torch.stack(part) for part in zip(*captures, strict=True))
            step += 1


def bump_of(normals: Tensor, mask: Tensor) -> Tensor:
    """Return how much of a bump the normals (3, H, W) in a mask (H, W) show: 1 for a sphere, -1 for
    a bowl.
    """
    rows, columns = mask.nonzero().T.float()
    across = torch.stack((columns - columns.mean(), rows.mean() - rows))
    slopes = normals[:2, mask]
    return (slopes * across).sum() / (slopes.norm(dim=0) * across.norm(dim=0)).sum().clamp(min=1e-6)


def photograph(file: Path, count: int, generator: torch.Generator) -> list[tuple[Tensor, ...]]:
    """Photograph a scene under `count` lights, with the faults of a capture; an empty list where
    too little is seen.

    30 % of the captures show a part of the object, 25 % its background; 60 % have intensities that
    nobody measured.
    """

    def uniform(low: float = 0.0, high: float = 1.0) -> float:
        return draw_number(generator, low, high)

    with np.load(file) as scene:
        lights, mask = torch.from_numpy(scene["lights"]).float(), torch.from_numpy(scene["mask"])
        chosen = choose(lights, count, generator)
        lights = lights[chosen]
        images, normals = torch.zeros(count, *mask.shape), torch.zeros(3, *mask.shape)
        images[:, mask] = (
            torch.from_numpy(scene[list(CLASSES)[int(3 * uniform())]][:, chosen.numpy()]).float().T
        )
        normals[:, mask] = torch.from_numpy(scene["normals"]).float().T
    if uniform() < 0.3:
        side = int(min(mask.shape) * uniform(0.35, 0.8))
        top, left = (int(uniform(0, size - side)) for size in mask.shape)
        part = slice(top, top + side), slice(left, left + side)
        images, normals, mask = images[:, *part], normals[:, *part], mask[part]
    if mask.sum() < 150:
        return []
    bump = bump_of(normals, mask)
    if uniform() < 0.25:
        maps, mask = add_background(torch.cat((images, normals)), mask, lights, generator)
        images = maps[:count]
    images, inside = square_images(images, mask)
    if inside.sum() < 100:
        return []
    turns = int(4 * uniform())
    images, inside = torch.rot90(images, turns, (1, 2)), torch.rot90(inside, turns, (0, 1))
    x, y, z = lights.T
    for _ in range(turns):
        x, y = -y, x
    if uniform() < 0.5:
        images, inside, x = images.flip(2), inside.flip(1), -x
    sigma = 0.0 if uniform() < 0.4 else uniform(0, 0.5) * math.log(2)
    intensities = sigma * torch.randn(count, generator=generator)
    images = images * intensities.exp()[:, None, None]
    brightest = (
        images[:, inside > 0].flatten().quantile(1 - 10 ** uniform(-3.5, -1.5)).clamp(min=1e-6)
    )
    images = (images / brightest * uniform(0.4, 1)).clamp(max=1)
    noise = (
        10 ** uniform(-3.5, -1.8) * inside + 10 ** uniform(-3.5, -2) * images.clamp(min=0).sqrt()
    )
    images = (images + noise * torch.randn(images.shape, generator=generator)).clamp(min=0)
    if uniform() < 0.15:  # light that is always there
        images = images + uniform(0, 0.03) * images[:, inside > 0].mean() * inside
    if uniform() < 0.1:  # an unknown curve
        images = images ** uniform(0.8, 1.2)
    directions = torch.stack((x, y, z), dim=1)
    return [
        (network_inputs(images, inside).half(), directions, intensities - intensities.mean(), bump)
    ]


def choose(lights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Choose lights (F, 3) within a cone, or those next to the lights of a rig; return their
    indices.
    """
    if draw_number(generator) < 0.5:
        chosen = choose_in_cone(lights, count, generator)
        return chosen[torch.randperm(count, generator=generator)]
    nearness = draw_light_directions(1, count, generator)[0] @ lights.T
    chosen = torch.zeros(count, dtype=torch.long)
    for light in range(count):
        chosen[light] = nearness[light].argmax()
        nearness[:, chosen[light]] = -2
    return chosen


def losses(
    network: LightNet, images: Tensor, directions: Tensor, intensities: Tensor, bump: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the negative log likelihood of the directions, their mean angle in radians, the error
    of the logs, and the cross entropy of bumps and hollows, of which those in between count for
    both.
    """
    guess = network(images.float())
    cosine = (guess.directions * directions).sum(dim=-1)
    sharpness = guess.sharpness.exp()
    likelihood = (
        sharpness * (1 - cosine) - guess.sharpness + torch.log1p(-torch.exp(-2 * sharpness))
    )
    angle = cosine.clamp(-0.99999, 0.99999).acos()
    side = binary_cross_entropy_with_logits(guess.bump, (0.5 + 2 * bump).clamp(0, 1))
    return likelihood.mean(), angle.mean(), (guess.log_intensities - intensities).abs().mean(), side


def train(folder: Path, minutes: float, output: Path) -> None:
    """Train for so many minutes, and write the running average of the weights."""
    network, average = LightNet().to(memory_format=torch.channels_last), LightNet()
    optimiser = torch.optim.AdamW(
        network.parameters(), RATE, betas=(0.9, 0.99), weight_decay=1e-3, fused=True
    )
    checkpoint, step = output.with_suffix(".checkpoint"), 0
    average.load_state_dict(network.state_dict())
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        for part, name in ((network, "network"), (average, "average"), (optimiser, "optimiser")):
            part.load_state_dict(state[name])
        step = state["step"]
    batches = iter(
        DataLoader(
            Captures(folder, step, held=False), batch_size=None, num_workers=1, prefetch_factor=6
        )
    )
    begin = time.time()
    while (done := (time.time() - begin) / 60 / minutes) < 1:
        rate = RATE * min(1, (step + 1) / 100) * (1 + math.cos(math.pi * done)) / 2 + 1e-6
        for group in optimiser.param_groups:
            group["lr"] = rate
        likelihood, angle, intensity, side = losses(network, *next(batches))
        optimiser.zero_grad()
        (likelihood + 3 * angle + 0.3 * intensity + 0.3 * side).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        step += 1
        with torch.no_grad():
            kept = min(0.999, (step + 1) / (step + 10))
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - kept)
        if step % 1000 == 0:
            state = {"network": network.state_dict(), "average": average.state_dict()}
            torch.save({**state, "optimiser": optimiser.state_dict(), "step": step}, checkpoint)
            print(step, f"{validate(average, folder):.2f} degrees on held scenes", flush=True)
    save_module(average, output, {"format": LIGHT_FORMAT})
    print(step, f"{validate(average, folder):.2f} degrees on held scenes, {output}")


@torch.inference_mode()
def validate(network: LightNet, folder: Path, batches: int = 40) -> float:
    """Return the mean error of the directions in degrees on captures of held scenes."""
    held = iter(Captures(folder, 0, held=True))
    return math.degrees(
        sum(float(losses(network, *next(held))[1]) for _ in range(batches)) / batches
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=("render", "train"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=960)
    parser.add_argument("--minutes", type=float, default=85)
    parser.add_argument("-o", "--output", type=Path, default=Path("light-net.safetensors"))
    given = parser.parse_args()
    if given.step == "render":
        render(given.folder, given.scenes)
    else:
        train(given.folder, given.minutes, given.output)
