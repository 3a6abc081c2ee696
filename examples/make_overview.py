"""Draw the picture at the top of the README: ten photographs, their normal map, and the surface
relit.

    python examples/make_overview.py [FILE]        # default: docs/pictures/overview.png

The script runs `splinecli infer` on the medallion and draws the files that the command writes.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import IdentityTransform
from numpy.typing import NDArray

from splinecli.maths.normals import encode_picture, unit
from splinecli.maths.transfer import encode_srgb

Array = NDArray[np.float32]

EXAMPLES = Path(__file__).parent
MEDALLION = EXAMPLES / "medallion"
OVERVIEW = EXAMPLES.parent / "docs/pictures/overview.png"

WIDTH, HEIGHT = 1200, 400  # pixels of the whole picture
TOP, CAPTIONS_AT = 14, 22  # pixels above the panels; pixels from the lower edge to the captions
LARGE, SMALL = 332, 121  # side of a large panel and of a photograph in pixels
PHOTOGRAPHS_LEFT, NORMALS_LEFT, RELIT_LEFT = 4, 508, 860
PHOTOGRAPH_ROWS = (3, 4, 3)

LIGHT = (-0.75, -0.25, 0.6)
"""Direction of the new light: low, from the lower left, where none of the ten lights stands."""

LEVELS_TOGETHER = 4
"""Colours are rounded to every fourth of 256 levels: nobody sees it, and the file is a third
smaller.
"""

SPECULAR_GAIN, SHININESS = 0.08, 40
"""Strength and exponent of the highlight (normalised Blinn-Phong), as on the page of `infer
--html`.
"""

EXPOSURE = 1.6
"""Brightness of the photographs in the picture, relative to their stored values."""


def infer(folder: Path) -> tuple[Array, Array]:
    """Run `splinecli infer` on the medallion; return its normal map and its albedo map, each (H, W,
    3).
    """
    command = [
        sys.executable,
        "-m",
        "splinecli",
        "infer",
        str(MEDALLION),
        "-o",
        str(folder),
        "--quiet",
    ]
    subprocess.run([*command, "--format", "npy", "--maps", "albedo"], check=True)
    results = folder / MEDALLION.name
    return np.load(results / "normals.npy"), np.load(results / "albedo.npy")


def enlarge(values: Array, mask: Array, side: int) -> tuple[Array, Array]:
    """Resize a map (H, W, 3) and its mask (H, W) to `side` pixels.

    Returns the map (side, side, 3) without any influence of the background, and the coverage (side,
    side) from 0 to 1.
    """
    size, smooth = (side, side), cv2.INTER_LINEAR
    coverage = cv2.resize(mask, size, interpolation=smooth)
    total = cv2.resize(values * mask[..., None], size, interpolation=smooth)
    known = coverage[..., None]
    return np.divide(total, known, out=np.zeros_like(total), where=known > 0), coverage


def relit(normals: Array, albedo: Array) -> Array:
    """Linear colours (H, W, 3) of the surface under LIGHT."""
    light = unit(np.array(LIGHT, np.float32))
    cosine = np.maximum(normals @ light, 0)[..., None]
    half = unit(light + np.array((0, 0, 1), np.float32))
    lobe = (SHININESS + 8) / 8 * np.maximum(normals @ half, 0)[..., None] ** SHININESS
    return np.asarray(((1 - SPECULAR_GAIN) * albedo + SPECULAR_GAIN * lobe) * cosine, np.float32)


def photographs() -> list[NDArray[np.uint8]]:
    """The ten photographs as sRGB pictures of SMALL pixels a side."""
    pictures = []
    for path in sorted(MEDALLION.glob("[0-9]*.png")):
        linear = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(np.float32) / 65535
        pictures.append(
            encode_srgb(cv2.resize(EXPOSURE * linear, (SMALL, SMALL), interpolation=cv2.INTER_AREA))
        )
    return pictures


def overview(normals: Array, albedo: Array) -> NDArray[np.uint8]:
    """Return the picture (HEIGHT, WIDTH, 3), RGB, of a normal map and an albedo map (H, W, 3) of
    the medallion.
    """
    mask = normals.any(axis=2).astype(np.float32)
    large_normals, coverage = enlarge(normals, mask, LARGE)
    large_normals = unit(large_normals)
    white = np.quantile(albedo[mask > 0].max(axis=1), 0.99)
    large_albedo, _ = enlarge(albedo / white, mask, LARGE)

    canvas = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    # The medallion is round: rows of three, four and three photographs fit together closely.
    remaining = iter(photographs())
    row_step = (LARGE - SMALL) // (len(PHOTOGRAPH_ROWS) - 1)
    for row, count in enumerate(PHOTOGRAPH_ROWS):
        indent = (max(PHOTOGRAPH_ROWS) - count) * SMALL // 2
        for column in range(count):
            paste(
                canvas,
                next(remaining),
                TOP + row * row_step,
                PHOTOGRAPHS_LEFT + indent + column * SMALL,
            )
    colours = encode_picture(large_normals, coverage > 0, bits=8) * coverage[..., None]
    paste(canvas, np.rint(colours).astype(np.uint8), TOP, NORMALS_LEFT)
    paste(
        canvas,
        encode_srgb(relit(large_normals, large_albedo) * coverage[..., None]),
        TOP,
        RELIT_LEFT,
    )

    dpi = 100
    figure = Figure(figsize=(WIDTH / dpi, HEIGHT / dpi), dpi=dpi, facecolor="black")
    figure.figimage(
        np.minimum(np.rint(canvas / LEVELS_TOGETHER) * LEVELS_TOGETHER, 255).astype(np.uint8)
    )
    for x, words in (
        (PHOTOGRAPHS_LEFT + max(PHOTOGRAPH_ROWS) * SMALL / 2, "ten photographs under ten lights"),
        (NORMALS_LEFT, "→"),
        (NORMALS_LEFT + LARGE / 2, "normal map"),
        (RELIT_LEFT, "→"),
        (RELIT_LEFT + LARGE / 2, "relit from a new direction"),
    ):
        style = {"color": "0.9", "fontsize": 12, "ha": "center", "va": "center"}
        figure.text(x, CAPTIONS_AT, words, transform=IdentityTransform(), **style)
    rendered = FigureCanvasAgg(figure)
    rendered.draw()
    return np.asarray(rendered.buffer_rgba())[..., :3].copy()


def paste(canvas: NDArray[np.uint8], picture: NDArray[np.uint8], top: int, left: int) -> None:
    """Lay a picture on the canvas; the lighter value wins, so that black corners cover nothing."""
    height, width = picture.shape[:2]
    place = canvas[top : top + height, left : left + width]
    np.maximum(place, picture, out=place)


if __name__ == "__main__":
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else OVERVIEW
    with tempfile.TemporaryDirectory() as folder:
        normals, albedo = infer(Path(folder))
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = overview(normals, albedo)
    if not cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise OSError(f"{path} cannot be written")
    print(f"wrote {path}")
