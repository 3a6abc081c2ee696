"""Train the network of splinecli/judge/judge_net.py, which says how likely other readings are.

    python benchmarks/train_judge_net.py draw FILE.npz [--scenes 100] [--seed 1]
    python benchmarks/train_judge_net.py train FILE.npz... [-o judge-net.safetensors]

`draw` renders scenes of all kinds of shapes in all classes of materials under 4 to 40 lights, and
stores the features of captures with and without faults. A run continues an earlier one. `train`
prints what the network says of captures that it was not trained on, and trains it on all of them.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from near_lamps import height_field, sphere
from point_lights import render_point_lights
from splinecli.capture import Capture
from splinecli.capture.arrays import ArraySource
from splinecli.capture.near_lamps import NearLamps
from splinecli.images.lamps import estimate_light_intensities
from splinecli.judge.evidence import Evidence
from splinecli.judge.judge_net import CLASSES, RIGHT, TILTED, TRANSLUCENT, JudgeNet, features_of
from splinecli.maths.normals import unit
from splinecli.maths.transfer import encode_srgb
from splinecli.workshop.synthesis.meshes import Mesh
from splinecli.workshop.synthesis.ray_tracing import Tracer, find_visible_surface
from splinecli.workshop.synthesis.scenes import (
    SceneConfig,
    draw_scene,
    render_direct,
    render_indirect,
)

Array = NDArray[np.float64]
SHAPES = ("", "", "relief", "", "", "plane", "", "", "sphere", "", "", "low relief")
ANALYTIC = ("ideal", "rough", "retro", TRANSLUCENT)  # materials that are not rendered
MATERIALS_PER_SCENE, FAULTS_PER_CAPTURE = 4, 7
RARE = 0.3  # fabrics that reflect towards the light are rarer than other materials
PRIOR = {RIGHT: 0.9, TRANSLUCENT: 0.03}  # the other classes share the rest
COLUMNS = ("features", "classes", "scenes", "materials")
MEMBERS, HIDDEN, STEPS, FOLDS = 8, 32, 800, 4


@dataclass(frozen=True, eq=False)
class Rendered:
    """A scene in one material: values (P, F) under distant and near lights (F, 3)."""

    material: str
    mask: NDArray[np.bool_]
    lights: Array
    distant: Array
    near: Array


def draw_lights(rng: np.random.Generator) -> Array:
    """Return 6 to 40 lights (F, 3), seldom four or five, in one of five arrangements."""
    count = int(np.exp(rng.uniform(np.log(6), np.log(40.9))))
    count = int(rng.integers(4, 6)) if rng.random() < 0.06 else count
    kind = rng.integers(5)
    z: NDArray[np.floating]
    azimuth: NDArray[np.floating] = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(
        0, 2 * np.pi
    )
    if kind == 0:  # anywhere above the object
        z, azimuth = rng.uniform(0.4, 0.99, count), rng.uniform(0, 2 * np.pi, count)
    elif kind == 1:  # a ring
        z = np.full(count, rng.uniform(0.45, 0.85))
    elif kind == 2:  # two rings
        low = rng.uniform(0.4, 0.65)
        z = np.where(np.arange(count) % 2, low, low + rng.uniform(0.15, 0.3))
    elif kind == 3:  # a hand-held lamp, mostly from one side
        z, azimuth = rng.uniform(0.4, 0.95, count), rng.normal(azimuth[0], 1.3, count)
    else:  # a spiral
        z = np.linspace(rng.uniform(0.45, 0.6), rng.uniform(0.85, 0.99), count)
        azimuth = 2.4 * np.arange(count)
    height = np.asarray(z + rng.normal(0, 0.01, count), np.float64).clip(0.25, 0.995)
    across = np.sqrt(1 - height**2)
    return np.stack((across * np.cos(azimuth), across * np.sin(azimuth), height), axis=1)


def draw_mesh(shape: str, rng: np.random.Generator) -> Mesh | None:
    if shape == "sphere":
        return sphere(count=150)
    if not shape:
        return None
    steepness = {"relief": (0.5, 1.2), "plane": (0, 0), "low relief": (0.05, 0.4)}[shape]
    scale = np.array((1, 1, rng.uniform(*steepness)))
    field = height_field("relief", 201)
    normals = field.vertex_normals / field.vertex_normals[:, 2:] * (scale[2], scale[2], 1)
    vertices = (field.vertices * scale).astype(np.float32)
    return Mesh(vertices, field.faces, unit(normals).astype(np.float32))


def render(seed: int, index: int) -> Iterator[Rendered]:
    """Yield a scene in some materials, under lights and lamps of its own."""
    rng = np.random.default_rng([seed, index])
    mesh, size = draw_mesh(SHAPES[index % len(SHAPES)], rng), int(rng.choice((48, 64, 80)))
    scene, lights = (
        draw_scene(seed, index, SceneConfig(size=size, lights=4), mesh),
        draw_lights(rng),
    )
    tracer = Tracer(scene.mesh)
    visible = find_visible_surface(tracer, size, 2)
    others = rng.choice(
        [*scene.materials, *ANALYTIC, *ANALYTIC], MATERIALS_PER_SCENE - 1, replace=False
    )
    names = {str(rng.choice(list(scene.materials))), *map(str, others)}
    surface = (
        {name: each for name, each in scene.materials.items() if name in names},
        scene.patch_of_face,
    )
    middle = np.array((0, 0, visible.samples.position[:, 2].mean(dtype=np.float64)))
    width = np.ptp(np.flatnonzero(visible.mask.any(axis=0))) * 2 / size
    positions = lights * np.exp(rng.uniform(np.log(1.5), np.log(6))) * width
    falloff = np.sum((positions + middle) ** 2, axis=1) / np.sum(positions**2, axis=1)
    towards = lights.astype(np.float32)
    with torch.inference_mode():
        distant = render_direct(tracer, visible, towards, *surface)
        near = render_point_lights(tracer, visible, positions + middle, *surface)
        indirect = render_indirect(
            tracer,
            visible,
            towards,
            *surface,
            directions=32,
            bounces=2,
            generator=torch.Generator().manual_seed(index),
        )
    for name, bounced in indirect.items():
        images = (distant[name] + bounced).numpy(), near[name].numpy() / falloff + bounced.numpy()
        yield Rendered(name, visible.mask, lights, *images)
    normals = np.asarray(visible.normals, np.float64)
    albedo = np.exp(rng.normal(0, rng.choice((0.0, 0.3)), (len(normals), 1)))
    lamps = NearLamps.of(positions / 2 * size, 1.0, visible.mask.shape, equal=True)
    at, falls = lamps.light_at(lamps.plane_points(*np.nonzero(visible.mask)))
    for name in sorted(names & set(ANALYTIC)):
        strength = rng.uniform(0.2, 0.8)
        far, close = (
            albedo
            * shading(
                name, strength, (each * normals[:, None]).sum(axis=2), each[..., 2], normals[:, 2:]
            )
            for each in (lights, np.asarray(at, np.float64))
        )
        yield Rendered(name, visible.mask, lights, far, close * falls)


def shading(name: str, strength: float, cosines: Array, light_z: Array, normal_z: Array) -> Array:
    """Return the shading (P, F) of a material without cast shadows, under lights with the given z:
    exactly matte; retroreflecting; rough, after Oren and Nayar (1994); or translucent, so that
    light which enters comes out beyond the terminator.
    """
    if name == TRANSLUCENT:
        return np.asarray((cosines + strength).clip(0) / (1 + strength))
    lit = cosines.clip(0)
    if name == "ideal":
        return lit
    if name == "retro":  # fabric that reflects towards the light, and at grazing angles
        grazing = (1 - np.sqrt((1 + light_z.clip(-1)) / 2)) ** 2
        return np.asarray(lit * (1 + 2 * strength * light_z.clip(0) ** 4 + 8 * strength * grazing))
    squared = 2 * strength**2
    along = light_z - cosines * normal_z
    along = np.where(along > 0, along / np.maximum(np.maximum(lit, normal_z), 0.05), along)
    first, second = 1 - 0.5 * squared / (squared + 0.33), 0.45 * squared / (squared + 0.09)
    return np.asarray(lit * (first + second * along).clip(0))


def captures(scene: Rendered, rng: np.random.Generator) -> Iterator[tuple[str, Array, Array]]:
    """Yield the class of a capture, its stored values (P, F), and the lights (F, 3) given for it;
    first of the right capture.
    """
    count, peak = len(scene.lights), rng.choice((1.0, 1.0, 0.6, 0.3))
    noise, bits = rng.choice((0.0, 0.0005, 0.002, 0.005)), int(rng.choice((8, 16, 16, 16)))

    def stored(light: Array, gamma: float | None = 1.0) -> Array:
        values = peak * light / np.quantile(light, rng.choice((0.98, 0.999)))
        values = (values + rng.normal(0, noise, values.shape)).clip(0, 1)
        values = encode_srgb(values) / 255.0 if gamma is None else values ** (1 / gamma)
        return np.asarray(np.rint(values * (2**bits - 1)) / (2**bits - 1))

    right = RIGHT if scene.material != TRANSLUCENT else TRANSLUCENT
    light, lights = scene.distant, scene.lights
    yield right, stored(light), lights
    unequal = light * np.exp(rng.normal(0, rng.choice((0.1, 0.2, 0.4, 0.7)), count))
    share = rng.choice((0.05, 0.15, 0.5, 1.0)) * light.mean(axis=1, keepdims=True)
    height = rng.choice((0.4, 0.55, 0.65, 0.75, 0.85, 1.2, 1.4, 2.0, 2.4))
    azimuth, degrees = rng.uniform(0, 2 * np.pi), rng.choice((10, 15, 20, 30))
    axis = np.radians(degrees) * np.array((np.cos(azimuth), np.sin(azimuth), 0))
    place = rng.integers(count)
    odd = light.copy()
    odd[:, place] = light[:, (place + 1) % count]
    images = np.zeros((count, *scene.mask.shape))
    images[:, scene.mask] = light.T
    blur = (0, *[rng.uniform(1, 4)] * 2)
    moved = images.copy()
    moved[: count // 2] = np.roll(moved[: count // 2], rng.integers(2, 6), axis=1 + count % 2)
    faults = [
        ("curve", lambda: stored(light, None), lights),
        ("curve", lambda: stored(light, rng.choice((1.8, 2.2, 2.4))), lights),
        ("curve", lambda: stored(unequal, rng.choice((1.8, 2.2, None))), lights),
        ("offset", lambda: stored(light + share / lights[:, 2].mean()), lights),
        ("intensities", lambda: stored(unequal), lights),
        ("elevation", lambda: stored(light), unit(lights * (1, 1, height))),
        ("elevation", lambda: stored(light), unit(lights * (1, 1, 1 / height))),
        (TILTED, lambda: stored(light), lights @ Rotation.from_rotvec(axis).as_matrix().T),
        (right, lambda: stored(light), lights * rng.choice(((-1, 1, 1), (1, -1, 1), (-1, -1, 1)))),
        (right, lambda: stored(light), np.roll(lights, 1, axis=0)),
        (TILTED, lambda: stored(light), lights @ Rotation.from_rotvec(-axis).as_matrix().T),
        (right, lambda: stored(odd), lights),
        (right, lambda: stored(gaussian_filter(images, blur)[:, scene.mask].T), lights),
        (right, lambda: stored(moved[:, scene.mask].T), lights),
    ]
    if right == RIGHT:
        faults.append(("near", lambda: stored(scene.near), lights))
    chosen = rng.choice(len(faults), FAULTS_PER_CAPTURE, replace=False)
    for kind, values, given in [faults[each] for each in chosen]:
        if (given[:, 2] > 0.02).all():
            yield kind, values(), given


def evidence(
    values: Array, lights: Array, mask: NDArray[np.bool_], *, measured: bool, eight_bit: bool
) -> Evidence:
    """Return what the checks know of stored values (P, F)."""
    capture = Capture(
        "rendered", values.astype(np.float32), lights, tuple(range(len(lights))), mask
    )
    found = None if measured else estimate_light_intensities(capture.observations, None, lights)
    source = ArraySource(
        images=[],
        mask=mask,
        light_directions=lights,
        light_intensities=np.ones((len(lights), 3)),
        intensities_known=measured,
        intensities_measured=measured,
    )
    seen = Evidence.of(source, capture)
    return replace(seen, estimated=found, eight_bit=eight_bit)


def draw(path: Path, scenes: int, seed: int) -> None:
    """Store features, classes and scenes of captures."""
    rows: list[tuple[Array, int, int, str]] = []
    if path.exists():
        with np.load(path) as stored:
            rows = list(zip(*(stored[name] for name in COLUMNS), strict=True))
    first = max((row[2] for row in rows), default=-1) + 1
    for index in range(first, scenes):
        rng = np.random.default_rng([seed, index, 1])
        for scene in render(seed, index):
            for kind, values, lights in captures(scene, rng):
                eight_bit = bool((np.rint(values * 255) == values * 255).all())
                seen = evidence(
                    values, lights, scene.mask, measured=rng.random() < 0.5, eight_bit=eight_bit
                )
                features = features_of(seen)
                if features is not None:
                    rows.append((features, CLASSES.index(kind), index, scene.material))
        new = path.with_suffix(".part.npz")
        np.savez(new, **dict(zip(COLUMNS, map(np.array, zip(*rows, strict=True)), strict=True)))
        new.replace(path)
        print(index, len(rows), flush=True)


def fit(features: Array, classes: NDArray[np.int64], weights: Array) -> JudgeNet:
    """Return the network that was trained on features (N, D) of captures with weights (N,)."""
    mean, deviation = features.mean(axis=0), features.std(axis=0) + 1e-6
    scaled = torch.tensor(((features - mean) / deviation).clip(-3, 3), dtype=torch.float32)
    right, weight = torch.tensor(classes), torch.tensor(weights / weights.sum()).float()
    members = []
    for seed in range(MEMBERS):
        torch.manual_seed(seed)
        net = torch.nn.Sequential(
            torch.nn.Linear(scaled.shape[1], HIDDEN),
            torch.nn.Tanh(),
            torch.nn.Dropout(0.3),
            torch.nn.Linear(HIDDEN, len(CLASSES)),
        )
        optimizer = torch.optim.AdamW(net.parameters(), 1e-2, weight_decay=0.5)
        for step in range(STEPS):
            optimizer.param_groups[0]["lr"] = 1e-2 * (1 - step / STEPS)
            noisy = scaled + 0.2 * torch.randn_like(scaled)
            losses = torch.nn.functional.cross_entropy(net(noisy), right, reduction="none")
            optimizer.zero_grad()
            (weight * losses).sum().backward()
            optimizer.step()
        members.append([each.detach().double().numpy() for each in net.parameters()])
    hidden, hidden_bias, output, output_bias = (
        np.stack(each) for each in zip(*members, strict=True)
    )
    return JudgeNet(
        mean, deviation, hidden.swapaxes(1, 2), hidden_bias, output.swapaxes(1, 2), output_bias
    )


def train(paths: Sequence[Path], output: Path | None) -> None:
    """Print the errors of networks on scenes that they were not trained on, and save one of all."""
    stored = [dict(np.load(path)) for path in paths]
    features = np.concatenate([each["features"] for each in stored]).clip(-15, 15)
    classes = np.concatenate([each["classes"] for each in stored])
    materials = np.concatenate([each["materials"] for each in stored])
    scenes = np.concatenate([place * 100_000 + each["scenes"] for place, each in enumerate(stored)])
    rest = (1 - sum(PRIOR.values())) / (len(CLASSES) - len(PRIOR))
    weights = np.array([PRIOR.get(CLASSES[each], rest) for each in classes])
    weights /= np.bincount(classes)[classes]
    weights[materials == "retro"] *= RARE
    found = np.empty((len(classes), len(CLASSES)))
    for fold in range(FOLDS):
        held = scenes % FOLDS == fold
        net = fit(features[~held], classes[~held], weights[~held])
        found[held] = net.probabilities(features[held])
    surprise = -(weights * np.log(found[np.arange(len(classes)), classes])).sum() / weights.sum()
    print(f"{len(classes)} captures, surprise {surprise:.4f}")
    doubt, best = found[:, 2:].sum(axis=1), 2 + found[:, 2:].argmax(axis=1)
    kinds = np.array([each.split("-")[0] for each in materials])
    for least in (0.3, 0.5, 0.7, 0.95):
        named = doubt > least
        for kind in np.unique(kinds):
            of_kind = (classes < 2) & (kinds == kind)
            print(f"{least:.2f} {kind:12} right, doubted {100 * named[of_kind].mean():5.1f} %")
        for place, name in enumerate(CLASSES[2:], 2):
            own = classes == place
            shares = (
                100 * (named & own & each).sum() / own.sum()
                for each in (best == place, best != place)
            )
            print(
                f"{least:.2f} {name:12} named {next(shares):5.1f} %, misnamed {next(shares):5.1f} %"
            )
    if output is not None:
        net = fit(features, classes, weights)
        save_file(
            {name: np.ascontiguousarray(each, np.float32) for name, each in net._asdict().items()},
            output,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    drawing, training = commands.add_parser("draw"), commands.add_parser("train")
    drawing.add_argument("file", type=Path)
    drawing.add_argument("--scenes", type=int, default=100)
    drawing.add_argument("--seed", type=int, default=1)
    training.add_argument("files", type=Path, nargs="+")
    training.add_argument("-o", "--output", type=Path)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.command == "draw":
        draw(options.file, options.scenes, options.seed)
    else:
        train(options.files, options.output)


if __name__ == "__main__":
    main()
