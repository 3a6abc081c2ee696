"""Render captures, right and faulty ones, and estimate them: examples for
benchmarks/fit_capture_confidence.py.

    python benchmarks/faulty_captures.py FOLDER [--scenes 1020] [--size 64] [--part 1/2] [--sets SET
    ...]

Half of the scenes are rendered here; the others are whole scenes of pixel sets of `splinecli
prepare`, which have more pixels and more detail. Without --sets, all are rendered here. Each scene
becomes three captures of KINDS: right ones, and ones whose lamps or files are not what they are
taken for. spline-net estimates them. FOLDER keeps each with its true errors in a file. A run
continues an earlier one; --part I/N takes every N-th scene, so that N processes can share the work.
"""

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from point_lights import render_point_lights
from splinecli.capture import Capture
from splinecli.capture.near_lamps import NearLamps
from splinecli.capture.record import in_one_plane
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.estimate.refinement.refiner import NetworkRefiner
from splinecli.images.lens_blur import REACH
from splinecli.lights.lighting import LightingAt
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.transfer import encode_srgb
from splinecli.workshop.pixel_sets.store import PixelSet, open_pixel_set
from splinecli.workshop.synthesis.batches import CaptureConfig
from splinecli.workshop.synthesis.draw_materials import draw_material, with_one_gloss
from splinecli.workshop.synthesis.lights import choose_in_cone
from splinecli.workshop.synthesis.meshes import Mesh
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import draw_patches, render_direct, render_indirect
from splinecli.workshop.synthesis.shapes import draw_rotation, draw_shape, turn
from splinecli.workshop.synthesis.whole_capture import photograph_scene

Floats = NDArray[np.floating]

KINDS = {
    "right": 0.5,
    "near lamps": 0.12,
    "curve": 0.12,
    "lights": 0.12,
    "intensities": 0.07,
    "no mask": 0.07,
}
"""What captures are, and their shares."""

SEED = 83
CAPTURES_PER_SCENE = 3


def draw_mesh(rng: np.random.Generator) -> Mesh:
    """Draw a shape of synthesis/shapes.py, an ellipsoid, or a plate with waves."""
    kind = rng.random()
    if kind < 0.55:
        return draw_shape(rng)[1]
    count = 200
    if kind < 0.7:
        polar, azimuth = np.meshgrid(
            np.linspace(0.01, np.pi - 0.01, count), np.linspace(0, 2 * np.pi, count)
        )
        axes = (
            rng.uniform(0.5, 0.95, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(0.5, 0.95))
        )
        sphere = np.stack(
            (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)),
            axis=-1,
        )
        vertices, normals = sphere * axes, unit(sphere / axes)
    else:
        x, y = np.meshgrid(*[np.linspace(-1.05, 1.05, count)] * 2)
        heights, slopes = np.zeros_like(x), np.zeros((2, *x.shape))
        for number in range(4):
            way = rng.normal(size=2) * rng.uniform(1, 8) / 2
            steepness = rng.uniform(0, 0.5) if number else rng.uniform(0, 0.2)
            wave = way[0] * x + way[1] * y + rng.uniform(0, 6.3)
            heights += steepness / np.linalg.norm(way) * np.sin(wave)
            slopes += steepness / np.linalg.norm(way) * np.cos(wave) * way[:, None, None]
        vertices, normals = (
            np.stack((x, y, heights), -1),
            unit(np.stack((*-slopes, np.ones_like(x)), -1)),
        )
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    first = np.stack((corner, corner + 1, corner + count), axis=1)
    faces = np.concatenate(
        (first, np.stack((corner + 1, corner + count + 1, corner + count), axis=1))
    )
    mesh = Mesh(
        *(
            values.reshape(-1, 3).astype(kept)
            for values, kept in ((vertices, "f4"), (faces, "i4"), (normals, "f4"))
        )
    )
    return turn(mesh, draw_rotation(rng)) if kind < 0.7 else mesh


def draw_count(rng: np.random.Generator) -> int:
    """Draw a number of lights: 10, or 5 to 60."""
    return 10 if rng.random() < 0.3 else round(5 * 12 ** rng.random())


def draw_lights(rng: np.random.Generator) -> Floats:
    """Draw 5 to 60 light directions (F, 3): within a cone, or as a ring with one or more tilts."""
    count = draw_count(rng)
    lowest = rng.uniform(0.15, 0.75)
    while True:
        z, azimuth = rng.uniform(lowest, 0.98, count), rng.uniform(0, 2 * np.pi, count)
        if rng.random() < 0.3:
            z = rng.choice(z[: rng.integers(1, 4)], count) + rng.normal(0, 0.02, count)
            azimuth = np.arange(count) * 2 * np.pi / count + rng.normal(0, 0.1, count)
        z = z.clip(0.1, 0.99)
        radius = np.sqrt(1 - z * z)
        lights = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1)
        values = np.linalg.svd(lights, compute_uv=False)
        if values[2] > 0.08 * values[0]:
            return lights


def disturb_lights(lights: Floats, rng: np.random.Generator) -> Floats:
    """Return directions (F, 3) as a wrong file gives them: turned, noisy, negated, or in a wrong
    order.
    """
    kind, count = rng.integers(8), len(lights)
    x, y, z = lights.T
    if kind == 0:
        angle = np.radians(rng.uniform(5, 180))
        c, s = np.cos(angle), np.sin(angle)
        return np.stack((c * x - s * y, s * x + c * y, z), axis=1)
    if kind == 1:
        return lights + np.array((*rng.normal(0, 0.25, 2), 0))
    if kind in (2, 3):
        return lights + np.radians(rng.uniform(1.5, 15)) * rng.normal(size=lights.shape)
    if kind == 4:
        return lights[rng.permutation(count)]
    if kind == 5:
        return np.roll(lights, rng.integers(1, count), axis=0)
    if kind == 6:
        return np.stack(((-x, y, z), (x, -y, z), (y, x, z))[rng.integers(3)], axis=1)
    order = np.arange(count)
    pair = rng.choice(count, 2, replace=False)
    order[pair] = order[pair[::-1]]
    return lights[order]


def bend_values(values: Floats, rng: np.random.Generator) -> Floats:
    """Return linear values, about 0 to 1, as a wrong curve gives them: encoded, or decoded a second
    time.
    """
    if rng.random() < 0.5:
        values = values / np.quantile(values, 0.999)  # well exposed
    values = values.clip(0, 1)
    if rng.random() < 0.5:
        return encode_srgb(values) / 255
    gamma = rng.uniform(1.5, 2.6) if rng.random() < 0.5 else rng.uniform(1.05, 2.4)
    return values ** (1 / gamma if rng.random() < 0.65 else gamma)


class Scene(NamedTuple):
    """A scene under the lights of one capture."""

    radiance: torch.Tensor  # (P, F)
    mask: NDArray[np.bool_]  # (H, W)
    normals: Floats  # (P, 3)
    lights: Floats  # (F, 3), unit
    number: int  # the same for all captures of a shape
    lamps: NearLamps | None = None  # the true lamps, if they are near


def render_scenes(
    index: int,
    size: int,
    kinds: Sequence[str],
    rng: np.random.Generator,
    generator: torch.Generator,
) -> list[Scene]:
    """Render one shape for captures of these kinds, with its own material and lights for each."""
    size = round(size * rng.uniform(0.8, 1.2) / 8) * 8
    mesh = draw_mesh(rng)
    tracer = Tracer(mesh)
    visible = find_visible_surface(tracer, size, 2)
    if len(visible.normals) < size**2 / 8:
        return []
    made = []
    for kind in kinds:
        patches = int(3000 ** rng.random())
        material = draw_material(patches, generator)
        materials = {"one": with_one_gloss(material) if rng.random() < 0.5 else material}
        parts = materials, draw_patches(mesh, patches, rng)
        lights = draw_lights(rng)
        single = lights.astype(np.float32)
        lamps = None
        if kind == "near lamps" or (kind == "right" and rng.random() < 0.1):
            # Widths of the object from its mean plane. All lamps are equally strong, or measured at
            # the origin.
            middle = np.array((0, 0, visible.samples.position[:, 2].mean()))
            positions = lights * 2 * 1.5 * 6.7 ** rng.random()
            radiance = render_point_lights(tracer, visible, positions + middle, *parts)["one"]
            fall = np.sum((positions + middle) ** 2, axis=1) / np.sum(positions**2, axis=1)
            radiance /= torch.from_numpy(fall)
            lamps = NearLamps.of(positions, 2 / size, (size, size), equal=False)
        else:
            radiance = render_direct(tracer, visible, single, *parts)["one"]
        if rng.random() < 0.65:
            more = {"directions": 48, "bounces": 3, "generator": generator}
            with torch.inference_mode():
                radiance = (
                    radiance + render_indirect(tracer, visible, single, *parts, **more)["one"]
                )
        made.append(Scene(radiance, visible.mask, visible.normals, lights, index, lamps))
    return made


def stored_scene(
    pixel_set: PixelSet, rng: np.random.Generator, generator: torch.Generator
) -> Scene:
    """Choose a scene of a pixel set, and 5 to 60 of its lights."""
    entry = pixel_set.entries[rng.integers(len(pixel_set.entries))]
    pixels = pixel_set.load(entry)
    directions = torch.from_numpy(np.array(pixels.light_directions))
    chosen = choose_in_cone(directions, draw_count(rng), generator).numpy()
    radiance = torch.from_numpy(np.asarray(pixels.observations[:, chosen], np.float32))
    lights = np.asarray(pixels.light_directions, np.float64)[chosen]
    normals = np.asarray(pixels.normals, np.float32)
    return Scene(radiance, np.array(pixels.mask), normals, lights, zlib.crc32(entry.scene.encode()))


def make_captures(
    index: int, size: int, sets: Sequence[PixelSet]
) -> list[tuple[Capture, Floats, int]]:
    """Make scene number `index` into some captures, with true normals (P, 3), zero where nothing is
    to be seen.

    The last item is the number of the scene, which keeps scenes apart in the fit. Half of the
    scenes are of the pixel sets, if there are any, and have no near lamps.
    """
    rng, generator = (
        np.random.default_rng([SEED, index]),
        torch.Generator().manual_seed(1000 * SEED + index),
    )
    kinds = [
        str(kind) for kind in rng.choice(list(KINDS), CAPTURES_PER_SCENE, p=list(KINDS.values()))
    ]
    if sets and index % 2:
        kinds = ["right" if kind == "near lamps" else kind for kind in kinds]
        scenes = [stored_scene(sets[rng.integers(len(sets))], rng, generator) for _ in kinds]
    else:
        scenes = render_scenes(index, size, kinds, rng, generator)
    made = []
    for kind, (radiance, mask, normals, lights, scene, lamps) in zip(
        kinds, scenes, strict=bool(scenes)
    ):
        single = lights.astype(np.float32)
        # a dark margin, which a lens and its inverse filter mix with the outline
        mask = np.pad(mask, REACH)
        if lamps is not None:
            lamps = lamps.within(-REACH, -REACH, 1, None)
        if kind == "no mask":
            margin = [(int(rng.integers(16)),) * 2] * 2
            mask = np.pad(mask, margin)
            own, normals = normals, np.zeros((mask.size, 3), np.float32)
            normals[mask.ravel()] = own
            felt = (
                10 ** rng.uniform(-4, -1.5)
                * rng.uniform(0.5, 1.5, (mask.size, 1))
                * rng.choice((0, 1))
            )
            shown = (felt * lights[:, 2] * float(radiance.mean())).astype(np.float32)
            shown[mask.ravel()] = radiance
            radiance, mask = torch.from_numpy(shown), np.ones_like(mask)
        if kind == "intensities":
            stops = rng.uniform(0.05, 0.7) * rng.normal(size=len(lights))
            radiance = radiance * torch.from_numpy(2**stops).float()
        noisy = kind == "no mask" or rng.random() < 0.65
        unequal = 0.0 if kind in ("intensities", "curve") else 0.3
        config = CaptureConfig(
            light_direction_error_share=0,
            light_intensity_error_share=0.2 * noisy,
            unequal_lights_share=unequal,
            saturated_share=0.1,
            sensor_noise=noisy,
            eight_bit_share=0.3,
            optics_share=0.5,
        )
        images = torch.zeros(len(lights), *mask.shape)
        images[:, torch.from_numpy(mask)] = radiance.float().T
        seen, *_ = photograph_scene(
            images.flatten(1).T, torch.from_numpy(single), config, generator, torch.from_numpy(mask)
        )
        observations = np.asarray(seen.numpy(), np.float32)
        stated = lights
        if kind == "curve":
            observations = np.asarray(bend_values(observations, rng), np.float32)
        elif kind == "lights":
            stated = disturb_lights(lights, rng)
        elif rng.random() < 0.3:
            stated = lights + np.radians(rng.uniform(0, 1.2)) * rng.normal(size=lights.shape)
        stated = unit(np.concatenate((stated[:, :2], stated[:, 2:].clip(min=0.05)), axis=1))
        if in_one_plane(stated):
            continue
        capture = Capture(kind, observations, stated, tuple(range(len(lights))), mask)
        if lamps is not None and kind == "right":
            capture = replace(capture, lamps=lamps)
        made.append((capture, normals, scene))
    return made


class Recorder:
    """A refiner that keeps what it was given."""

    def __init__(self, refiner: NetworkRefiner) -> None:
        self._refiner = refiner
        self.turns = refiner.turns

    def refine(
        self, mask, observations, lighting_at: LightingAt, normals, errors, **options
    ) -> None:
        light = lighting_at(np.arange(len(normals)))
        self.before = normals.copy(), errors.copy()
        self._refiner.refine(mask, observations, lighting_at, normals, errors, **options)
        self.seen = {
            "observations": light.observations,
            "directions": light.directions,
            "mask": mask,
            "normals": normals.copy(),
            "errors": errors.copy(),
            "pixelwise_normals": self.before[0],
            "pixelwise_errors": self.before[1],
        }


def store_captures(
    folder: Path, scenes: Sequence[int], size: int, sets: Sequence[PixelSet]
) -> None:
    torch.set_num_threads(1)
    estimator = make_estimator("spline-net")
    recorder = estimator.refiner = Recorder(estimator.refiner)  # type: ignore[assignment]
    for index in scenes:
        if (folder / f"{index:05d}.done").exists():
            continue
        rng = np.random.default_rng(index)
        for number, (capture, normals, scene) in enumerate(make_captures(index, size, sets)):
            estimate_normals(capture, estimator)
            truth = normals.astype(np.float64)
            unknown = ~truth.any(axis=1)
            truth[unknown] = unit(rng.normal(size=(unknown.sum(), 3)))
            truth[unknown, 2] = np.abs(truth[unknown, 2])
            found = {
                name: angle_between_deg(recorder.seen[f"{name}normals"], truth).astype(np.float32)
                for name in ("", "pixelwise_")
            }
            np.savez(
                folder / f"{index:05d}_{number}.npz",
                **recorder.seen,
                kind=capture.name,
                scene=scene,
                known=~unknown,
                error_deg=found[""],
                pixelwise_error_deg=found["pixelwise_"],
                lights=capture.light_directions,
            )
        (folder / f"{index:05d}.done").touch()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=1020)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--part", default="1/1")
    parser.add_argument("--sets", type=Path, nargs="*", default=[])
    options = parser.parse_args(arguments)
    part, parts = map(int, options.part.split("/"))
    options.folder.mkdir(exist_ok=True)
    sets = [open_pixel_set(folder) for folder in options.sets]
    store_captures(options.folder, range(part - 1, options.scenes, parts), options.size, sets)
    print(f"{len(list(options.folder.glob('*.npz')))} captures")


if __name__ == "__main__":
    main()
