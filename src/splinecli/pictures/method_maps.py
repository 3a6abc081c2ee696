"""Normal maps and error maps of several methods side by side, as in the papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from splinecli.maths import Bools, Floats
from splinecli.maths.normals import encode_picture
from splinecli.pictures.maps import TICKS, TITLE, TOP_DEG, bounding_box, colour_errors
from splinecli.pictures.plotting import png_bytes
from splinecli.pictures.png import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_WIDE = 3600  # pixels, all columns without gaps: the picture stays below 4000
_MOST_HIGH = 1200  # pixels: one map
_ENLARGED = 240  # pixels: small maps are enlarged while their longer side stays within it
_SMALLEST_CELL = 150  # pixels: room for the colour bar and a name
_LARGEST_TEXT, _SMALLEST_TEXT = 36, 10  # pixels
_TEXT_WIDTH = 0.62  # of its height: the average width of a character
_DPI = 100
_POINT = _DPI / 72  # pixels
_WHITE = 255


def method_maps(
    ground_truth: Floats,
    mask: Bools,
    normal_maps: Mapping[str, Floats],
    error_maps_deg: Mapping[str, Floats],
    *,
    title: str,
) -> bytes:
    """Return a PNG file with a column for the ground truth and one for each method: normal map above error map.

    Normals have the colours (n + 1) / 2, errors those of colour_errors from 0 to TOP_DEG; other pixels are white. The
    maps are cropped to the mask's bounding box. Small maps are enlarged by a whole factor and large ones averaged, so
    that the picture stays below 4000 pixels wide. The MAE below each method covers the pixels that have errors.

    The ground truth (H, W, 3) is unit, or zero where there is none; the mask (H, W) is not empty. By method, in the
    order of the columns, there are normals (H, W, 3) and errors (H, W), NaN where there is no error.
    """
    from matplotlib.figure import Figure

    box = bounding_box(mask)
    height, width = mask[box].shape
    scale = _scale(height, width, columns=1 + len(normal_maps))
    truth = _resize(_colour_normals(ground_truth[box], mask[box] & ground_truth[box].any(axis=-1)), scale)
    normals = {name: _resize(_colour_normals(n[box], mask[box]), scale) for name, n in normal_maps.items()}
    shown_deg = {name: np.where(mask, error_deg, np.nan) for name, error_deg in error_maps_deg.items()}
    errors = {name: _resize(colour_errors(shown_deg[name][box]), scale) for name in normal_maps}
    captions = {name: f"MAE {np.nanmean(shown_deg[name]):.2f}°" for name in normal_maps}

    cell_height, cell_width = (max(side, _SMALLEST_CELL) for side in truth.shape[:2])
    text = _text_height(cell_width, ["ground truth", *captions, *captions.values()])
    gap, line = text // 2, 2 * text
    errors_at = gap + line  # from the bottom, as in matplotlib
    normals_at = errors_at + cell_height + gap
    names_at = normals_at + cell_height
    width, height = gap + (cell_width + gap) * (1 + len(normal_maps)), names_at + 2 * line
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)

    def show(picture: Picture, left: int, bottom: int) -> None:
        x, y = left + (cell_width - picture.shape[1]) // 2, bottom + (cell_height - picture.shape[0]) // 2
        figure.figimage(picture[::-1], x, y, origin="lower")

    show(truth, gap, normals_at)
    _write(figure, gap + cell_width / 2, names_at + text, "ground truth", text)
    _draw_bar(figure, gap + cell_width, errors_at, cell_height, text)
    for column, name in enumerate(normal_maps, start=1):
        left = gap + column * (cell_width + gap)
        show(normals[name], left, normals_at)
        show(errors[name], left, errors_at)
        _write(figure, left + cell_width / 2, names_at + text, name, text)
        _write(figure, left + cell_width / 2, errors_at - text, captions[name], text)
    _write(figure, width / 2, height - text, title, _text_height(width, [title], most=round(1.2 * text)))
    return png_bytes(figure, _DPI)


def _draw_bar(figure: Figure, right: int, bottom: int, height: int, text: int) -> None:
    """Draw a vertical colour bar of errors with its right edge at `right`, and its labels and title on the left."""
    inset = text // 2  # room for half a label at either end
    length = height - 2 * inset
    column = np.linspace(0, TOP_DEG, length)[:, None].repeat(text, axis=1)
    figure.figimage(colour_errors(column), right - text, bottom + inset, origin="lower")
    for value, label in TICKS.items():
        _write(figure, right - 1.4 * text, bottom + inset + value / TOP_DEG * (length - 1), label, text, ha="right")
    size = _text_height(height, [TITLE], most=text)
    _write(figure, right - 4 * text, bottom + height / 2, TITLE, size, rotation=90)


def _write(
    figure: Figure, x: float, y: float, words: str, height: int, *, ha: str = "center", rotation: float = 0
) -> None:
    """Write text centred at (x, y) in pixels from the bottom left."""
    from matplotlib.transforms import IdentityTransform

    size, in_pixels = height / _POINT, IdentityTransform()
    figure.text(x, y, words, size=size, ha=ha, va="center", rotation=rotation, transform=in_pixels, parse_math=False)


def _text_height(width: int, lines: Sequence[str], *, most: int = _LARGEST_TEXT) -> int:
    """Return a text height in pixels at which each line fits into the width; short lines do not fill it."""
    longest = max(18, *(len(line) for line in lines))
    return min(most, max(_SMALLEST_TEXT, int(width / (_TEXT_WIDTH * longest))))


def _scale(height: int, width: int, columns: int) -> float:
    """Return the factor of enlargement: a whole number, or less than 1."""
    most = min(_MOST_WIDE / columns / width, _MOST_HIGH / height)
    return most if most < 1 else max(1, min(int(most), _ENLARGED // max(height, width)))


def _resize(picture: Picture, scale: float) -> Picture:
    if scale >= 1:
        return picture.repeat(int(scale), axis=0).repeat(int(scale), axis=1)
    import cv2

    height, width = (max(1, int(side * scale)) for side in picture.shape[:2])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _colour_normals(normals: Floats, known: Bools) -> Picture:
    """Return the colours (n + 1) / 2 of normals (H, W, 3), white where `known` is false, even if NaN is there."""
    colours = encode_picture(np.where(known[..., None], normals, 0), known, bits=8).astype(np.uint8)
    colours[~known] = _WHITE
    return colours
