"""The contact sheet of a capture, which shows how its files are used."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource
from splinecli.capture.formats.images import read_image
from splinecli.errors import printable
from splinecli.maths import Bools, Floats, Picture
from splinecli.pictures.maps import encode_png
from splinecli.records.capture_warnings import ESTIMATED_LIGHTS, IMAGES_LEFT_OUT, LIGHTS_FOUND

_SIDE, _GAP, _LINE = 112, 8, 15  # pixels: side of a picture, gap, and height of a line of text
_DISC = 15  # radius of the disc of a light in pixels
_COLUMNS, _MOST_NOTES, _LETTER = 10, 12, 6  # _LETTER is the width of a letter in pixels
_ORANGE, _PALE, _GRAY = (213, 94, 0), 235, 120


def sheet_of(source: CaptureSource, capture: Capture) -> bytes:
    """Return the contact sheet of a capture that was read from files; see capture_sheet."""
    radiometry = source.radiometry
    others = {} if radiometry.ambient is None else {"ambient image": radiometry.ambient}
    others |= {f"flat field {n}": path for n, path in enumerate(radiometry.flat_field, start=1)}
    kinds = (IMAGES_LEFT_OUT, LIGHTS_FOUND, ESTIMATED_LIGHTS)
    return capture_sheet(
        capture,
        source.image_names(capture.light_indices),
        {name: read_image(path).mean(axis=2) for name, path in others.items()},
        [warning.text for warning in capture.warnings if warning.kind in kinds],
    )


def capture_sheet(
    capture: Capture, names: Sequence[str], others: Mapping[str, Floats], notes: Sequence[str]
) -> bytes:
    """Return a PNG of the images of a capture as they are used: aligned, masked and normalised.

    The images are in order and divided by the light intensities. In the disc in the corner of each
    image, a dot shows (x, y) of its light direction; the rim of the disc is perpendicular to the
    viewing direction. The mask and `others`, such as an ambient image, follow as linear gray maps
    (h, w). Notes, for example about images that were left out, are at the bottom.
    """
    import cv2

    rows, inside = _sample(capture.mask, -(-max(capture.mask.shape) // _SIDE))
    values = capture.observations[rows]
    bright = float(np.quantile(values, 0.995)) if values.size else 0.0
    tiles: list[tuple[str, Picture]] = []
    for number, (name, (x, y, _)) in enumerate(zip(names, capture.light_directions, strict=True)):
        image = np.zeros(inside.shape)
        image[inside] = values[:, number]
        tiles.append((f"{number + 1} {name}", _draw_light(_shown(image, bright), x, y)))
    tiles.append(("mask", _shown(inside.astype(np.float64), 1.0)))
    for name, other in others.items():
        step = -(-max(other.shape) // _SIDE)
        shown = other[::step, ::step]
        tiles.append((name, _shown(shown, float(np.quantile(shown, 0.995)))))

    columns, tall = min(_COLUMNS, len(tiles)), max(tile.shape[0] for _, tile in tiles)
    width = max(_GAP + columns * (_SIDE + _GAP), 60 * _LETTER)
    lines = [line for note in notes for line in textwrap.wrap(printable(note), width // _LETTER)]
    if len(lines) > _MOST_NOTES:
        lines = [*lines[: _MOST_NOTES - 1], "..."]
    cell = tall + _LINE + _GAP
    below = _GAP + -(-len(tiles) // columns) * cell
    sheet = np.full((below + len(lines) * _LINE + _GAP, width, 3), 255, np.uint8)

    def write(left: int, bottom: int, words: str) -> None:
        words = words.encode("ascii", "replace").decode()  # the font has no other letters
        cv2.putText(
            sheet, words, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA
        )

    for number, (name, tile) in enumerate(tiles):
        row, column = divmod(number, columns)
        top, left = _GAP + row * cell, _GAP + column * (_SIDE + _GAP)
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
        write(left, top + tall + _LINE - 4, printable(name)[: _SIDE // _LETTER])
    for number, line in enumerate(lines):
        write(_GAP, below + number * _LINE + _LINE // 2, line)
    return encode_png(sheet)


def _sample(mask: Bools, step: int) -> tuple[NDArray[np.intp], Bools]:
    """Return the indices (n,) of every step-th pixel in both directions among a mask's (H, W) true
    pixels.

    Also return the mask of these pixels.
    """
    before = np.concatenate(([0], np.cumsum(np.count_nonzero(mask, axis=1))))
    numbers = [
        before[row] + np.cumsum(mask[row])[::step][mask[row, ::step]] - 1
        for row in range(0, len(mask), step)
    ]
    return np.concatenate(numbers), mask[::step, ::step]


def _shown(values: Floats, white: float) -> Picture:
    """Return linear values (h, w) as an RGB picture."""
    shares = np.asarray(values, np.float64) / max(white, 1e-12)
    gray = (255 * np.sqrt(shares.clip(0, 1))).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=2)


def _draw_light(picture: Picture, x: float, y: float) -> Picture:
    """Draw the disc of a light into the lower right corner of a picture, if it is large enough."""
    side = 2 * _DISC + 1
    if min(picture.shape[:2]) < side:
        return picture
    down, right = np.mgrid[-_DISC : _DISC + 1, -_DISC : _DISC + 1]
    corner = picture[-side:, -side:]
    corner[np.hypot(down, right) <= _DISC] = _PALE
    corner[np.hypot(down, right) <= 1] = _GRAY
    at = np.hypot(down + y * (_DISC - 2), right - x * (_DISC - 2))
    corner[at <= 3] = _ORANGE
    return picture
