"""How often faults of a capture are named, and how often right captures are doubted.

    python benchmarks/capture_faults.py [CAPTURE...] [--scenes 72] [--draws 5] [--fit]

Renders scenes of all kinds of shapes in all classes of materials, under distant lights and under
lamps at 2 to 6 widths of the object, and draws 8 to 40 lights. Prints for each fault the shares of
captures that get each warning. Of real captures, draws of 10 and 20 lights and all lights are
checked as they are.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from near_lamps import height_field, sphere
from point_lights import render_point_lights
from splinecli.capture import Capture, CaptureWarning, open_capture
from splinecli.capture.arrays import ArraySource
from splinecli.capture.sample import Sample
from splinecli.images.lamps import estimate_light_intensities
from splinecli.judge.checks import check_capture
from splinecli.judge.explanations import ALL_KINDS, COSTS, POWERS, Explanation, Explanations, Kind
from splinecli.lights.draws import draw_lights
from splinecli.maths.transfer import encode_srgb
from splinecli.recipe import prepare_capture
from splinecli.workshop.synthesis.meshes import Mesh
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import (
    SceneConfig,
    draw_scene,
    render_direct,
    render_indirect,
)

Array = NDArray[np.float64]
WIDTHS = (2.0, 3.0, 4.0, 6.0)
SIZE, N_LIGHTS, SEED = 48, 40, 91
NOISE = 0.002  # of the brightest thousandth


@dataclass(frozen=True, eq=False)
class Rendered:
    """A scene in one material: observations (P, F) under distant and near lights (F, 3)."""

    kind: str
    shape: str
    mask: NDArray[np.bool_]
    lights: Array
    distant: Array
    near: Array
    widths: float


def render(index: int) -> Iterator[Rendered]:
    rng = np.random.default_rng([SEED, index])
    shape = ("", "", "relief", "", "", "plane", "", "", "sphere", "", "", "low relief")[index % 12]
    mesh = sphere(count=150) if shape == "sphere" else None
    if shape and mesh is None:
        steepness = {
            "relief": rng.uniform(0.5, 1.2),
            "plane": 0.0,
            "low relief": rng.uniform(0.05, 0.4),
        }[shape]
        field = height_field("relief", 201)
        normals = field.vertex_normals / field.vertex_normals[:, 2:] * (steepness, steepness, 1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mesh = Mesh(
            field.vertices * np.float32((1, 1, steepness)),  # type: ignore[operator]
            field.faces,
            normals.astype(np.float32),
        )
    config = SceneConfig(size=SIZE, lights=4)
    scene = draw_scene(SEED, index, config, mesh)
    z, azimuth = rng.uniform(0.5, 0.99, N_LIGHTS), rng.uniform(0, 2 * np.pi, N_LIGHTS)
    across = np.sqrt(1 - z * z)
    lights = np.stack((across * np.cos(azimuth), across * np.sin(azimuth), z), axis=1)
    tracer = Tracer(scene.mesh)
    visible = find_visible_surface(tracer, SIZE, 2)
    surface = scene.materials, scene.patch_of_face
    middle = np.array((0, 0, visible.samples.position[:, 2].mean(dtype=np.float64)))
    widths = WIDTHS[index // 3 % len(WIDTHS)]
    positions = lights * widths * np.ptp(np.flatnonzero(visible.mask.any(axis=0))) * 2 / SIZE
    unit = np.sum((positions + middle) ** 2, axis=1) / np.sum(positions**2, axis=1)
    with torch.inference_mode():
        distant = render_direct(tracer, visible, lights.astype(np.float32), *surface)
        near = render_point_lights(tracer, visible, positions + middle, *surface)
        generator = torch.Generator().manual_seed(index)
        indirect = render_indirect(
            tracer,
            visible,
            lights.astype(np.float32),
            *surface,
            directions=32,
            bounces=2,
            generator=generator,
        )
    for kind, bounced in indirect.items():
        images = (distant[kind] + bounced).numpy(), near[kind].numpy() / unit + bounced.numpy()
        yield Rendered(kind, shape or scene.shape, visible.mask, lights, *images, widths)


def warnings_of(capture: Capture, *, intensities: Array | None) -> tuple[CaptureWarning, ...]:
    """Return the warnings about a capture whose intensities (F,) were measured, or are None."""
    known = intensities is not None
    given = np.ones(capture.n_lights) if intensities is None else intensities
    source = ArraySource(
        images=[],
        mask=capture.mask,
        light_directions=capture.light_directions,
        light_intensities=given[:, None].repeat(3, axis=1),
        intensities_known=known,
        intensities_measured=known,
    )
    return check_capture(source, capture).warnings


def codes(
    observations: Array, mask: NDArray[np.bool_], lights: Array, *, measured: bool = True
) -> list[str]:
    capture = Capture(
        "rendered", observations.astype(np.float32), lights, tuple(range(len(lights))), mask
    )
    intensities = np.ones(len(lights)) if measured else None
    found = [warning.code for warning in warnings_of(capture, intensities=intensities)]
    if not measured and estimate_light_intensities(capture.observations, None, lights) is not None:
        found.append("estimated_intensities")
    return found


def faults(scene: Rendered, rng: np.random.Generator) -> Iterator[tuple[str, list[str]]]:
    """Yield each fault and the codes of the warnings that it gets."""
    chosen = rng.choice(N_LIGHTS, int(rng.choice((8, 10, 16, 25, 40))), replace=False)
    lights, mask = scene.lights[chosen], scene.mask
    full = np.quantile(scene.distant, 0.999)

    def seen(images: Array) -> Array:
        values = images[:, chosen] / full
        return np.asarray((values + rng.normal(0, NOISE, values.shape)).clip(0, 1))

    right = seen(scene.distant)
    unequal = right * np.exp(rng.normal(0, 0.3, len(lights)))
    yield "right", codes(right, mask, lights)
    yield "right, intensities unknown", codes(right, mask, lights, measured=False)
    yield f"lamps at {scene.widths:g} widths", codes(seen(scene.near), mask, lights)
    yield "sRGB as linear", codes(encode_srgb(right) / 255.0, mask, lights)
    yield "intensities off by 30 %, unknown", codes(unequal, mask, lights, measured=False)
    yield "intensities off by 30 %, stated as right", codes(unequal, mask, lights)
    yield "x negated", codes(right, mask, lights * (-1, 1, 1))
    picture = np.abs(rng.normal(0, NOISE, (2 * SIZE, 2 * SIZE, len(lights))))
    inner = picture[SIZE // 2 : 3 * SIZE // 2, SIZE // 2 : 3 * SIZE // 2]
    inner[mask] = right
    everything = np.ones(picture.shape[:2], np.bool_)
    yield (
        "x negated, no mask",
        codes(picture.reshape(-1, len(lights)), everything, lights * (-1, 1, 1)),
    )


KINDS: dict[str, Kind | None] = {
    "right": None,
    "encoded": "curve",
    "near": "near",
    "constant": "offset",
    "unequal": "intensities",
}
"""Captures that the readings are fitted to, and the reading that is right."""

PRIOR = {"right": 0.7, "encoded": 0.12, "near": 0.06, "constant": 0.06, "unequal": 0.06}


def readings_of(
    scene: Rendered, rng: np.random.Generator
) -> Iterator[tuple[str, list[Explanation]]]:
    """Yield the readings of a scene as it is and with each fault of KINDS."""
    chosen = rng.choice(N_LIGHTS, int(rng.choice((8, 10, 12, 16))), replace=False)
    right, near = (
        images[:, chosen] / np.quantile(images, 0.999) for images in (scene.distant, scene.near)
    )
    share = (
        rng.choice((0.1, 0.3, 0.8)) * right.mean(axis=1, keepdims=True) / scene.lights[:, 2].mean()
    )
    unequal = right * np.exp(rng.normal(0, 0.3, len(chosen)))
    made = {
        "right": right,
        "encoded": right,
        "near": near,
        "constant": right + share,
        "unequal": unequal,
    }
    for kind, images in made.items():
        images = (images / np.quantile(images, 0.999) + rng.normal(0, NOISE, images.shape)).clip(
            0, 1
        )
        values = encode_srgb(images) / 255.0 if kind == "encoded" else images
        yield kind, Explanations(Sample(values, scene.mask, 1), scene.lights[chosen]).fit(ALL_KINDS)


def fit(found: Sequence[tuple[str, list[Explanation]]]) -> None:
    """Print the costs and powers with which the readings of captures are likeliest right."""
    cases = [
        (kind, {each.kind: each for each in reversed(readings)})
        for kind, readings in found
        if readings
    ]
    logs = np.array([[np.log(each[kind].ratio) for kind in ALL_KINDS] for _, each in cases])
    # What the evidence holds beside cost and power, such as the cost of equal intensities.
    others = np.array([[each[k].evidence + COSTS[k] for k in ALL_KINDS] for _, each in cases])
    others += np.array([POWERS[kind] for kind in ALL_KINDS]) * logs
    right = np.array(
        [0 if KINDS[kind] is None else 1 + ALL_KINDS.index(KINDS[kind]) for kind, _ in cases]
    )
    counts = Counter(kind for kind, _ in cases)
    weights = np.array([PRIOR[kind] / counts[kind] for kind, _ in cases])

    def loss(values: Array) -> float:
        costs, powers = values[: len(ALL_KINDS)], np.exp(values[len(ALL_KINDS) :])
        evidence = np.concatenate(
            (np.zeros((len(logs), 1)), others - costs - powers * logs), axis=1
        )
        surprise = np.logaddexp.reduce(evidence, axis=1) - evidence[np.arange(len(right)), right]
        return float((weights * surprise).sum())

    start = [*(COSTS[kind] for kind in ALL_KINDS), *(np.log(POWERS[kind]) for kind in ALL_KINDS)]
    best = minimize(loss, start, method="BFGS")
    print(
        f"loss {loss(np.array(start)):.3f} as it is, {best.fun:.3f} at best, of {len(cases)}"
        " captures"
    )
    for place, kind in enumerate(ALL_KINDS):
        print(
            f"{kind:12} cost {best.x[place]:.2f}, power"
            f" {np.exp(best.x[len(ALL_KINDS) + place]):.2f}"
        )


def real(folder: Path, draws: int) -> Iterator[tuple[str, list[str]]]:
    source = open_capture(folder)
    for count in (10, 20, None):
        if count is not None and count >= source.n_lights:
            continue
        name = f"{folder.parent.name}/{folder.name}, {count or source.n_lights} lights"
        for draw in draw_lights(source.light_directions, count, trials=draws, seed=SEED):
            capture = prepare_capture(source, draw)
            yield (
                name,
                [
                    warning.code
                    for warning in (*capture.warnings, *check_capture(source, capture).warnings)
                ],
            )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--scenes", type=int, default=72)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.fit:
        rngs = ((index, np.random.default_rng([SEED, index, 2])) for index in range(options.scenes))
        fit(
            [
                case
                for index, rng in rngs
                for scene in render(index)
                for case in readings_of(scene, rng)
            ]
        )
        return
    total: Counter[tuple[str, str]] = Counter()
    named: dict[tuple[str, str], Counter[str]] = {}
    rows = [
        (kind, "real", found)
        for folder in options.captures
        for kind, found in real(folder, options.draws)
    ]
    for index in range(options.scenes):
        rng = np.random.default_rng([SEED, index, 1])
        rows += [
            (kind, scene.kind, found)
            for scene in render(index)
            for kind, found in faults(scene, rng)
        ]
    for fault, kind, found in rows:
        total[fault, kind] += 1
        named.setdefault((fault, kind), Counter()).update(set(found))
    for (fault, kind), count in sorted(total.items()):
        cells = (f"{code} {times}" for code, times in named[fault, kind].most_common())
        print(f"{fault:42} {kind:9} {count:3}: {', '.join(cells) or '-'}")


if __name__ == "__main__":
    main()
