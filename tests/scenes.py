"""Lights, shapes and captures of known normals, which the tests of many rooms share."""

import json
import struct
import subprocess
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.random import default_rng

from splinecli.capture import Capture
from splinecli.errors import InputError
from splinecli.estimate.methods.estimator import Estimator
from splinecli.maths.normals import unit


def vectors(text):
    """The vectors, or other rows of numbers, of a text such as "0 0 1; 0.6 0 0.8"."""
    return np.array([row.split() for row in text.split(";")], float)


def as_capture(observations, lights, mask, **more):
    indices = tuple(range(len(lights)))
    return Capture("scene", np.float32(observations), lights, indices, mask, **more)


def pinhole(focal, x, y, focal_y=None):
    """The matrix of a camera with these focal lengths and principal point in pixels."""
    return np.array([(focal, 0, x), (0, focal_y or focal, y), (0, 0, 1)], float)


FOUR_LIGHTS = vectors("0 0 1; 0.6 0 0.8; 0 0.6 0.8; -0.48 -0.36 0.8")


def directions_at(azimuth, zenith):
    """Return the unit directions (count, 3) at these angles in radians."""
    x, y, z = np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)
    return np.stack((x, y, np.broadcast_to(z, x.shape)), axis=1)


def cap_directions(count, limit_deg, seed=0, *, even=False):
    """Random unit vectors (count, 3) within limit_deg of the view axis: even by angle, or even over
    the cap.
    """
    rng = default_rng(seed)
    azimuth, limit = rng.uniform(0, 2 * np.pi, count), np.radians(limit_deg)
    zenith = limit * (np.sqrt(rng.uniform(0, 1, count)) if even else rng.uniform(0, 1, count))
    return directions_at(azimuth, zenith)


def spiral_lights(count, limit_deg=35, start_deg=5):
    """Lights (count, 3) on a spiral, from start_deg to limit_deg from the view axis."""
    return directions_at(
        np.arange(count) * 2.4, np.radians(np.linspace(start_deg, limit_deg, count))
    )


def ring_lights(count, zenith_deg=40, first_rad=0.0):
    """Lights (count, 3) evenly on a ring."""
    return directions_at(first_rad + np.arange(count) * 2 * np.pi / count, np.radians(zenith_deg))


def square_grid(size, reach=1.0):
    """Return x (right) and y (up) of size x size points, from -reach to reach."""
    axis = np.linspace(-reach, reach, size)
    x, y = np.meshgrid(axis, -axis)
    return x, y


def on_sphere(x, y):
    """Normals (..., 3) of a unit sphere at these places, level beside it."""
    return np.stack((x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))), axis=-1)


def tilted(x, y):
    """Unit vectors (..., 3) along (x, y, 1): normals of a surface with the slopes -x and -y."""
    return unit(np.stack((x, y, np.ones_like(x)), axis=-1))


def bumps(size):
    """Normals (size, size, 3) of a relief that fills the picture."""
    y, x = np.mgrid[:size, :size] / size * 9
    down, right = np.gradient(5 * np.sin(x) * np.cos(0.7 * y) + 3 * np.sin(1.3 * x + 2 * y))
    return tilted(-right, down)


def sphere(size, reach=0.97):
    """Normals (size, size, 3) of a unit sphere that touches the frame, and the mask of radius
    `reach`.
    """
    x, y = square_grid(size)
    inside = np.hypot(x, y) < reach
    return on_sphere(x, y), inside


def sphere_cap(size, reach=0.65):
    """Normals (size, size, 3) of the part of a unit sphere that fills a square of half width
    `reach`.
    """
    return on_sphere(*square_grid(size, reach))


def ball(shape, x, y, radius):
    """Normals (H, W, 3) of a ball around this place in pixels, level beside it, and its mask."""
    rows, columns = np.indices(shape)
    nx, ny = (columns - x) / radius, (y - rows) / radius
    inside = np.hypot(nx, ny) < 1
    return on_sphere(nx, ny), inside


def halfway(lights):
    """Return the unit vectors (F, 3) between the lights and the view axis."""
    return unit(lights + np.array((0.0, 0.0, 1.0)))


def shade(normals, lights, *, gloss=0.0, exponent=30, noise=0.0):
    """Observations (..., F): Lambert's cosine, a Blinn-Phong lobe, attached shadows, and noise of
    this deviation.
    """
    cosine = np.clip(normals @ lights.T, 0, None)
    seen = cosine + gloss * np.clip(normals @ halfway(lights).T, 0, None) ** exponent * (cosine > 0)
    if noise:
        seen = seen + default_rng(5).normal(0, noise, seen.shape)
    return np.asarray(np.clip(seen, 0, None))


def to_uint16(values):
    """Round values to those that a 16-bit image stores."""
    return np.uint16(np.rint(values))


def read_image(path):
    """The pixels of an image as OpenCV reads them: BGR, in their own type."""
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def put(path, text="", encoding="utf-8"):
    """Write a text into a file, whose folder need not exist."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode(encoding))
    return path


def write_image(path, pixels):
    """Write pixels (H, W) or (H, W, 3) BGR in the format of the name; the folder need not exist."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def read_json(path):
    return json.loads(Path(path).read_text("utf-8"))


def names_in(folder):
    """The names of what lies in a folder."""
    return {path.name for path in Path(folder).iterdir()}


def assert_unit(vectors, atol=1e-5):
    """Check that vectors (..., 3) have unit length."""
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1, atol=atol)


def codes(found):
    """The codes of warnings, also of those in a report or of a capture."""
    found = found["warnings"] if isinstance(found, dict) else getattr(found, "warnings", found)
    return [each["code"] if isinstance(each, dict) else each.code for each in found]


def run_python(script, *arguments, **options):
    """Run a script in a process of its own and return what it leaves."""
    call = [sys.executable, "-c", script, *arguments]
    return subprocess.run(call, capture_output=True, text=True, timeout=120, **options)


def shell(script, **options):
    call = ["bash", "-c", script]
    return subprocess.run(call, capture_output=True, text=True, timeout=120, **options)


def refuses(message, error=InputError):
    """Expect an error whose message matches this regular expression."""
    return pytest.raises(error, match=message)


def table(text):
    r"""The cells of a table whose lines have | between them; \n in a cell is a line break."""
    lines = text.strip().splitlines()
    return [tuple(cell.strip().replace(r"\n", "\n") for cell in line.split("|")) for line in lines]


def parametrize(names, cases, **options):
    """pytest.mark.parametrize, whose cases may also be the words or the table of a text."""
    if isinstance(cases, str):
        cases = table(cases) if "|" in cases else cases.split()
    return pytest.mark.parametrize(names, cases, **options)


def write_capture(
    folder,
    images,
    lights,
    *,
    mask=None,
    normals=None,
    intensities=None,
    names="{:03}.png",
    first=0,
):
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
        write_image(folder / "mask.png", np.uint8(mask) * 255)
    if normals is not None:
        np.save(folder / "normals_gt.npy", normals)
    if intensities is not None:
        np.savetxt(folder / "light_intensities.txt", intensities)
    return folder


def write_mirror_ball(folder, normals, inside, lights, *, wall=0.2, width_deg=2):
    """Write images of a ball that shows each lamp as a soft spot, where the normal halves view and
    light.
    """
    for number, half in enumerate(halfway(lights)):
        off_deg = np.degrees(np.arccos((normals @ half).clip(-1, 1)))
        picture = np.where(inside, 0.02 + 0.9 * np.exp(-((off_deg / width_deg) ** 2)), wall)
        write_image(folder / f"{number}.png", to_uint16(picture * 65535))
    return folder


def decode_rgb(png):
    """RGB (H, W, 3) of an encoded picture."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])


def png_chunk(name, content):
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def with_chunk(png, name, content):
    """A PNG with one more chunk after its header."""
    return png[:33] + png_chunk(name, content) + png[33:]


BUMP_MM = 64.0
BUMP_LAMPS = vectors(
    "0 20 200; 70 10 170; -80 20 160; 20 90 150; -10 -80 170; 60 60 140; -60 -70 150"
)
"""Lamps in millimetres, at about three widths of the object."""


def write_bump(folder, positions=BUMP_LAMPS, *, distant=False):
    """Write a matte bump of 32 x 32 pixels, 64 mm wide, without a mask or lights, under near or
    distant lamps.
    """
    x, y = square_grid(32, BUMP_MM / 2 * (1 - 1 / 32))
    heights = 8 * np.cos(x / 20) * np.cos(y / 25)
    slopes = 8 / 20 * np.sin(x / 20) * np.cos(y / 25), 8 / 25 * np.cos(x / 20) * np.sin(y / 25)
    normals = tilted(*slopes)
    points = np.dstack((x, y, heights - heights.mean()))
    towards = positions[:, None, None] - (0 if distant else 1) * points
    distance = np.linalg.norm(towards, axis=3)
    shading = np.clip((towards * normals).sum(axis=3) / distance, 0, None)
    pictures = shading * (1 if distant else 150.0**2 / distance**2)
    stored = to_uint16(pictures * 30_000)
    return write_capture(folder, stored, None, normals=np.float32(normals), names="{}.png", first=1)


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

    def estimate(self, observations, light_directions, *, progress=None):
        return self.estimate_with_error(observations, light_directions, progress=progress)[0]

    def estimate_with_error(self, observations, light_directions, *, progress=None):
        """Return normals (P, 3) and the distributions (P, 2) of their errors."""
        raise NotImplementedError


def evaluate(captures, estimators, protocol):
    """Score every estimator on every capture under one protocol; see evaluate_all."""
    from splinecli.evaluation.run import evaluate_all

    return evaluate_all(captures, estimators, [protocol])[0]
