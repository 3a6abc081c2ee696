"""Lights, shapes and captures of known normals, which the tests of many rooms share."""

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.estimate.methods.estimator import Estimator

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


FOUR_LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.48, -0.36, 0.8]])


def directions_at(azimuth: Floats, zenith: Floats | float) -> Floats:
    """Return the unit directions (count, 3) at these angles in radians."""
    x, y, z = np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)
    return np.stack((x, y, np.broadcast_to(z, x.shape)), axis=1)


def cap_directions(count: int, limit_deg: float, seed: int = 0, *, even: bool = False) -> Floats:
    """Random unit vectors (count, 3) within limit_deg of the view axis: even by angle, or even over
    the cap.
    """
    rng = np.random.default_rng(seed)
    azimuth, limit = rng.uniform(0, 2 * np.pi, count), np.radians(limit_deg)
    zenith = limit * (np.sqrt(rng.uniform(0, 1, count)) if even else rng.uniform(0, 1, count))
    return directions_at(azimuth, zenith)


def spiral_lights(count: int, limit_deg: float = 35, start_deg: float = 5) -> Floats:
    """Lights (count, 3) on a spiral, from start_deg to limit_deg from the view axis."""
    return directions_at(
        np.arange(count) * 2.4, np.radians(np.linspace(start_deg, limit_deg, count))
    )


def ring_lights(count: int, zenith_deg: float = 40, first_rad: float = 0.0) -> Floats:
    """Lights (count, 3) evenly on a ring."""
    return directions_at(first_rad + np.arange(count) * 2 * np.pi / count, np.radians(zenith_deg))


def square_grid(size: int, reach: float = 1.0) -> tuple[Floats, Floats]:
    """Return x (right) and y (up) of size x size points, from -reach to reach."""
    axis = np.linspace(-reach, reach, size)
    x, y = np.meshgrid(axis, -axis)
    return x, y


def sphere(size: int, reach: float = 0.97) -> tuple[Floats, Mask]:
    """Normals (size, size, 3) of a unit sphere that touches the frame, and the mask of radius
    `reach`.
    """
    x, y = square_grid(size)
    inside = np.hypot(x, y) < reach
    return np.stack((x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))), axis=-1), inside


def sphere_cap(size: int, reach: float = 0.65) -> Floats:
    """Normals (size, size, 3) of the part of a unit sphere that fills a square of half width
    `reach`.
    """
    x, y = square_grid(size, reach)
    return np.stack((x, y, np.sqrt(1 - x**2 - y**2)), axis=-1)


def halfway(lights: Floats) -> Floats:
    """Return the unit vectors (F, 3) between the lights and the view axis."""
    half = lights + np.array((0.0, 0.0, 1.0))
    return np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))


def shade(
    normals: Floats, lights: Floats, *, gloss: float = 0.0, exponent: float = 30, noise: float = 0.0
) -> Floats:
    """Observations (..., F): Lambert's cosine, a Blinn-Phong lobe, attached shadows, and noise of
    this deviation.
    """
    cosine = np.clip(normals @ lights.T, 0, None)
    seen = cosine + gloss * np.clip(normals @ halfway(lights).T, 0, None) ** exponent * (cosine > 0)
    if noise:
        seen = seen + np.random.default_rng(5).normal(0, noise, seen.shape)
    return np.asarray(np.clip(seen, 0, None))


def to_uint16(values: NDArray[Any]) -> NDArray[np.uint16]:
    """Round values to those that a 16-bit image stores."""
    return np.rint(values).astype(np.uint16)


def read_image(path: str | Path) -> Any:
    """The pixels of an image as OpenCV reads them: BGR, in their own type."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def put(path: Path, text: str = "", encoding: str = "utf-8") -> Path:
    """Write a text into a file, whose folder need not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode(encoding))
    return path


def write_image(path: str | Path, pixels: NDArray[Any]) -> Path:
    """Write pixels (H, W) or (H, W, 3) BGR in the format of the name; the folder need not exist."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def read_json(path: str | Path) -> Any:
    return json.loads(Path(path).read_text("utf-8"))


def codes(found: Any) -> list[str]:
    """The codes of warnings, also of those in a report or of a capture."""
    found = found["warnings"] if isinstance(found, dict) else getattr(found, "warnings", found)
    return [each["code"] if isinstance(each, dict) else each.code for each in found]


def write_capture(
    folder: Path,
    images: NDArray[np.generic],
    lights: NDArray[np.floating] | None,
    *,
    mask: Mask | None = None,
    normals: NDArray[np.floating] | None = None,
    intensities: NDArray[np.floating] | None = None,
    names: str = "{:03}.png",
    first: int = 0,
) -> Path:
    """Write images (F, H, W) or (F, H, W, 3) RGB as PNGs, with the lights and what else is
    given.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images, start=first):
        stored = image if image.ndim == 2 else image[..., ::-1]
        write_image(folder / names.format(number), stored)
    if lights is not None:
        np.savetxt(folder / "light_directions.txt", lights, fmt="%.9f")
    if mask is not None:
        write_image(folder / "mask.png", mask.astype(np.uint8) * 255)
    if normals is not None:
        np.save(folder / "normals_gt.npy", normals)
    if intensities is not None:
        np.savetxt(folder / "light_intensities.txt", intensities)
    return folder


def decode_rgb(png: bytes) -> NDArray[np.uint8]:
    """RGB (H, W, 3) of an encoded picture."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])


def png_chunk(name: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def with_chunk(png: bytes, name: bytes, content: bytes) -> bytes:
    """A PNG with one more chunk after its header."""
    return png[:33] + png_chunk(name, content) + png[33:]


BUMP_MM = 64.0
BUMP_LAMPS = (
    np.array(
        [
            (0, 20, 200),
            (70, 10, 170),
            (-80, 20, 160),
            (20, 90, 150),
            (-10, -80, 170),
            (60, 60, 140),
            (-60, -70, 150),
        ]
    )
    * 1.0
)
"""Lamps in millimetres, at about three widths of the object."""


def write_bump(folder: Path, positions: Floats = BUMP_LAMPS, *, distant: bool = False) -> Path:
    """Write a matte bump of 32 x 32 pixels, 64 mm wide, without a mask or lights, under near or
    distant lamps.
    """
    x, y = square_grid(32, BUMP_MM / 2 * (1 - 1 / 32))
    heights = 8 * np.cos(x / 20) * np.cos(y / 25)
    slopes = 8 / 20 * np.sin(x / 20) * np.cos(y / 25), 8 / 25 * np.cos(x / 20) * np.sin(y / 25)
    normals = np.dstack((*slopes, np.ones_like(x)))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    points = np.dstack((x, y, heights - heights.mean()))
    towards = positions[:, None, None] - (0 if distant else 1) * points
    distance = np.linalg.norm(towards, axis=3)
    shading = np.clip((towards * normals).sum(axis=3) / distance, 0, None)
    pictures = shading * (1 if distant else 150.0**2 / distance**2)
    stored = to_uint16(pictures * 30_000)
    return write_capture(
        folder, stored, None, normals=normals.astype(np.float32), names="{}.png", first=1
    )


@dataclass(kw_only=True)
class Teacher(Estimator):
    """What estimators with confidence have in common; it counts the pixels that it is asked for."""

    name: str = "taught"
    weights: None = None
    device: str = "cpu"
    precision: str = "float32"
    fingerprint: str = "taught"
    has_confidence: bool = True
    asked: int = 0

    def estimate(self, observations: Any, light_directions: Any, *, progress: Any = None) -> Any:
        return self.estimate_with_error(observations, light_directions, progress=progress)[0]

    def estimate_with_error(
        self, observations: Any, light_directions: Any, *, progress: Any = None
    ) -> Any:
        """Return normals (P, 3) and the distributions (P, 2) of their errors."""
        raise NotImplementedError


def evaluate(captures: Any, estimators: Any, protocol: Any) -> Any:
    """Score every estimator on every capture under one protocol; see evaluate_all."""
    from splinecli.evaluation.run import evaluate_all

    return evaluate_all(captures, estimators, [protocol])[0]
