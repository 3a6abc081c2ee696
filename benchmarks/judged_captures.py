"""Captures as users have them, right and faulty ones, for benchmarks/judgement.py.

A folder has images, lights, sometimes intensities, a mask, the true normals, and `truth.json`.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from judged_scenes import ARRANGEMENTS, MATERIALS, SHAPES, Floats, Random, draw_lights, render
from splinecli.capture.light_rows import parse_light_frame
from splinecli.maths.normals import unit
from splinecli.workshop.synthesis.batches import add_sensor_noise
from wrong_lights import FRAMES

OTHER = "lights_contradicted"
LIGHTS = ("light_frame", "light_order", OTHER)  # under a ring, a shift of the order is a rotation
CURVE, NEAR = "nonlinearity_suspected", "near_lights_suspected"
FAULTS: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "tilt": (("5", "15", "30"), ("lights_tilted", OTHER)),
    "elevation": (("0.4", "0.65", "0.85", "1.4", "2"), ("elevation_suspected", OTHER)),
    "near": (("2", "3", "5"), (NEAR,)),
    "encoded": (("gamma1.8", "gamma2.2", "srgb"), (CURVE,)),
    "encoded_unequal": (("gamma1.8", "gamma2.2", "srgb"), (CURVE,)),
    "encoded_near": (("gamma2.2", "srgb"), (CURVE, NEAR)),
    "ambient": (("5", "15"), ("constant_light",)),
    "unequal": (("0.3", "0.6"), ("unequal_intensities", "estimated_intensities")),
    "inverted": (("0.5",), ("unequal_intensities",)),
    "frame": (("x negated", "y negated", "x and y exchanged", "x and y negated"), LIGHTS),
    "order": (("shifted", "reversed", "interleaved"), LIGHTS),
    "half_vectors": (("1",), ("light_frame", "elevation_suspected", OTHER)),
    "zenith": (("1",), ("light_frame", "elevation_suspected", OTHER)),
    "rotated": (("30",), LIGHTS),
    "moved_one": (("6",), ("images_shifted", "image_inconsistent")),
    "moved_half": (("6",), ("images_shifted",)),
    "defocus": (("2", "4"), ("soft_images",)),
    "odd_lamp": (("elsewhere", "failed"), ("image_inconsistent", "image_scale", "dark_images")),
    "dark": (("0.2",), ("dark_images",)),
}
"""For each kind of fault its degrees, and the codes of the warnings that name it."""


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
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REPLICATE), "f8")


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
    half = rng.permutation(n_lights)[: n_lights // 2].tolist()
    for each in {"moved_one": [odd], "moved_half": half}.get(kind, []):
        images[each] = shift(images[each], rng, 3 if kind == "moved_one" else 2, 6)
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
