"""Render the example capture, a carved medallion under ten lights with its exact normals, and a mirror ball under them.

    python examples/render_capture.py [FOLDER]        # default: examples, for medallion/ and mirror_ball/

The medallion is a height field z(x, y) over the square -1..1, seen by an orthographic camera from +z (x right, y up):
a dome with a raised rim, a ring of beads and an ammonite, a logarithmic spiral with ribs. What least squares knows
nothing of is there on purpose: highlights, attached shadows and cast shadows. There is no interreflection and no
noise, and nothing is random: the same files come out each time. The ball is what `splinecli calibrate` finds the
directions of the lights from: a chrome ball on dark cloth in a dim room, photographed under each lamp.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.normals import encode_picture, unit

Array = NDArray[np.float64]

SIDE = 128
"""Pixels along a side."""

SAMPLES = 3
"""Samples along a side of each pixel; an odd number, so that one of them is the pixel's centre."""

RADIUS = 0.96
"""Of the medallion, whose square is -1..1; the mask ends here."""

# Tilt from the viewing direction and azimuth of each light in degrees: two loose rings, as a person would place them.
LIGHTS_DEG = (
    (18, 75), (22, 200), (26, 318), (40, 15), (44, 62),
    (38, 118), (48, 160), (42, 222), (52, 268), (46, 330),
)  # fmt: skip

# RGB strengths of the lamps: unequal, and some warmer than others.
LIGHT_INTENSITIES = (
    (1.00, 1.00, 1.00), (0.82, 0.80, 0.74), (1.21, 1.17, 1.08), (0.95, 0.97, 1.03), (1.32, 1.30, 1.22),
    (0.74, 0.71, 0.63), (1.10, 1.12, 1.16), (0.88, 0.84, 0.77), (1.40, 1.41, 1.44), (1.05, 1.00, 0.91),
)  # fmt: skip

ROUGHNESS = 0.38
REFLECTANCE = 0.05
"""Of the varnish at normal incidence."""

SHADOW_EDGE = 0.012
"""Depth below a blocking ridge, in height, at which a shadow is complete: the lamps are not points."""

EXPOSURE = 0.75
"""Stored value, as a share of full scale, of a matte white surface that faces a lamp of strength 1."""


BALL_SIDE, BALL_RADIUS = 240, 101.3
BALL_PLACE = 118.6, 121.2
"""Column and row of its centre, (0, 0) the centre of the first pixel."""

LAMP_DEG = 2.5
"""Radius of a lamp as the ball mirrors it."""


class Rendering(NamedTuple):
    """images (F, H, W, 3) uint16 RGB; light_directions, light_intensities (F, 3); mask (H, W); normals (H, W, 3)."""

    images: NDArray[np.uint16]
    light_directions: Array
    light_intensities: Array
    mask: NDArray[np.bool_]
    normals: Array


def sample_grid() -> tuple[Array, Array]:
    """x and y of all samples, each (SIDE * SAMPLES, SIDE * SAMPLES); row 0 is the top, where y is largest."""
    count = SIDE * SAMPLES
    centre = (np.arange(count) + 0.5) * 2 / count - 1
    x, y = np.meshgrid(centre, -centre)
    return x, y


def spiral_turns(x: Array, y: Array) -> Array:
    """Which turn of the logarithmic spiral a point lies on; whole numbers are the seams between turns."""
    return 1.55 * np.log(np.hypot(x, y) + 0.02) - np.arctan2(y, x) / (2 * np.pi)


def step_down(r: Array, edge: float, width: float) -> Array:
    """1 inside the radius `edge`, 0 outside, smooth over about `width`."""
    return 0.5 - 0.5 * np.tanh((r - edge) / width)


def height(x: Array, y: Array) -> Array:
    """The height field z of the medallion; zero is the table it lies on."""
    r, azimuth = np.hypot(x, y), np.arctan2(y, x)
    dome = 0.10 * np.sqrt(np.clip(1.25 - r**2, 0.0, None))
    rim = 0.085 * np.exp(-(((r - 0.89) / 0.040) ** 2))
    # Twenty-four beads on a circle: each is a bump in radius and in azimuth.
    across = 0.77 * (np.mod(azimuth * 24 / (2 * np.pi), 1) - 0.5) * 2 * np.pi / 24
    beads = 0.050 * np.exp(-(((r - 0.77) / 0.030) ** 2) - (across / 0.036) ** 2)
    # The spiral and its ribs: the same at all scales, so faded out at the centre and under the beads.
    turns = spiral_turns(x, y)
    tube = np.sin(np.pi * turns) ** 2
    ribs = 1 + 0.16 * tube * np.cos(26 * azimuth + 5.0 * np.sin(np.pi * turns) ** 2)
    shell = 0.30 * r * tube * ribs * r**2 / (r**2 + 0.15**2) * step_down(r, 0.66, 0.03)
    eye = 0.05 * np.exp(-((r / 0.08) ** 2))
    body = (dome + rim + beads + shell + eye) * step_down(r, RADIUS + 0.02, 0.02)
    return np.asarray(body, np.float64)


def normals_of(x: Array, y: Array) -> Array:
    """Unit normals (..., 3) of the height field: (-dz/dx, -dz/dy, 1), by central differences of the formula.

    The step is far below a sample's width: the error is around 1e-7, smaller than what 16 bits can hold.
    """
    step = 1e-5
    slope_x = (height(x + step, y) - height(x - step, y)) / (2 * step)
    slope_y = (height(x, y + step) - height(x, y - step)) / (2 * step)
    return np.asarray(unit(np.stack((-slope_x, -slope_y, np.ones_like(x)), axis=-1)))


def albedo_of(x: Array, y: Array) -> Array:
    """Diffuse RGB (..., 3): gilded ridges over verdigris, with a slow change across the medallion."""
    r = np.hypot(x, y)
    on_ridge = np.sin(np.pi * spiral_turns(x, y)) ** 2 * step_down(r, 0.66, 0.03)
    on_ridge = np.maximum(on_ridge, np.exp(-(((r - 0.83) / 0.11) ** 4)))
    gilded = np.clip(0.85 * on_ridge + 0.18 * np.sin(3.1 * x + 1.0) * np.cos(2.3 * y - 0.4), 0, 1)[..., None]
    return gilded * np.array((0.62, 0.46, 0.22)) + (1 - gilded) * np.array((0.16, 0.34, 0.29))


def visibility(heights: Array, light: Array) -> Array:
    """Share of the light (3,) that reaches each sample (H, W) past the rest of the height field: cast shadows.

    All rays march together: after a step along the light, the whole height field is compared with itself, shifted.
    """
    across = float(np.hypot(light[0], light[1]))
    spacing = 2 / len(heights)
    rise = spacing * light[2] / across
    n_steps = int(np.ceil((heights.max() - heights.min()) / rise))
    columns, rows = (
        light[0] / across * np.arange(1, n_steps + 1),
        -light[1] / across * np.arange(1, n_steps + 1),
    )
    padded = np.pad(heights, n_steps + 2, mode="constant")
    depth = np.full_like(heights, -np.inf)
    for step, (column, row) in enumerate(zip(columns, rows, strict=True), start=1):
        np.maximum(
            depth, shifted(padded, row, column, n_steps + 2, len(heights)) - step * rise - heights, out=depth
        )
    return np.asarray(1 - np.clip(depth / SHADOW_EDGE, 0, 1))


def shifted(padded: Array, row: float, column: float, margin: int, side: int) -> Array:
    """The middle (side, side) of a padded array, moved by a fraction of samples, bilinear."""
    top, left = margin + int(np.floor(row)), margin + int(np.floor(column))
    down, right = row - np.floor(row), column - np.floor(column)
    block = padded[top : top + side + 1, left : left + side + 1]
    rows = (1 - down) * block[:-1] + down * block[1:]
    return np.asarray((1 - right) * rows[:, :-1] + right * rows[:, 1:])


def shade(normals: Array, albedo: Array, light: Array) -> Array:
    """pi times the radiance (..., 3) under a unit light: Lambert below a GGX varnish (Walter et al., EGSR 2007)."""
    n_dot_l = np.clip(normals @ light, 0, None)
    n_dot_v = normals[..., 2]
    half = unit(light + np.array((0.0, 0.0, 1.0)))
    fresnel = REFLECTANCE + (1 - REFLECTANCE) * (1 - half @ light) ** 5
    alpha_squared = ROUGHNESS**4
    distribution = alpha_squared / (((normals @ half) ** 2 * (alpha_squared - 1) + 1) ** 2)

    def smith(cosine: Array) -> Array:
        return np.asarray(1 / (cosine + np.sqrt(alpha_squared + (1 - alpha_squared) * cosine**2)))

    # Burley's and Walter's 1 / pi cancels against the pi in front.
    varnish = fresnel * distribution * smith(n_dot_l) * smith(n_dot_v)
    return np.asarray((albedo + varnish[..., None]) * n_dot_l[..., None])


def light_rig() -> tuple[Array, Array]:
    """Directions (F, 3), rounded to the digits that are stored, and RGB intensities (F, 3)."""
    tilt, azimuth = np.radians(np.array(LIGHTS_DEG, np.float64)).T
    directions = np.stack(
        (np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)), axis=-1
    )
    return np.asarray(unit(np.round(directions, 6))), np.array(LIGHT_INTENSITIES)


def render() -> Rendering:
    """The capture, in memory."""
    directions, intensities = light_rig()
    x, y = sample_grid()
    heights, normals, albedo = height(x, y), normals_of(x, y), albedo_of(x, y)
    middle = slice(SAMPLES // 2, None, SAMPLES)
    mask = np.hypot(x, y)[middle, middle] < RADIUS
    images = np.empty((len(directions), SIDE, SIDE, 3), np.uint16)
    for index, (light, intensity) in enumerate(zip(directions, intensities, strict=True)):
        radiance = shade(normals, albedo, light) * visibility(heights, light)[..., None]
        pixels = radiance.reshape(SIDE, SAMPLES, SIDE, SAMPLES, 3).mean(axis=(1, 3)) * mask[..., None]
        images[index] = np.rint(np.clip(pixels * intensity * EXPOSURE, 0, 1) * 65535)
    return Rendering(images, directions, intensities, mask, normals[middle, middle] * mask[..., None])


def render_ball(light: Array) -> NDArray[np.uint8]:
    """A photograph (H, W) of the mirror ball under a light (3,), 8-bit, as a camera's JPEG or PNG would be exposed."""
    place = (np.arange(BALL_SIDE)[:, None] + (np.arange(SAMPLES) - SAMPLES // 2) / SAMPLES).ravel()
    x, y = np.meshgrid((place - BALL_PLACE[0]) / BALL_RADIUS, (BALL_PLACE[1] - place) / BALL_RADIUS)
    on_ball = x**2 + y**2 < 1
    z = np.sqrt(np.where(on_ball, 1 - x**2 - y**2, 0))
    # Where a ray from the camera, (0, 0, -1), goes from there.
    mirrored = np.stack((2 * z * x, 2 * z * y, 2 * z**2 - 1), axis=-1)
    room = 0.07 + 0.05 * mirrored[..., 1] + 0.05 * (mirrored[..., 1] < -0.55)  # a floor that is lit a little
    lamp_deg = np.degrees(np.arccos(np.clip(mirrored @ light, -1, 1)))
    glare = 0.25 * np.exp(-((lamp_deg / 14) ** 2))
    ball = room + glare + 8.0 * (lamp_deg < LAMP_DEG)
    radiance = np.where(on_ball, ball, 0.015)
    pixels = radiance.reshape(BALL_SIDE, SAMPLES, BALL_SIDE, SAMPLES).mean(axis=(1, 3))
    return np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)


def write(rendering: Rendering, folder: Path) -> None:
    """The capture as a folder that splinecli reads."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(rendering.images, start=1):
        write_png(folder / f"{number:02d}.png", image)
    write_png(folder / "mask.png", rendering.mask.astype(np.uint8) * 255)
    write_png(folder / "normals_gt.png", encode_picture(rendering.normals, rendering.mask))
    np.savetxt(folder / "light_directions.txt", rendering.light_directions, "%9.6f")
    np.savetxt(folder / "light_intensities.txt", rendering.light_intensities, "%.2f")


def write_png(path: Path, pixels: NDArray[np.unsignedinteger]) -> None:
    """A gray or RGB picture; OpenCV wants BGR."""
    if not cv2.imwrite(
        str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9]
    ):
        raise OSError(f"{path} cannot be written")


if __name__ == "__main__":
    examples = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    write(render(), examples / "medallion")
    (examples / "mirror_ball").mkdir(exist_ok=True)
    for number, light in enumerate(light_rig()[0], start=1):
        write_png(examples / "mirror_ball" / f"{number:02d}.png", render_ball(light))
