"""Draw pixels for the material net and train it: how assets/material-net.safetensors was made.

    python benchmarks/train_material_net.py draw FOLDER SHAPES RELIEF SET...
    python benchmarks/train_material_net.py train FOLDER [--steps 64000] [--ship]

Both go on after an interruption. Three sevenths of the pixels are generated, as in the training of
spline-net, and the others are those of rendered scenes; their materials and faults are described in
synthesis/. The SETs are those that train_light_net.py drew with the same SHAPES and RELIEF. The
network's tokens for the pixels are stored, because it is not changed. A shard of 512 captures takes
half a minute on one core, and 22 MB; a set takes five minutes more, and 1,000 steps 40 seconds.
"""

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from materials import Example, patch_of_pixels
from splinecli.estimate.networks.set_branch import PixelTokens
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.materials.material_net import MATERIAL_FORMAT, Gloss, MaterialNet
from splinecli.system.files import file_sha256
from splinecli.system.machine import choose_precision
from splinecli.system.weight_files import SHIPPED
from splinecli.workshop.pixel_sets.store import open_pixel_set
from splinecli.workshop.save_weights import save_module
from splinecli.workshop.synthesis import draw_uniform
from splinecli.workshop.synthesis.batches import PixelBatch
from splinecli.workshop.synthesis.lights import choose_in_cone, draw_light_directions
from splinecli.workshop.synthesis.pixels import PixelGeneratorConfig, PixelScene, draw_scene
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.scenes import RenderedScene
from splinecli.workshop.synthesis.whole_capture import photograph_captures
from train_light_net import RENDERING, draw_small_scene

BATCHES, CAPTURES, PIXELS = 64, 8, 256  # of a shard, of a batch, and of a capture
# numbers of shards whose captures have the normals of spheres, of those with the normals of reliefs
# and plates, and of those from each set of rendered scenes
SPHERES, NARROW, OF_A_SET = 16, 16, 6
CONFIG = PixelGeneratorConfig(capture_pixels=PIXELS)
RATE = 2e-3


class Batch(NamedTuple):
    """Pixels of CAPTURES captures. Pixel p belongs to capture p % CAPTURES."""

    pixels: PixelTokens
    # (P, 6): roughness, metallic, log base, log level, minnaert and tail; see Gloss
    targets: Tensor


@torch.inference_mode()
def draw(folder: Path, shapes: Path, relief: Path, sets: Sequence[Path]) -> None:
    """Draw the shards that the folder does not have."""
    opened = lru_cache(1)(lambda path: [*small_scenes(path, shapes, relief)])
    folder.mkdir(parents=True, exist_ok=True)
    network = resolve_weights("spline-net").network
    coarse = choose_precision("auto", torch.device("cpu")) == "bfloat16"
    # The seeds are those of the shards of the shipped net.
    shards: list[tuple[int, Path | None]] = [(9000 + n, None) for n in range(SPHERES + NARROW)]
    shards += [(9080 + n, sets[n // OF_A_SET]) for n in range(OF_A_SET * len(sets))]
    for seed, of in shards:
        path = folder / f"{seed}.safetensors"
        if path.exists():
            continue
        generator = torch.Generator().manual_seed(seed)
        rows: list[tuple[Tensor, ...]] = []
        for _ in range(BATCHES):
            if of is None:
                batch = draw_generated(seed >= 9000 + SPHERES, generator)
            else:
                batch = draw_rendered(opened(of), generator)
            with torch.autocast("cpu", torch.bfloat16, enabled=coarse):
                pixels, context = network.encode_pixels(
                    batch.observations, batch.light_directions, batch.valid, captures=CAPTURES
                )
            assert context is not None and isinstance(batch.truth, PixelScene)
            own, shown = batch.truth.material, batch.exposure / pixels.scale
            logs = [
                (value * shown).clamp(1e-4, 1e3).log() for value in (own.base, 0.08 * own.specular)
            ]
            targets = torch.cat(
                (own.roughness, own.metallic, *logs, own.minnaert, own.tail_exponent), dim=1
            )
            relative = pixels.scale / context.brightness.repeat(PIXELS)[:, None]
            rows.append((pixels.tokens.half(), pixels.normal_z, relative, pixels.n_lights, targets))
        named = zip((*PixelTokens._fields, "targets"), zip(*rows, strict=True), strict=True)
        tensors = {name: torch.stack(parts) for name, parts in named}
        save_file(tensors, path.with_suffix(".part"))
        path.with_suffix(".part").rename(path)
        print(path, flush=True)


def draw_generated(are_narrow: bool, generator: torch.Generator) -> PixelBatch:
    """Draw a batch as PixelGenerator does; if they are narrow, with the normals of reliefs, plates
    and tilted parts.

    The normals of a capture are then drawn together by a factor of 10^U(-2, 0), about a direction 0
    to 60 degrees from the camera axis. Whether a highlight is visible depends on them.
    """
    scene = draw_scene(CAPTURES * PIXELS, CONFIG, generator)
    if are_narrow:
        polar = draw_uniform(generator, CAPTURES, 1, high=math.radians(60))
        azimuth = draw_uniform(generator, CAPTURES, 1, high=2 * math.pi)
        middle = torch.cat(
            (polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()), dim=1
        )
        share = 10 ** draw_uniform(generator, CAPTURES, 1, low=-2.0)

        def narrow(normals: Tensor) -> Tensor:
            captures = torch.arange(len(normals)) % CAPTURES
            drawn = torch.lerp(middle[captures], normals, share[captures])
            return normalize(torch.cat((drawn[:, :2], drawn[:, 2:].clamp(min=0.05)), dim=1), dim=1)

        mixed = scene.mixed
        if mixed is not None:
            mixed = replace(mixed, normals=narrow(mixed.normals))
        scene = replace(scene, normals=narrow(scene.normals), mixed=mixed)
    counts = CONFIG.light_counts(CAPTURES, generator)
    directions = draw_light_directions(CAPTURES, int(counts.max()), generator).repeat(PIXELS, 1, 1)
    return photograph(scene, scene.radiance(directions), directions, counts, generator)


def photograph(
    scene: PixelScene,
    radiance: Tensor,
    directions: Tensor,
    counts: Tensor,
    generator: torch.Generator,
) -> PixelBatch:
    """Photograph each capture under the first of its lights, as many as `counts` (CAPTURES,)."""
    valid = torch.arange(directions.shape[1]) < counts.repeat(PIXELS)[:, None]
    return photograph_captures(scene, radiance, directions, valid, CONFIG, generator)


def small_scenes(folder: Path, shapes: Path, relief: Path) -> Iterator[Example]:
    """Yield the scenes of a set of train_light_net.py, which does not store their materials."""
    pixel_set = open_pixel_set(folder)
    for name, entries in groupby(pixel_set.entries, lambda entry: entry.scene):
        first, *others = entries
        index = int(name.removeprefix("scene"))
        _, scene = draw_small_scene(first.recipe["seed"], index, shapes, relief)
        patches = patch_of_pixels(scene, RENDERING)
        for entry in (first, *others):
            pixels = pixel_set.load(entry)
            normals = pixels.normals.astype(np.float32)
            assert len(patches) == len(normals), f"{folder} was drawn with other meshes or reliefs"
            rendered = RenderedScene(pixels.mask, normals, {})
            true = scene.materials[entry.name.removeprefix(f"{name}-")].take(patches)
            seen = np.array(pixels.observations)
            yield Example(entry.name, rendered, seen, pixels.light_directions, true, np.arange(0))


def draw_rendered(scenes: Sequence[Example], generator: torch.Generator) -> PixelBatch:
    """Photograph random pixels of CAPTURES random scenes."""
    counts = CONFIG.light_counts(CAPTURES, generator, available=RENDERING.lights)
    parts: list[tuple[Tensor, ...]] = []
    for _ in range(CAPTURES):
        scene = scenes[int(torch.randint(len(scenes), (), generator=generator))]
        lights = torch.from_numpy(np.array(scene.lights))
        chosen = choose_in_cone(lights, int(counts.max()), generator)
        pixels = torch.randint(len(scene.observations), (PIXELS,), generator=generator)
        normals, radiance = (
            torch.from_numpy(values)[pixels].float()
            for values in (scene.rendered.normals, scene.observations)
        )
        own = scene.true.take(pixels)
        directions = lights[chosen].expand(PIXELS, -1, -1)
        parts.append((normals, radiance[:, chosen], directions, *vars(own).values()))
    normals, radiance, directions, *numbers = (
        torch.stack(part, dim=1).flatten(0, 1) for part in zip(*parts, strict=True)
    )
    nothing = torch.zeros(len(normals), 1)
    truth = PixelScene(normals, PrincipledMaterial(*numbers), (), nothing, nothing)
    return photograph(truth, radiance, directions, counts, generator)


def read(paths: list[Path]) -> list[Batch]:
    """Read the batches of shards. The brightness of all captures is 1."""
    found = []
    for path in paths:
        shard = load_file(path)
        parts = zip(*(shard[name] for name in PixelTokens._fields), strict=True)
        found += [
            Batch(PixelTokens(*part), own)
            for part, own in zip(parts, shard["targets"], strict=True)
        ]
    return found


def forward(network: MaterialNet, batch: Batch) -> Gloss:
    """Return the network's prediction for a batch."""
    pixels = batch.pixels._replace(tokens=batch.pixels.tokens.float())
    found, _ = network(pixels, torch.ones(CAPTURES))
    return found


def loss_of(found: Gloss, targets: Tensor) -> Tensor:
    """Return the loss: absolute errors, the first two with the Laplace distributions that the
    network predicts.
    """
    roughness, metallic, log_base, log_level, minnaert, tail = targets.unbind(dim=1)
    wrong = (
        found.roughness - roughness
    ).abs() / found.roughness_error + found.roughness_error.log()
    base = (found.log_base - log_base).abs().clamp(
        max=3
    ) / found.log_base_error + found.log_base_error.log()
    dielectric = 0.2 * (found.log_level - log_level).abs() + 0.5 * (found.minnaert - minnaert).abs()
    kind = binary_cross_entropy(found.metalness, metallic, reduction="none")
    return (
        wrong + kind + 0.5 * base + (1 - metallic) * dielectric + 0.3 * (found.tail - tail).abs()
    ).mean()


def train(folder: Path, steps: int) -> MaterialNet:
    """Train on the shards of a folder but the first and last, and return the running average of the
    weights.
    """
    torch.manual_seed(0)
    paths = sorted(folder.glob("*.safetensors"))
    batches, held = read(paths[1:-1]), read(paths[:1] + paths[-1:])
    network, average = MaterialNet(), MaterialNet()
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-2)
    checkpoint, first = folder / "checkpoint", 0
    average.load_state_dict(network.state_dict())
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True)
        for part, name in ((network, "network"), (average, "average"), (optimiser, "optimiser")):
            part.load_state_dict(state[name])
        first = state["step"]
    for step in range(first, steps):
        rate = (
            RATE * min(1, (step + 1) / 100) * ((1 + math.cos(math.pi * step / steps)) / 2 + 0.005)
        )
        for group in optimiser.param_groups:
            group["lr"] = rate
        generator = torch.Generator().manual_seed(step)
        batch = batches[int(torch.randint(len(batches), (), generator=generator))]
        loss = loss_of(forward(network, batch), batch.targets)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        with torch.no_grad():
            kept = min(0.995, step / (step + 10))
            torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1 - kept)
        if (step + 1) % 500 == 0:
            parts: dict[str, Any] = {"network": network, "average": average, "optimiser": optimiser}
            torch.save(
                {name: part.state_dict() for name, part in parts.items()} | {"step": step + 1},
                checkpoint,
            )
            roughness, metal, base, inside = validate(average, held)
            print(
                f"{step + 1} roughness {roughness:.4f}, metalness right {metal:.3f}, base"
                f" {base:.3f}; within median error {inside:.3f}",
                flush=True,
            )
    return calibrate(average.eval(), held)


@torch.inference_mode()
def calibrate(network: MaterialNet, held: list[Batch]) -> MaterialNet:
    """Shift the predicted errors so that half of the errors of the roughness are below the median.

    A long training makes them too small.
    """
    layer = network.out[-1]
    assert isinstance(layer, torch.nn.Linear)
    for step in 2.0 ** np.arange(1, -8, -1):
        inside = validate(network, held)[-1]
        layer.bias[1] += math.copysign(step, 0.5 - inside)
    return network


@torch.inference_mode()
def validate(network: MaterialNet, held: list[Batch]) -> list[float]:
    """Return the errors on pixels that training does not use: of the roughness, share of correct
    metalness, of the base, and share of errors of the roughness below the predicted median.
    """
    rows = []
    for batch in held:
        found, true = forward(network, batch), batch.targets
        metal = (found.metalness > 0.5) == (true[:, 1] > 0.5)
        base = ((found.log_base - true[:, 2]).exp() - 1).abs().clamp(max=1)
        inside = (found.roughness - true[:, 0]).abs() < found.roughness_error * math.log(2)
        rows.append(
            torch.stack(((found.roughness - true[:, 0]).abs(), metal, base, inside), dim=1).mean(0)
        )
    means: list[float] = torch.stack(rows).mean(0).tolist()
    return means


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw")
    for name in ("folder", "shapes", "relief"):
        drawing.add_argument(name, type=Path)
    drawing.add_argument("sets", type=Path, nargs="+")
    training = commands.add_parser("train")
    training.add_argument("folder", type=Path)
    training.add_argument("--steps", type=int, default=64_000)
    training.add_argument("--ship", action="store_true", help="write into the package")
    given = parser.parse_args(arguments)
    if given.command == "draw":
        draw(given.folder, given.shapes, given.relief, given.sets)
    else:
        path = given.folder / "material-net"
        if given.ship:
            path = Path(str(SHIPPED)) / "material-net.safetensors"
        save_module(train(given.folder, given.steps), path, {"format": MATERIAL_FORMAT})
        if given.ship:
            manifest = Path(str(SHIPPED)) / "weights.json"
            entries = json.loads(manifest.read_text("utf-8"))
            entries["spline-net"]["material_net"] = {"file": path.name, "sha256": file_sha256(path)}
            manifest.write_text(json.dumps(entries, indent=2, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
