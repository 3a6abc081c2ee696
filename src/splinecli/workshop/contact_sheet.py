"""The contact sheet of a pixel set: normals and two images of each material for each scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Bools, Floats, Picture
from splinecli.maths.normals import encode_picture

if TYPE_CHECKING:
    from splinecli.workshop.pixel_sets.store import Entry, PixelSet


MOST_SCENES = 120


def contact_sheet(pixel_set: PixelSet) -> Picture:
    """Return an RGB picture (H, W, 3) with a strip for each scene, or for MOST_SCENES evenly chosen
    scenes.
    """
    scenes: dict[str, list[Entry]] = {}
    for entry in pixel_set.entries:
        scenes.setdefault(entry.scene, []).append(entry)
    every = -(-len(scenes) // MOST_SCENES)
    # Large enough to recognise shapes and materials; sixty scenes fit on a screen or two.
    tile = 160 if len(scenes) <= 12 else 96
    with np.errstate(all="ignore"):  # a damaged array may have NaN
        strips = [_strip(pixel_set, entries, tile) for entries in list(scenes.values())[::every]]
    width = max(strip.shape[1] for strip in strips)
    across = max(1, 1900 // width)
    padded = [np.pad(strip, ((2, 2), (2, width - strip.shape[1] + 6), (0, 0))) for strip in strips]
    padded += [np.zeros_like(padded[0])] * (-len(padded) % across)
    rows = [np.hstack(padded[start : start + across]) for start in range(0, len(padded), across)]
    return np.vstack(rows)


def _strip(pixel_set: PixelSet, entries: list[Entry], tile: int) -> Picture:
    first = pixel_set.load(entries[0])
    tiles = [
        _fit(
            encode_picture(_on_mask(first.normals, first.mask), np.asarray(first.mask), bits=8),
            tile,
        )
    ]
    for pixels in map(pixel_set.load, entries):
        for light in ((0.4, 0.4, 0.82), (-0.75, 0.2, 0.63)):
            # The image under the closest light, scaled so that its 98th percentile is white.
            closest = int(np.argmax(pixels.light_directions @ np.array(light)))
            values = np.asarray(pixels.observations[:, closest], np.float32)
            exposed = (values / max(float(np.percentile(values, 98)), 1e-6)).clip(0, 1) ** (1 / 2.2)
            gray = np.rint(exposed[:, None] * 255).repeat(3, axis=1)
            tiles.append(_fit(_on_mask(gray, pixels.mask).astype(np.uint8), tile))
    return np.hstack(tiles)


def _on_mask(values: Floats, mask: Bools) -> Floats:
    picture = np.zeros((*mask.shape, values.shape[1]), values.dtype)
    picture[mask] = values
    return picture


def _fit(picture: NDArray[np.unsignedinteger], tile: int) -> Picture:
    import cv2

    scale = tile / max(picture.shape[:2])
    height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
    small = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    top, left = (tile - height) // 2, (tile - width) // 2
    return np.pad(small, ((top, tile - height - top), (left, tile - width - left), (0, 0)))
