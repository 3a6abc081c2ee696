"""Render the example captures: a carved medallion under ten lights with its exact normals, and a
mirror ball.

    python examples/render_capture.py [FOLDER]        # default: examples, for medallion/ and
    mirror_ball/

The medallion is a height field z(x, y) over the square from -1 to 1. An orthographic camera looks
at it from +z; x points right, y up. It is a dome with a raised rim, a ring of beads, and an
ammonite: a logarithmic spiral with ribs. It has highlights, attached shadows and cast shadows,
which least squares does not model. It has no interreflection and no noise. Nothing is random: every
run writes the same files.

The mirror ball is for `splinecli calibrate`, which computes the light directions from it: a chrome
ball on dark cloth in a dim room, photographed under each of the ten lamps.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import encode_picture, unit

Array = NDArray[np.float64]

SIDE = 128
"""Pixels along a side."""

SAMPLES = 3
"""Samples along a side of each pixel; the number is odd, so that one sample is at the centre of the
pixel.
"""

RADIUS = 0.96
"""Radius of the medallion and of its mask."""

# Each light's angle from the viewing direction and its azimuth in degrees: two loose rings, as
# placed by hand.
LIGHTS_DEG = (
    (18, 75),
    (22, 200),
    (26, 318),
    (40, 15),
    (44, 62),
    (38, 118),
    (48, 160),
    (42, 222),
    (52, 268),
    (46, 330),
)

# RGB intensities of the lamps: unequal, and some warmer than others.
LIGHT_INTENSITIES = (
    (1.00, 1.00, 1.00),
    (0.82, 0.80, 0.74),
    (1.21, 1.17, 1.08),
    (0.95, 0.97, 1.03),
    (1.32, 1.30, 1.22),
    (0.74, 0.71, 0.63),
    (1.10, 1.12, 1.16),
    (0.88, 0.84, 0.77),
    (1.40, 1.41, 1.44),
    (1.05, 1.00, 0.91),
)

ROUGHNESS = 0.38
REFLECTANCE = 0.05
"""Reflectance of the varnish at normal incidence."""

SHADOW_EDGE = 0.012
"""How far below a blocking ridge, in height, a shadow is complete. The lamps are not points."""

EXPOSURE = 0.75
"""Stored value, relative to full scale, of a matte white surface that faces a lamp of intensity 1.
"""

BALL_SIDE, BALL_RADIUS = 240, 101.3
BALL_PLACE = 118.6, 121.2
"""Column and row of the centre of the ball; (0, 0) is the centre of the first pixel."""

LAMP_DEG = 2.5
"""Angular radius of a lamp's reflection in the ball."""


class Rendering(NamedTuple):
    """Images (F, H, W, 3) uint16 RGB, light directions and RGB intensities (F, 3), mask (H, W),
    normals (H, W, 3).
    """

    images: NDArray[np.uint16]
    light_directions: Array
    light_intensities: Array
    mask: NDArray[np.bool_]
    normals: Array


def sample_grid() -> tuple[Array, Array]:
    """Return x and y of all samples, each (SIDE * SAMPLES, SIDE * SAMPLES). Row 0 is at the top,
    where y is largest.
    """
    count = SIDE * SAMPLES
    centre = (np.arange(count) + 0.5) * 2 / count - 1
    x, y = np.meshgrid(centre, -centre)
    return x, y


def spiral_turns(x: Array, y: Array) -> Array:
    """Return the turn of the logarithmic spiral at each point. Whole numbers are the seams between
    turns.
    """
    return 1.55 * np.log(np.hypot(x, y) + 0.02) - np.arctan2(y, x) / (2 * np.pi)


def step_down(r: Array, edge: float, width: float) -> Array:
    """Return 1 inside the radius `edge` and 0 outside, with a smooth step about `width` wide."""
    return 0.5 - 0.5 * np.tanh((r - edge) / width)


def height(x: Array, y: Array) -> Array:
    """Return the height z of the medallion; the table below it has height 0."""
    r, azimuth = np.hypot(x, y), np.arctan2(y, x)
    dome = 0.10 * np.sqrt(np.clip(1.25 - r**2, 0.0, None))
    rim = 0.085 * np.exp(-(((r - 0.89) / 0.040) ** 2))
    # Twenty-four beads on a circle. Each is a bump in radius and in azimuth.
    across = 0.77 * (np.mod(azimuth * 24 / (2 * np.pi), 1) - 0.5) * 2 * np.pi / 24
    beads = 0.050 * np.exp(-(((r - 0.77) / 0.030) ** 2) - (across / 0.036) ** 2)
    # The spiral and its ribs look the same at all scales, so they fade out at the centre and below
    # the beads.
    turns = spiral_turns(x, y)
    tube = np.sin(np.pi * turns) ** 2
    ribs = 1 + 0.16 * tube * np.cos(26 * azimuth + 5.0 * np.sin(np.pi * turns) ** 2)
    shell = 0.30 * r * tube * ribs * r**2 / (r**2 + 0.15**2) * step_down(r, 0.66, 0.03)
    eye = 0.05 * np.exp(-((r / 0.08) ** 2))
    body = (dome + rim + beads + shell + eye) * step_down(r, RADIUS + 0.02, 0.02)
    return np.asarray(body, np.float64)


def normals_of(x: Array, y: Array) -> Array:
    """Return unit normals (..., 3) of the height field: (-dz/dx, -dz/dy, 1), scaled, by central
    differences.

    The step is far smaller than a sample. The error is about 1e-7, below the precision of 16 bits.
    """
    step = 1e-5
    slope_x = (height(x + step, y) - height(x - step, y)) / (2 * step)
    slope_y = (height(x, y + step) - height(x, y - step)) / (2 * step)
    return np.asarray(unit(np.stack((-slope_x, -slope_y, np.ones_like(x)), axis=-1)))


def albedo_of(x: Array, y: Array) -> Array:
    """Return the diffuse RGB albedo (..., 3): gilded ridges over verdigris, with a slow change
    across the medallion.
    """
    r = np.hypot(x, y)
    on_ridge = np.sin(np.pi * spiral_turns(x, y)) ** 2 * step_down(r, 0.66, 0.03)
    on_ridge = np.maximum(on_ridge, np.exp(-(((r - 0.83) / 0.11) ** 4)))
    gilded = np.clip(0.85 * on_ridge + 0.18 * np.sin(3.1 * x + 1.0) * np.cos(2.3 * y - 0.4), 0, 1)[
        ..., None
    ]
    return gilded * np.array((0.62, 0.46, 0.22)) + (1 - gilded) * np.array((0.16, 0.34, 0.29))


def visibility(heights: Array, light: Array) -> Array:
    """Return the share of the light (3,) that reaches each sample (H, W): cast shadows of the
    height field.

    All rays advance together. After each step along the light, the height field is compared with a
    shifted copy.
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
            depth,
            shifted(padded, row, column, n_steps + 2, len(heights)) - step * rise - heights,
            out=depth,
        )
    return np.asarray(1 - np.clip(depth / SHADOW_EDGE, 0, 1))


def shifted(padded: Array, row: float, column: float, margin: int, side: int) -> Array:
    """Return the middle (side, side) of a padded array, shifted by a fractional number of samples,
    bilinear.
    """
    top, left = margin + int(np.floor(row)), margin + int(np.floor(column))
    down, right = row - np.floor(row), column - np.floor(column)
    block = padded[top : top + side + 1, left : left + side + 1]
    rows = (1 - down) * block[:-1] + down * block[1:]
    return np.asarray((1 - right) * rows[:, :-1] + right * rows[:, 1:])


def shade(normals: Array, albedo: Array, light: Array) -> Array:
    """Return pi times the radiance (..., 3) under a light: Lambert below a GGX varnish (Walter et
    al., EGSR 2007).
    """
    n_dot_l = np.clip(normals @ light, 0, None)
    n_dot_v = normals[..., 2]
    half = unit(light + np.array((0.0, 0.0, 1.0)))
    fresnel = REFLECTANCE + (1 - REFLECTANCE) * (1 - half @ light) ** 5
    alpha_squared = ROUGHNESS**4
    distribution = alpha_squared / (((normals @ half) ** 2 * (alpha_squared - 1) + 1) ** 2)

    def smith(cosine: Array) -> Array:
        return np.asarray(1 / (cosine + np.sqrt(alpha_squared + (1 - alpha_squared) * cosine**2)))

    # The factor pi cancels the 1 / pi of both reflectances.
    varnish = fresnel * distribution * smith(n_dot_l) * smith(n_dot_v)
    return np.asarray((albedo + varnish[..., None]) * n_dot_l[..., None])


def light_rig() -> tuple[Array, Array]:
    """Return light directions (F, 3), rounded to the stored digits, and RGB intensities (F, 3)."""
    tilt, azimuth = np.radians(np.array(LIGHTS_DEG, np.float64)).T
    directions = np.stack(
        (np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)), axis=-1
    )
    return np.asarray(unit(np.round(directions, 6))), np.array(LIGHT_INTENSITIES)


def render() -> Rendering:
    """Render the medallion."""
    directions, intensities = light_rig()
    x, y = sample_grid()
    heights, normals, albedo = height(x, y), normals_of(x, y), albedo_of(x, y)
    middle = slice(SAMPLES // 2, None, SAMPLES)
    mask = np.hypot(x, y)[middle, middle] < RADIUS
    images = np.empty((len(directions), SIDE, SIDE, 3), np.uint16)
    for index, (light, intensity) in enumerate(zip(directions, intensities, strict=True)):
        radiance = shade(normals, albedo, light) * visibility(heights, light)[..., None]
        pixels = (
            radiance.reshape(SIDE, SAMPLES, SIDE, SAMPLES, 3).mean(axis=(1, 3)) * mask[..., None]
        )
        images[index] = np.rint(np.clip(pixels * intensity * EXPOSURE, 0, 1) * 65535)
    return Rendering(
        images, directions, intensities, mask, normals[middle, middle] * mask[..., None]
    )


def render_ball(light: Array) -> NDArray[np.uint8]:
    """Return an 8-bit photograph (H, W) of the mirror ball under a light (3,)."""
    place = (np.arange(BALL_SIDE)[:, None] + (np.arange(SAMPLES) - SAMPLES // 2) / SAMPLES).ravel()
    x, y = np.meshgrid((place - BALL_PLACE[0]) / BALL_RADIUS, (BALL_PLACE[1] - place) / BALL_RADIUS)
    on_ball = x**2 + y**2 < 1
    z = np.sqrt(np.where(on_ball, 1 - x**2 - y**2, 0))
    # The direction of the reflection of a ray from the camera, (0, 0, -1).
    mirrored = np.stack((2 * z * x, 2 * z * y, 2 * z**2 - 1), axis=-1)
    room = 0.07 + 0.05 * mirrored[..., 1] + 0.05 * (mirrored[..., 1] < -0.55)  # a dimly lit floor
    lamp_deg = np.degrees(np.arccos(np.clip(mirrored @ light, -1, 1)))
    glare = 0.25 * np.exp(-((lamp_deg / 14) ** 2))
    ball = room + glare + 8.0 * (lamp_deg < LAMP_DEG)
    radiance = np.where(on_ball, ball, 0.015)
    pixels = radiance.reshape(BALL_SIDE, SAMPLES, BALL_SIDE, SAMPLES).mean(axis=(1, 3))
    return np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)


def write(rendering: Rendering, folder: Path) -> None:
    """Write the medallion as a folder that splinecli reads."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(rendering.images, start=1):
        write_png(folder / f"{number:02d}.png", image)
    write_png(folder / "mask.png", rendering.mask.astype(np.uint8) * 255)
    write_png(folder / "normals_gt.png", encode_picture(rendering.normals, rendering.mask))
    np.savetxt(folder / "light_directions.txt", rendering.light_directions, "%9.6f")
    np.savetxt(folder / "light_intensities.txt", rendering.light_intensities, "%.2f")


def write_png(path: Path, pixels: NDArray[np.unsignedinteger]) -> None:
    """Write a gray or RGB picture. OpenCV expects BGR."""
    if not cv2.imwrite(
        str(path),
        pixels[..., ::-1] if pixels.ndim == 3 else pixels,
        [cv2.IMWRITE_PNG_COMPRESSION, 9],
    ):
        raise OSError(f"{path} cannot be written")


if __name__ == "__main__":
    examples = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    write(render(), examples / "medallion")
    (examples / "mirror_ball").mkdir(exist_ok=True)
    for number, light in enumerate(light_rig()[0], start=1):
        write_png(examples / "mirror_ball" / f"{number:02d}.png", render_ball(light))
