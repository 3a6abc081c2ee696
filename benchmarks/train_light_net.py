"""Render small scenes for the light network, and train it on them and on other pixel sets.

    python benchmarks/train_light_net.py draw SET SHAPES RELIEF [--scenes 300] [--seed 0]
    python benchmarks/train_light_net.py train SET... [--steps 60000] [--start-from NET] [-o NET]

SHAPES and RELIEF are the folders of examples/render_training_scenes.sh. Both continue after an
interruption. A scene takes one or two seconds on one core.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import DataLoader, IterableDataset

from splinecli.lights.light_net import LIGHT_FORMAT, LightNet, network_inputs, square_images
from splinecli.system.machine import choose_precision
from splinecli.workshop.pixel_sets.store import Entry, Pixels, PixelSet, PixelSetWriter
from splinecli.workshop.save_weights import save_module
from splinecli.workshop.synthesis import draw_number, shapes, stream_seed
from splinecli.workshop.synthesis.draw_materials import CLASSES
from splinecli.workshop.synthesis.groups import draw_group
from splinecli.workshop.synthesis.lights import choose_in_cone, draw_light_directions
from splinecli.workshop.synthesis.meshes import (
    Mesh,
    ellipsoid,
    fit_to_frame,
    read_mesh,
    smooth_union,
    triangulate,
)
from splinecli.workshop.synthesis.scenes import Scene, SceneConfig, draw_scene, render_scene
from splinecli.workshop.synthesis.shapes import draw_view
from splinecli.workshop.synthesis.whole_capture import add_background
from splinecli.workshop.training.config import PRESETS
from splinecli.workshop.training.tasks import open_sets

HELD_SHARE = 0.04
IMAGES_PER_STEP, MOST_CAPTURES = 96, 16
RATE = 1e-3
RENDERING = SceneConfig(
    size=72, lights=64, samples=2, directions=16, bounces=2, perspective_share=0.2
)
KINDS = tuple(CLASSES)
KEPT_BACK = "bust-wreath", "maria"  # the statues in docs/robustness.md
Scenes = Sequence[tuple[PixelSet, Entry]]


def draw(output: Path, meshes: Path, reliefs: Path, scenes: int, seed: int) -> None:
    """Render the scenes that a set does not have, each in a set of materials of each class."""
    writer, recipe = PixelSetWriter(output), asdict(RENDERING) | {"seed": seed}
    for index in range(scenes):
        name = f"scene{index:04}"
        if f"{name}-{KINDS[-1]}" in writer:
            continue
        shape, scene = draw_small_scene(seed, index, meshes, reliefs)
        rendered = render_scene(scene, RENDERING)
        if not rendered.mask.any():
            continue
        source = f"rendered: {shape}"
        for kind, observations in rendered.observations.items():
            parts = observations.astype(np.float16), rendered.normals, scene.lights, rendered.mask
            writer.add(f"{name}-{kind}", name, source, recipe, Pixels(*parts))
        print(name, source, flush=True)
    writer.finish()


def draw_small_scene(seed: int, index: int, meshes: Path, reliefs: Path) -> tuple[str, Scene]:
    """Draw scene number `index` of the set with this seed, and return the kind of its shape, too.

    40 % are groups of bodies, 15 % views of the meshes, 20 % random shapes, and 25 % smooth shapes
    (see draw_smooth).
    """
    files = [path for path in sorted(meshes.glob("*.ply")) if path.stem not in KEPT_BACK]
    maps = sorted(reliefs.glob("*.jpg"))
    if not files or not maps:
        raise SystemExit(f"expected meshes (.ply) in {meshes} and normal maps (.jpg) in {reliefs}")
    rng = np.random.default_rng([seed, index, 78])
    number, shape, mesh = rng.random(), "", None
    if number < 0.4:
        shape, mesh = draw_group(rng, files, rng.random())
    elif number < 0.55:
        place = int(rng.integers(len(files)))
        others = files[:place] + files[place + 1 :]
        shape, mesh = "view", draw_view(read_mesh(files[place]), others, rng)
    elif number < 0.8:
        shape, mesh = "smooth", draw_smooth(rng)
    scene = draw_scene(seed, index, RENDERING, mesh, maps)
    materials = {kind: scene.materials[kind] for kind in KINDS}
    return shape or scene.shape, replace(scene, materials=materials)


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
    (B, F), bumps (B,). Batch `first` is the first one.
    """

    def __init__(self, scenes: Scenes, seed: int, first: int = 0) -> None:
        self.scenes, self.seed, self.first = scenes, seed, first

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        torch.set_num_threads(1)
        step = self.first
        while True:
            generator = torch.Generator().manual_seed(stream_seed(self.seed, step))
            lights = int(4 * (31 / 4) ** draw_number(generator))
            captures: list[tuple[Tensor, ...]] = []
            while len(captures) < max(2, min(MOST_CAPTURES, IMAGES_PER_STEP // lights)):
                scene = self.scenes[int(torch.randint(len(self.scenes), (), generator=generator))]
                captures += photograph(*scene, lights, generator)
            yield tuple(torch.stack(part) for part in zip(*captures, strict=True))
            step += 1


def bump_of(normals: Tensor, mask: Tensor) -> Tensor:
    """Return how much of a bump the normals (3, H, W) in a mask (H, W) show: 1 for a sphere, -1 for
    a bowl.
    """
    rows, columns = mask.nonzero().T.float()
    across = torch.stack((columns - columns.mean(), rows.mean() - rows))
    slopes = normals[:2, mask]
    lengths = slopes[0].hypot(slopes[1]) * across[0].hypot(across[1])  # norm(dim=0) is slow
    return (slopes * across).sum() / lengths.sum().clamp(min=1e-6)


def photograph(
    pixel_set: PixelSet, entry: Entry, count: int, generator: torch.Generator
) -> list[tuple[Tensor, ...]]:
    """Photograph a scene under `count` lights, with the faults of a capture; an empty list where
    too little is seen.

    30 % of the captures show a part of the object, 25 % its background; 60 % have intensities that
    nobody measured, of which two fifths increase towards one side.
    """

    def uniform(low: float = 0.0, high: float = 1.0) -> float:
        return draw_number(generator, low, high)

    pixels = pixel_set.load(entry)
    lights, mask = (
        torch.from_numpy(np.array(part)) for part in (pixels.light_directions, pixels.mask)
    )
    chosen = choose(lights, count, generator)
    lights = lights[chosen]
    images, normals = torch.zeros(count, *mask.shape), torch.zeros(3, *mask.shape)
    observations = pixels.observations[:, chosen.numpy()].astype(np.float32)
    images[:, mask] = torch.from_numpy(observations).T
    normals[:, mask] = torch.from_numpy(np.array(pixels.normals, np.float32)).T
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
    directions = torch.stack((x, y, z), dim=1)
    sigma = 0.0 if uniform() < 0.4 else uniform(0, 0.8) * math.log(2)
    intensities = sigma * torch.randn(count, generator=generator)
    if sigma > 0 and uniform() < 0.4:  # the object is not in the middle of the lamps
        intensities += 0.3 * directions[:, :2] @ torch.randn(2, generator=generator)
    images = images * intensities.exp()[:, None, None]
    values = images[:, inside > 0].flatten()
    rank = math.ceil((1 - 10 ** uniform(-3.5, -1.5)) * len(values))
    brightest = values.kthvalue(rank).values.clamp(min=1e-6)
    images = (images / brightest * uniform(0.4, 1)).clamp(max=1)
    noise = (
        10 ** uniform(-3.5, -1.8) * inside + 10 ** uniform(-3.5, -2) * images.clamp(min=0).sqrt()
    )
    images = (images + noise * torch.randn(images.shape, generator=generator)).clamp(min=0)
    if uniform() < 0.15:  # light that is always there
        images = images + uniform(0, 0.03) * images[:, inside > 0].mean() * inside
    if uniform() < 0.1:  # an unknown curve
        images = images ** uniform(0.8, 1.2)
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
    is_coarse = choose_precision("auto", torch.device("cpu")) == "bfloat16"
    with torch.autocast("cpu", torch.bfloat16, enabled=is_coarse):
        guess = network(images.float())
    cosine = (guess.directions * directions).sum(dim=-1)
    sharpness = guess.sharpness.exp()
    likelihood = (
        sharpness * (1 - cosine) - guess.sharpness + torch.log1p(-torch.exp(-2 * sharpness))
    )
    angle = cosine.clamp(-0.99999, 0.99999).acos()
    side = binary_cross_entropy_with_logits(guess.bump, (0.5 + 2 * bump).clamp(0, 1))
    return likelihood.mean(), angle.mean(), (guess.log_intensities - intensities).abs().mean(), side


def widen(network: LightNet, narrow: dict[str, Tensor]) -> None:
    """Give a network the function of one with fewer features per layer, or without some of its
    residual layers (Chen et al., "Net2Net", ICLR 2016).

    Its own features do not change the features of the narrow one yet.
    """
    for name, values in network.state_dict().items():
        if name not in narrow and name.startswith(("local.", "middle.")):
            values.zero_()
            continue
        known = narrow[name]
        if values.ndim == 1:
            values[: len(known)] = known
            continue
        groups = 3 if name.startswith("join") else 1  # of inputs: each image, maximum and mean
        rows = values.view(len(values), groups, -1, *values.shape[2:])[: len(known)]
        known = known.view(len(known), groups, -1, *known.shape[2:])
        rows.zero_()
        rows[:, :, : known.shape[2]] = known


def train(sets: Sequence[Path], steps: int, output: Path, start_from: Path | None = None) -> None:
    """Train for so many steps, and write the running average of the weights."""
    sources = dict.fromkeys(map(str, sets), 1.0)
    opened = open_sets(replace(PRESETS["compact"], sources=sources, held_share=HELD_SHARE))
    training, held = (
        [(found, entry) for found, entries in part.values() for entry in entries]
        for part in (opened.training, opened.validation)
    )
    torch.manual_seed(0)
    network, average = LightNet().to(memory_format=torch.channels_last), LightNet()
    if start_from is not None:
        widen(network, load_file(start_from))
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
    captures = Captures(training, 0, step)
    batches = iter(DataLoader(captures, batch_size=None, num_workers=1, prefetch_factor=6))
    while step < steps:
        rate = RATE * min(1, (step + 1) / 100) * (1 + math.cos(math.pi * step / steps)) / 2 + 1e-6
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
        if step % 1000 == 0 or step == steps:
            state = {"network": network.state_dict(), "average": average.state_dict()}
            torch.save({**state, "optimiser": optimiser.state_dict(), "step": step}, checkpoint)
            print(step, validate(average, held), flush=True)
    save_module(average, output, {"format": LIGHT_FORMAT})


@torch.inference_mode()
def validate(network: LightNet, held: Scenes, batches: int = 40) -> str:
    """Return the mean errors on captures of held scenes."""
    captures = iter(Captures(held, 1))
    found = [torch.stack(losses(network, *next(captures))) for _ in range(batches)]
    _, angle, intensity, side = torch.stack(found).mean(dim=0).tolist()
    return (
        f"{math.degrees(angle):.2f} degrees, intensities {100 * intensity:.1f} %, cross entropy of"
        f" bump and hollow {side:.3f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw")
    for name in ("output", "meshes", "reliefs"):
        drawing.add_argument(name, type=Path)
    drawing.add_argument("--scenes", type=int, default=300)
    drawing.add_argument("--seed", type=int, default=0)
    training = commands.add_parser("train")
    training.add_argument("sets", type=Path, nargs="+")
    training.add_argument("--steps", type=int, default=60_000)
    training.add_argument("--start-from", type=Path, help="weights of a network, or a narrower one")
    training.add_argument("-o", "--output", type=Path, default=Path("light-net.safetensors"))
    options = vars(parser.parse_args(arguments))
    if options.pop("command") == "draw":
        draw(**options)
    else:
        train(**options)


if __name__ == "__main__":
    main()
