"""How the checks of a capture, and what is mended, behave on right and on faulty captures.

    python benchmarks/judgement.py render FOLDER [--right 150] [--faulty 300] [--seed S]
    python benchmarks/judgement.py measure FOLDER OUT [--method spline-net] [--part I/N]
    python benchmarks/judgement.py report OUT [OUT_BEFORE]

`render` makes capture folders as users have them: ten kinds of shapes, up to ten materials, five
arrangements of lights. `measure` runs `infer` on each, then again with every option that a warning
names as a remedy. `report` prints tables in Markdown, or two measurements side by side. All
continue where they were interrupted; --part I/N takes every N-th capture.
"""

import argparse
import json
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from judged_scenes import ARRANGEMENTS, MATERIALS, SHAPES, draw_lights, render
from splinecli.capture.light_rows import parse_light_frame
from splinecli.errors import SplinecliError
from splinecli.maths.normals import unit
from splinecli.pipeline.infer import infer_capture, make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.records.capture_warnings import PROBABLY_WRONG
from splinecli.workshop.synthesis.batches import add_sensor_noise
from wrong_lights import FRAMES

Floats = NDArray[np.floating]
Random = np.random.Generator

LIGHTS = ("light_frame", "light_order")  # under a ring, a shift of the order is a rotation
CURVE, NEAR = "nonlinearity_suspected", "near_lights_suspected"
FAULTS: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "tilt": (("5", "15", "30"), ("lights_tilted",)),
    "elevation": (("0.4", "0.65", "0.85", "1.4", "2"), ("elevation_suspected",)),
    "near": (("2", "3", "5"), (NEAR,)),
    "encoded": (("gamma1.8", "gamma2.2", "srgb"), (CURVE,)),
    "encoded_unequal": (("gamma1.8", "gamma2.2", "srgb"), (CURVE,)),
    "encoded_near": (("gamma2.2", "srgb"), (CURVE, NEAR)),
    "ambient": (("5", "15"), ("constant_light",)),
    "unequal": (("0.3", "0.6"), ("unequal_intensities", "estimated_intensities")),
    "inverted": (("0.5",), ("unequal_intensities",)),
    "frame": (("x negated", "y negated", "x and y exchanged", "x and y negated"), LIGHTS),
    "order": (("shifted", "reversed", "interleaved"), LIGHTS),
    "half_vectors": (("1",), ("light_frame", "elevation_suspected")),
    "zenith": (("1",), ("light_frame", "elevation_suspected")),
    "rotated": (("30",), LIGHTS),
    "moved_one": (("6",), ("images_shifted", "image_inconsistent")),
    "moved_half": (("6",), ("images_shifted",)),
    "defocus": (("2", "4"), ("soft_images",)),
    "odd_lamp": (("elsewhere", "failed"), ("image_inconsistent", "image_scale")),
    "dark": (("0.2",), ("dark_images", "eight_bit")),
}
"""For each kind of fault its degrees, and the codes of the warnings that name it."""

NO_CAUSE = {"low_confidence", "unknown_material"}  # warnings that accuse no input
UNDO = {"estimated_intensities", "estimated_colours", "display_decoded"}
"""Warnings whose text says how to undo what was done, not how to mend."""

REMEDIES: dict[str, tuple[str, Callable[[str], dict[str, Any]]]] = {
    "transfer": (
        r"--transfer (srgb|linear|gamma:[\d.]*\d)(?: or (gamma:[\d.]*\d))?",
        lambda text: {"transfer": text},
    ),
    "distance": (
        r"--light-distance ([\d.]*\d) --object-width 1",
        lambda text: {"light_distance": float(text), "object_width": 1.0},
    ),
    "frame": (
        r"--light-frame ([\w,-]*\w)(?: or ([\w,-]*\w))?",
        lambda text: {"light_frame": text},
    ),
    "intensities": (r"--intensities (equal)", lambda text: {"intensities": text}),
    "refine": (r"--refine-lights()", lambda text: {"refine_lights": True}),
    "align": (r"--align()", lambda text: {"align": True}),
    "auto-mask": (r"--auto-mask()", lambda text: {"auto_mask": True}),
}
"""The options that warnings name, and what they set."""


# Render


def plan(number: int, n_right: int) -> tuple[str, str]:
    """Return the kind and the degree of the fault of a capture, or `right` and how its lamps are
    known: `file`, `equal` without a file, or `unknown`.
    """
    if number < n_right:
        return "right", ("file", "equal", "file", "equal", "equal", "file", "unknown")[number % 7]
    every = [(kind, degree) for kind, (degrees, _) in FAULTS.items() for degree in degrees]
    return every[(number - n_right) % len(every)]


def stated_lights(kind: str, degree: str, lights: Floats, rng: Random) -> Floats:
    """Return the lights (F, 3) as a file with this fault gives them."""
    if kind == "tilt":
        angle = rng.uniform(0, 2 * np.pi)
        axis = np.array((np.cos(angle), np.sin(angle), 0))
        return lights @ Rotation.from_rotvec(np.radians(float(degree)) * axis).as_matrix().T
    if kind == "elevation":
        return unit(lights * (1, 1, float(degree)))
    if kind == "frame":
        return lights @ np.linalg.inv(parse_light_frame(FRAMES[degree]).matrix).T
    if kind == "rotated":
        turn = Rotation.from_euler("z", rng.choice((-1, 1)) * float(degree), degrees=True)
        return lights @ turn.as_matrix().T
    if kind == "half_vectors":
        return unit(lights + np.array((0, 0, 1)))
    if kind == "zenith":
        across = np.linalg.norm(lights[:, :2], axis=1, keepdims=True)
        return np.concatenate((lights[:, :2] / across * lights[:, 2:], across), axis=1)
    if kind == "order":
        places = np.arange(len(lights))
        interleaved = np.concatenate((places[::2], places[1::2]))
        return lights[
            {"shifted": np.roll(places, 1), "reversed": places[::-1]}.get(degree, interleaved)
        ]
    return lights


def encode(values: Floats, curve: str) -> Floats:
    """Encode linear values from 0 to 1 with `srgb` or `gammaG`."""
    if curve == "srgb":
        return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    return np.asarray(values ** (1 / float(curve.removeprefix("gamma"))))


def expose(images: Floats, bright: float, blur: float, rng: Random) -> Floats:
    """Photograph radiance (F, H, W), `bright` at full scale, blurred and with noise."""
    images = images / bright
    images = gaussian_filter(images, (0, blur, blur), mode="nearest").clip(0, 1)
    generator = torch.Generator().manual_seed(int(rng.integers(2**40)))
    flat = torch.from_numpy(images.reshape(1, -1))
    return add_sensor_noise(flat, generator).numpy().reshape(images.shape)


def shift(image: Floats, rng: Random, least: float, most: float) -> Floats:
    """Move an image (H, W) by some pixels."""
    angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(least, most)
    move = np.array(((1, 0, reach * np.cos(angle)), (0, 1, reach * np.sin(angle))))
    return cv2.warpAffine(image, move, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE)


def draw_intensities(kind: str, degree: str, count: int, rng: Random) -> Floats:
    """Return the intensities of the lamps (F,), with mean 1."""
    spread = {
        "right": {"file": 0.25, "unknown": 0.25}.get(degree, 0),
        "unequal": float(degree) if kind == "unequal" else 0,
        "inverted": 0.5,
        "encoded_unequal": 0.25,
        "encoded": 0,
        "encoded_near": 0,
    }.get(kind, rng.choice((0, 0.2)))
    found = np.exp(np.clip(rng.normal(size=count), -2, 2) * spread)
    return np.asarray(found / found.mean())


def make_capture(
    folder: Path, number: int, n_right: int, seed: int, files: tuple[Sequence[Path], Path | None]
) -> None:
    """Render capture `number` and write its folder."""
    rng = np.random.default_rng([seed, number])
    kind, degree = plan(number, n_right)
    names = [*SHAPES, *(["mesh"] if files[0] else [])]
    shape = names[number % len(names)] if kind == "right" else str(rng.choice(names))
    looks = [name for name in MATERIALS if name != "measured" or files[1] is not None]
    place = number // len(names) + number if kind == "right" else rng.integers(len(looks))
    material = looks[int(place) % len(looks)]
    arrangement = str(rng.choice(ARRANGEMENTS))
    n_lights = round(6 * 5 ** rng.random())
    widest = 86 - float(degree) if kind == "tilt" else 90.0
    lights = draw_lights(arrangement, n_lights, min(rng.uniform(50, 70), widest), rng)
    rendered = lights
    if kind == "odd_lamp":
        rendered = np.concatenate((lights, draw_lights("hand-held", 6, 65, rng)))
    size = int(rng.choice((64, 72, 80, 80, 112), p=(0.3, 0.3, 0.2, 0.15, 0.05)))
    widths = {"near": degree, "encoded_near": "3"}.get(kind)
    near = None if widths is None else float(widths)
    scene = render(shape, material, size, rendered, near, rng, files)

    intensities = draw_intensities(kind, degree, n_lights, rng)
    radiance = scene.radiance[:, :n_lights] * intensities
    odd = int(rng.integers(n_lights))
    if kind == "odd_lamp":
        far = n_lights + np.argmin(rendered[n_lights:] @ lights[odd])
        radiance[:, odd] = (
            scene.radiance[:, far] if degree == "elsewhere" else 0.03 * radiance[:, odd]
        )
    if kind == "ambient":  # as a share of the light of a lamp that the surface faces
        share = float(degree) / 100 / lights[:, 2].mean()
        radiance = radiance + share * radiance.mean(axis=1, keepdims=True)
    images = np.zeros((n_lights, *scene.mask.shape))
    images[:, scene.mask] = radiance.T
    normals = np.zeros((*scene.mask.shape, 3), np.float32)
    normals[scene.mask], mask = scene.normals, scene.mask
    if not mask.all():
        margin = rng.integers(2, 9, (2, 2))
        images, mask = np.pad(images, ((0, 0), *margin)), np.pad(mask, margin)
        normals = np.pad(normals, (*margin, (0, 0)))
    moved = {"moved_one": [odd], "moved_half": rng.permutation(n_lights)[: n_lights // 2]}
    for each in moved.get(kind, []):
        images[each] = shift(images[each], rng, *((3, 6) if kind == "moved_one" else (2, 6)))
    tint = rng.uniform(0.5, 1, 3) if rng.random() < 0.5 else np.ones(1)
    peak = float(degree) if kind == "dark" else rng.uniform(0.55, 1.0)
    blur = float(degree) if kind == "defocus" else rng.uniform(0.2, 0.6)
    bits = 8 if kind == "dark" or rng.random() < (0.5 if "encoded" in kind else 0.25) else 16
    clipped = 1e-3 if kind == "dark" else 10 ** rng.uniform(-3, -1.8)  # or nearly
    bright = np.quantile(images[:, mask], 1 - clipped) / peak
    channels = [expose(images, bright * tint.max() / t, blur, rng) for t in tint]
    if kind.startswith("encoded"):
        channels = [encode(values, degree) for values in channels]
    unknown = kind in ("unequal", "encoded_unequal") or degree == "unknown"
    known = not unknown and bool(np.ptp(intensities) > 0)
    truth = {
        "kind": kind,
        "degree": degree,
        "material": material,
        "shape": shape,
        "arrangement": arrangement,
        "n_lights": n_lights,
        "bits": bits,
        "size": size,
        "intensities": intensities.tolist(),
        "true_lights": lights.tolist(),
    }
    stated = stated_lights(kind, degree, lights, rng)
    stated[:, 2] = stated[:, 2].clip(0.02)
    given = 1 / intensities if kind == "inverted" else intensities
    write_capture(folder, np.stack(channels, axis=-1), bits, mask, normals)
    np.savetxt(folder / "light_directions.txt", unit(stated), fmt="%.6f")
    if known:
        np.savetxt(folder / "light_intensities.txt", np.tile(given[:, None], 3), fmt="%.6f")
    (folder / "truth.json").write_text(json.dumps(truth))  # last: the capture is complete


def write_capture(
    folder: Path, images: Floats, bits: int, mask: NDArray[np.bool_], normals: Floats
) -> None:
    """Write images (F, H, W, C) from 0 to 1, the mask and the true normals."""
    folder.mkdir(parents=True, exist_ok=True)
    stored = np.rint(images * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    for number, image in enumerate(stored, 1):
        cv2.imwrite(str(folder / f"im_{number:02d}.png"), image)
    if not mask.all():
        cv2.imwrite(str(folder / "mask.png"), mask * np.uint8(255))
    np.save(folder / "normal_gt.npy", normals)


def render_all(options: argparse.Namespace) -> None:
    part, parts = map(int, options.part.split("/"))
    meshes = sorted(options.shapes.glob("*.ply")) if options.shapes else []
    for number in range(part - 1, options.right + options.faulty, parts):
        kind, degree = plan(number, options.right)
        name = f"{number:03d}.{kind}.{degree}".replace(" ", "_")
        if not (options.folder / name / "truth.json").exists():
            make_capture(
                options.folder / name, number, options.right, options.seed, (meshes, options.merl)
            )


# Measure


def run(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Run `infer` and return what is kept of its report, or the text of its error."""
    with tempfile.TemporaryDirectory() as output:
        try:
            report = infer_capture(folder, options.replace(output=output), load=load)
        except SplinecliError as error:
            return {"exception": f"{type(error).__name__}: {error}"}
    errors = report["angular_error_deg"]
    warnings = [each | {"is_error": each["code"] in PROBABLY_WRONG} for each in report["warnings"]]
    return {
        "mae": errors["mean"],
        "median": errors["median"],
        "true_under_5": errors["under_5"],
        "expected_under_5": report["expected_under_5"],
        "warnings": warnings,
        "mended": report.get("mended") or [],
        "seconds": report["seconds"]["total"],
        "check_seconds": report["seconds"].get("check"),
    }


def as_given(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Run `infer` without mending."""
    return run(folder, options.replace(as_stored=False), load)


def named_remedies(warnings: Iterable[dict[str, Any]]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield the code of each warning that names a remedy, the remedy, and its values.

    Of two frames, the user knows which is right: they are one remedy. Two curves are two.
    """
    for warning in warnings:
        if warning["code"] in UNDO:
            continue
        for name, (pattern, _) in REMEDIES.items():
            for found in re.finditer(pattern, warning["text"]):
                values = [value for value in found.groups() if value is not None]
                for group in [values] if name == "frame" else [[value] for value in values]:
                    yield warning["code"], name, group


def measure_one(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Return what `infer` makes of a capture, as given, and after each remedy that it names."""
    result = {
        "truth": json.loads((folder / "truth.json").read_text()),
        **run(folder, options, load),
    }
    if result.get("mended"):
        result["as_given"] = as_given(folder, options, load)
    result["remedies"] = []
    for code, name, values in named_remedies(result.get("warnings", [])):
        tries = [run(folder, options.replace(**REMEDIES[name][1](value)), load) for value in values]
        best = min(tries, key=lambda each: each.get("mae", np.inf))
        result["remedies"].append({"code": code, "remedy": name, "values": values, **best})
    return result


def measure_all(options: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    part, parts = map(int, options.part.split("/"))
    infer = InferOptions(method=options.method)
    load = cache(partial(make_method, infer))
    options.out.mkdir(parents=True, exist_ok=True)
    folders = sorted(path.parent for path in options.folder.glob("*/truth.json"))
    for folder in folders[part - 1 :: parts]:
        stored = options.out / f"{folder.name}.json"
        if not stored.exists():
            stored.write_text(json.dumps(measure_one(folder, infer, load)))


# Report


def report(options: argparse.Namespace) -> None:
    raise NotImplementedError


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    each = commands.add_parser("render")
    each.add_argument("folder", type=Path)
    each.add_argument("--right", type=int, default=150)
    each.add_argument("--faulty", type=int, default=300)
    each.add_argument("--seed", type=int, default=1)
    each.add_argument("--shapes", type=Path, help="folder of meshes (*.ply), another kind of shape")
    each.add_argument("--merl", type=Path, help="merl_nbrdf.npz, measured materials")
    each.add_argument("--part", default="1/1")
    each.set_defaults(run=render_all)
    each = commands.add_parser("measure")
    each.add_argument("folder", type=Path)
    each.add_argument("out", type=Path)
    each.add_argument("--method", default="spline-net")
    each.add_argument("--part", default="1/1")
    each.set_defaults(run=measure_all)
    each = commands.add_parser("report")
    each.add_argument("out", type=Path)
    each.add_argument("before", type=Path, nargs="?")
    each.set_defaults(run=report)
    options = parser.parse_args(arguments)
    options.run(options)


if __name__ == "__main__":
    main()
