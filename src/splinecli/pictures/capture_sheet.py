"""The contact sheet of a capture, which shows how its files are used."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource
from splinecli.capture.formats.images import read_image
from splinecli.errors import printable
from splinecli.maths import Bools, Floats, Picture
from splinecli.pictures.maps import encode_png
from splinecli.records.capture_warnings import (
    ESTIMATED_LIGHTS,
    IMAGES_LEFT_OUT,
    LIGHTS_FOUND,
    MASK_CHOICE,
)

_SIDE, _GAP, _LINE = 112, 8, 15  # pixels: side of a picture, gap, and height of a line of text
_DISC = 15  # radius of the disc of a light in pixels
_BESIDE = 2 * _DISC + 5  # pixels from the left edge of a disc to the text beside it
_COLUMNS, _MOST_NOTES, _LETTER = 10, 12, 6  # _LETTER is the width of a letter in pixels
_ORANGE, _PALE, _GRAY, _BACKGROUND = (213, 94, 0), 255, 120, 225


def sheet_of(source: CaptureSource, capture: Capture) -> bytes:
    """Return the contact sheet of a capture that was read from files; see capture_sheet."""
    radiometry = source.radiometry
    others = {} if radiometry.ambient is None else {"ambient image": radiometry.ambient}
    others |= {f"flat field {n}": path for n, path in enumerate(radiometry.flat_field, start=1)}
    kinds = (IMAGES_LEFT_OUT, LIGHTS_FOUND, ESTIMATED_LIGHTS, MASK_CHOICE)
    return capture_sheet(
        capture,
        source.image_names(capture.light_indices),
        {name: read_image(path).mean(axis=2) for name, path in others.items()},
        [warning.text for warning in capture.warnings if warning.kind in kinds],
        mask=f"mask: {source.files.mask.name}" if source.files.mask else "mask",
    )


def capture_sheet(
    capture: Capture,
    names: Sequence[str],
    others: Mapping[str, Floats],
    notes: Sequence[str],
    *,
    mask: str = "mask",
) -> bytes:
    """Return a PNG of the images of a capture as they are used: aligned, masked and normalised.

    The images are in order and divided by the light intensities. In the disc below each image, a
    dot shows (x, y) of its light direction; the rim of the disc is perpendicular to the viewing
    direction. The mask and `others`, such as an ambient image, follow as linear gray maps (h, w).
    `mask` is the label of the mask. Notes, for example about images that were left out, are at the
    bottom.
    """
    import cv2

    rows, inside = _sample(capture.mask, max(1, max(capture.mask.shape) // _SIDE))
    values = capture.observations[rows]
    bright = float(np.quantile(values, 0.995)) if values.size else 0.0
    tiles: list[tuple[str, Picture]] = []
    for number, name in enumerate(_shortened(names)):
        image = np.zeros(inside.shape)
        image[inside] = values[:, number]
        tiles.append((f"{number + 1} {name}", _shown(image, bright)))
    whole = " (whole image)" if capture.mask.all() else ""
    tiles.append((f"{mask}{whole}", _shown(inside.astype(np.float64), 1.0)))
    for name, other in others.items():
        # less than white, so that a uniform image does not look empty
        tiles.append((name, _shown(other, 1.5 * float(np.quantile(other, 0.995)))))

    columns, tall = min(_COLUMNS, len(tiles)), max(tile.shape[0] for _, tile in tiles)
    width = max(_GAP + columns * (_SIDE + _GAP), 60 * _LETTER)
    lines = [line for note in notes for line in textwrap.wrap(printable(note), width // _LETTER)]
    if len(lines) > _MOST_NOTES:
        lines = [*lines[: _MOST_NOTES - 1], "..."]
    cell = tall + 1 + 2 * _DISC + 1 + _GAP
    below = _GAP + -(-len(tiles) // columns) * cell
    sheet = np.full((below + len(lines) * _LINE + _GAP, width, 3), _BACKGROUND, np.uint8)

    def write(left: int, bottom: int, words: str) -> None:
        words = words.encode("ascii", "replace").decode()  # the font has no other letters
        cv2.putText(
            sheet, words, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA
        )

    for number, (name, tile) in enumerate(tiles):
        row, column = divmod(number, columns)
        top, left = _GAP + row * cell, _GAP + column * (_SIDE + _GAP)
        bottom, right = top + tile.shape[0], left + tile.shape[1]
        sheet[top - 1 : bottom + 1, left - 1 : right + 1] = _GRAY
        sheet[top:bottom, left:right] = tile
        beside = 0
        if number < len(names):
            x, y, _ = capture.light_directions[number]
            _draw_light(sheet[top + tall + 1 :, left:], x, y)
            beside = _BESIDE
        room = (_SIDE - beside) // _LETTER
        too_long = max(map(len, name.split())) > room
        for row, words in enumerate(_lines(printable(name), room, break_words=too_long)[:2]):
            write(left + beside, top + tall + (row + 1) * _LINE - 3, words)
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


def _shortened(names: Sequence[str]) -> list[str]:
    """Return the names without their common start and suffix if one does not fit its label."""
    start = os.path.commonprefix(names)  # noqa: RUF071 - by characters
    room = (_SIDE - _BESIDE) // _LETTER
    labels = [_lines(f"{len(names)} {name}", room, break_words=False) for name in names]
    if start in names or all(len(max(ls, key=len)) <= room and len(ls) <= 2 for ls in labels):
        return list(names)
    ends = {PurePath(name).suffix for name in names}
    end = ends.pop() if len(ends) == 1 else ""
    return [f"...{name.removeprefix(start).removesuffix(end)}" for name in names]


def _lines(words: str, room: int, *, break_words: bool) -> list[str]:
    return textwrap.wrap(words, room, break_long_words=break_words, break_on_hyphens=False)


def _shown(values: Floats, white: float) -> Picture:
    """Return linear values (h, w) as an RGB picture with a longer side of _SIDE pixels."""
    import cv2

    step = max(1, max(values.shape) // _SIDE)
    shares = np.sqrt((values[::step, ::step] / max(white, 1e-12)).clip(0, 1))
    scale = _SIDE / max(shares.shape)
    height, width = (max(1, round(scale * size)) for size in shares.shape)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    gray = cv2.resize(255 * shares.astype(np.float32), (width, height), interpolation=how)
    return np.repeat(gray.astype(np.uint8)[..., None], 3, axis=2)


def _draw_light(place: Picture, x: float, y: float) -> None:
    """Draw the disc of a light into the upper left corner of a picture."""
    down, right = np.mgrid[-_DISC : _DISC + 1, -_DISC : _DISC + 1]
    corner = place[: 2 * _DISC + 1, : 2 * _DISC + 1]
    corner[np.hypot(down, right) <= _DISC] = _PALE
    corner[np.hypot(down, right) <= 1] = _GRAY
    at = np.hypot(down + y * (_DISC - 2), right - x * (_DISC - 2))
    corner[at <= 3] = _ORANGE
