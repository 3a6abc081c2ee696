"""Compute the maps listed in MAPS from the normals and the images of a capture, and their files."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from pkgutil import resolve_name
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource
from splinecli.capture.linearise import StoredPixels, take_pixels
from splinecli.maths import Floats
from splinecli.maths.normals import curvature_of_normals, gradient_of_normals
from splinecli.output_files import MAPS, OutputMap
from splinecli.pictures.maps import Picture, encode_png
from splinecli.surface.integration import relief_of_normals
from splinecli.surface.surface_files import encode_exr, encode_tiff

if TYPE_CHECKING:
    from splinecli.inference import NormalEstimate
    from splinecli.system.publishing import Content

Progress = Callable[[], object]


def chosen_maps(names: Collection[str], *, page: bool = False) -> list[OutputMap]:
    """Return the rows with these names and the rows shown on the page, with the most memory-intensive ones last."""
    rows = [row for row in MAPS.values() if row.name in names or (page and row.caption)]
    return sorted(rows, key=lambda row: row.bytes_per_pixel)


def make_map(
    row: OutputMap, source: CaptureSource, estimate: NormalEstimate, progress: Progress = lambda: None
) -> NDArray[np.float32] | None:
    """Return the values of a map, or None if the capture or the method does not provide it. Raises InputError."""
    found: NDArray[np.float32] | None = resolve_name(row.make)(source, estimate, progress)
    return found


def map_picture(row: OutputMap, values: Floats, mask: NDArray[np.bool_], scale: float | None = None) -> Picture:
    """Return a picture of a map's values (H, W) or (H, W, C); None uses the row's own scale."""
    scales = [] if row.scale is None else [row.scale if scale is None else scale]
    picture: Picture = resolve_name(row.picture)(values, mask, *scales)
    return picture


def map_files(
    row: OutputMap,
    values: NDArray[np.float32],
    mask: NDArray[np.bool_],
    formats: Collection[str],
    *,
    scale: float | None = None,
) -> Iterator[tuple[str, Content]]:
    """Yield the files of a map: NPY and PNG whenever the map has them, TIFF and EXR only if they are requested."""
    for part in row.parts:
        channels = values[..., part.first : part.last]
        if part.has_values:
            yield f"{part.name}.npy", np.squeeze(channels, 2) if channels.shape[2] == 1 else channels
        yield f"{part.name}.png", encode_png(resolve_name(part.picture)(channels, mask))
    scale = row.scale if scale is None else scale
    for suffix, name in row.files.items():
        if suffix == "npy":
            yield name, values
        elif suffix == "tiff" and suffix in formats:
            yield name, encode_tiff(values, row.unit)
        elif suffix == "exr" and suffix in formats:
            largest = np.finfo(np.float16).max
            yield name, encode_exr(values.clip(0, largest).astype(np.float16), {"colours": row.unit})
        elif suffix == "png":
            texts = {row.name: row.scale_text.format(scale=scale)} if row.scale_text else None
            yield name, encode_png(map_picture(row, values, mask, scale), texts)


def albedo(source: CaptureSource, estimate: NormalEstimate, progress: Progress) -> NDArray[np.float32]:
    return albedo_map(source, estimate.capture, estimate.normal_map, progress)


def confidence(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32] | None:
    return estimate.confidence_map


def normals(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return estimate.normal_map


def gradient(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return gradient_of_normals(estimate.normal_map, estimate.capture.mask)


def curvature(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return curvature_of_normals(estimate.normal_map, estimate.capture.mask)


def relief(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return relief_of_normals(estimate.normal_map, estimate.capture.mask)


def albedo_map(
    source: CaptureSource,
    capture: Capture,
    normal_map: NDArray[np.float32],
    progress: Callable[[], object] = lambda: None,
) -> NDArray[np.float32]:
    """Return the linear RGB diffuse albedo (H, W, 3), zero outside the mask and where no light reaches.

    A pixel's albedo is the least-squares solution of Lambert's law, I = albedo * n.l, over the lights that agree with
    the pixel's median of I / (n.l). Its scale is the scale of the images divided by the light intensities, so it is
    known up to one factor for the whole capture unless the intensities are absolute.

    The images of the source are read again, one at a time, for their colours; `progress` is called after each. The
    capture must have been read from this source; under near lamps, it must contain its surface points. The normal map
    (H, W, 3) has unit length in its mask. Raises InputError if an image can no longer be read.
    """
    normals = take_pixels(normal_map, capture.mask)
    counts = np.empty(capture.observations.shape, np.bool_)
    for start in range(0, len(normals), 65_536):
        tile = slice(start, start + 65_536)
        cosines, attenuation = _shading(capture, normals, tile, range(capture.n_lights))
        counts[tile] = agreeing_lights(capture.observations[tile] / attenuation, cosines)
    total, squares = np.zeros((len(normals), 3), np.float32), np.zeros(len(normals), np.float32)
    for position, colours in enumerate(colours_of_surface(source, capture, normals, progress)):
        cosine = _shading(capture, normals, slice(None), [position])[0][:, 0] * counts[:, position]
        weight = cosine
        if capture.restored is not None:
            # The colour of a restored observation is saturated, so only the other observations are used.
            weight = cosine * np.where(capture.restored[:, position], np.float32(1e-3), np.float32(1))
        colours *= weight[:, None]  # in place, because large captures need the memory
        total += colours
        squares += weight * cosine
        del colours
    albedo = np.zeros((*capture.mask.shape, 3), np.float32)
    albedo[capture.mask] = np.divide(total, squares[:, None], out=total, where=squares[:, None] > 0)
    return albedo


def colours_of_surface(
    source: CaptureSource, capture: Capture, normals: NDArray[np.float32], progress: Progress
) -> Iterator[NDArray[np.float32]]:
    """Yield the linear RGB values (P, 3) of each image as under a distant white lamp of intensity 1; see albedo_map."""
    images = source.read_pixels(capture.mask, capture.light_indices, StoredPixels.colours, progress)
    for position, colours in enumerate(images):
        colours /= _shading(capture, normals, slice(None), [position])[1]
        if capture.estimated_colours is not None:
            colours /= capture.estimated_colours[position].astype(np.float32)
        if capture.estimated_intensities is not None:
            colours /= np.float32(capture.estimated_intensities[position])
        yield colours
        del colours


def _shading(
    capture: Capture, normals: NDArray[np.float32], pixels: slice, positions: Sequence[int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return n.l (p, K) for some pixels under K lights, and the lights' attenuation (p, K), or (1, 1) if distant."""
    if capture.lamps is None:
        lights = capture.light_directions[list(positions)].astype(np.float32)
        return normals[pixels] @ lights.T, np.ones((1, 1), np.float32)
    assert capture.lamps.points is not None
    directions, attenuation = capture.lamps.choose_lights(positions).light_at(capture.lamps.points[pixels])
    return np.einsum("pfc,pc->pf", directions, normals[pixels]), attenuation


def agreeing_lights(observations: NDArray[np.float32], cosine: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which observations (P, F) are lit and neither highlights nor in cast shadow; `cosine` (P, F) is n.l."""
    lit = cosine > 0.15  # excludes grazing light
    albedo = np.divide(observations, cosine, out=np.full_like(observations, np.inf), where=lit)
    # The median of the lit observations, which sorting moves to the front.
    ordered, number = np.sort(albedo, axis=1), lit.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum((number - 1) // 2, 0)[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        # The other observations are highlights or in cast shadow.
        close: NDArray[np.bool_] = lit & (np.abs(albedo - middle) <= 0.3 * middle)
    return close
