"""The optional maps of `infer`: their values, pictures and files, as defined by MAPS."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

import numpy as np

from splinecli.capture import CaptureSource
from splinecli.maths import Bools, Float32Array, Floats, Picture
from splinecli.pictures.maps import encode_png
from splinecli.records.output_files import MAPS, OutputMap
from splinecli.results import material  # noqa: F401 - its map is in MAP_FUNCTIONS once it is imported
from splinecli.results.map_values import MAP_FUNCTIONS, Progress
from splinecli.surface.surface_files import encode_exr, encode_tiff

if TYPE_CHECKING:
    from splinecli.estimate.inference import NormalEstimate
    from splinecli.system.publishing import Content


def chosen_maps(names: Collection[str], *, page: bool = False) -> list[OutputMap]:
    """Return the rows with these names and the rows shown on the page, in ascending order of
    memory.
    """
    rows = [row for row in MAPS.values() if row.name in names or (page and row.caption)]
    return sorted(rows, key=lambda row: row.bytes_per_pixel)


def make_map(
    row: OutputMap,
    source: CaptureSource,
    estimate: NormalEstimate,
    progress: Progress = lambda: None,
) -> Float32Array | None:
    """Return the values of a map; None if the capture or the method does not provide it.

    Raises InputError.
    """
    return MAP_FUNCTIONS[row.name].make(source, estimate, progress)


def map_picture(row: OutputMap, values: Floats, mask: Bools, scale: float | None = None) -> Picture:
    """Return a picture of a map's values (H, W) or (H, W, C). By default, the row's scale is
    used.
    """
    scales = [] if row.scale is None else [row.scale if scale is None else scale]
    return MAP_FUNCTIONS[row.name].picture(values, mask, *scales)


def map_files(
    row: OutputMap,
    values: Float32Array,
    mask: Bools,
    formats: Collection[str],
    *,
    scale: float | None = None,
) -> Iterator[tuple[str, Content]]:
    """Yield the files of a map. TIFF and EXR files are included only if they are requested."""
    for part in row.parts:
        channels = values[..., part.first : part.last]
        if part.has_values:
            single = channels.shape[2] == 1
            yield f"{part.name}.npy", channels[..., 0] if single else channels
        yield f"{part.name}.png", encode_png(MAP_FUNCTIONS[part.name].picture(channels, mask))
    scale = row.scale if scale is None else scale
    for suffix, name in row.files.items():
        if suffix == "npy":
            yield name, values
        elif suffix == "tiff" and suffix in formats:
            yield name, encode_tiff(values, row.unit)
        elif suffix == "exr" and suffix in formats:
            colours = values.clip(0, np.finfo(np.float16).max).astype(np.float16)
            yield name, encode_exr(colours, {"colours": row.unit})
        elif suffix == "png":
            texts = {row.name: row.scale_text.format(scale=scale)} if row.scale_text else None
            yield name, encode_png(map_picture(row, values, mask, scale), texts)
