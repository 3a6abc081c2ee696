"""Compute the values of maps from the normals and the images of a capture. Each function is
registered for a row of MAPS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource
from splinecli.capture.linearise import StoredPixels, take_pixels
from splinecli.maths import Picture
from splinecli.maths.normals import curvature_of_normals, gradient_of_normals
from splinecli.maths.pixel_grid import on_map
from splinecli.pictures.maps import (
    albedo_picture,
    confidence_picture,
    preview_picture,
    signed_picture,
)
from splinecli.surface.integration import relief_of_normals

if TYPE_CHECKING:
    from splinecli.estimate.inference import NormalEstimate

Progress = Callable[[], object]
Make = Callable[[CaptureSource, "NormalEstimate", Progress], NDArray[np.float32] | None]


class MapFunctions(NamedTuple):
    """The functions for a row of MAPS."""

    make: Make  # returns float32 values (H, W) or (H, W, C), or None if the map is not available
    picture: Callable[..., Picture]  # takes values and mask, and the scale if the row has one


MAP_FUNCTIONS: dict[str, MapFunctions] = {}


def makes(
    name: str, picture: Callable[..., Picture], **parts: Callable[..., Picture]
) -> Callable[[Make], Make]:
    """Register a function that computes a row of MAPS, with the pictures of the row and of its
    parts.
    """

    def register(make: Make) -> Make:
        for each, function in {name: picture, **parts}.items():
            MAP_FUNCTIONS[each] = MapFunctions(make, function)
        return make

    return register


@makes("albedo", albedo_picture)
def albedo(
    source: CaptureSource, estimate: NormalEstimate, progress: Progress
) -> NDArray[np.float32]:
    return albedo_map(source, estimate.capture, estimate.normal_map, progress)


@makes("confidence", confidence_picture)
def confidence(
    _: CaptureSource, estimate: NormalEstimate, __: Progress
) -> NDArray[np.float32] | None:
    return estimate.confidence_map


@makes("preview", preview_picture)
def normals(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return estimate.normal_map


@makes("gradient", signed_picture)
def gradient(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return gradient_of_normals(estimate.normal_map, estimate.capture.mask)


@makes("curvature", signed_picture)
def curvature(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return curvature_of_normals(estimate.normal_map, estimate.capture.mask)


@makes("relief", signed_picture)
def relief(_: CaptureSource, estimate: NormalEstimate, __: Progress) -> NDArray[np.float32]:
    return relief_of_normals(estimate.normal_map, estimate.capture.mask)


def albedo_map(
    source: CaptureSource,
    capture: Capture,
    normal_map: NDArray[np.float32],
    progress: Callable[[], object] = lambda: None,
) -> NDArray[np.float32]:
    """Return the linear RGB diffuse albedo (H, W, 3), zero outside the mask and where no light
    reaches.

    The albedo of a pixel is the least-squares solution of Lambert's law, I = albedo * n.l, over the
    lights that agree with the pixel's median of I / (n.l). It has the scale of the images divided
    by the light intensities, so it is known up to one factor for the whole capture unless the
    intensities are absolute.

    For their colours, the images of the source are read again, one at a time; `progress` is called
    after each. The capture must have been read from this source; under near lamps, it must contain
    its surface points. The normal map (H, W, 3) has unit length in its mask. Raises InputError if
    an image can no longer be read.
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
            # The colours of restored observations are saturated, so they have a very low weight.
            weight = cosine * np.where(
                capture.restored[:, position], np.float32(1e-3), np.float32(1)
            )
        colours *= weight[:, None]  # in place, because large captures need the memory
        total += colours
        squares += weight * cosine
        del colours
    albedo = np.divide(total, squares[:, None], out=total, where=squares[:, None] > 0)
    return on_map(albedo, capture.mask)


def colours_of_surface(
    source: CaptureSource, capture: Capture, normals: NDArray[np.float32], progress: Progress
) -> Iterator[NDArray[np.float32]]:
    """Yield the linear RGB values (P, 3) of each image, converted to a distant white lamp of
    intensity 1.

    See albedo_map for the arguments.
    """
    images = source.read_pixels(capture.mask, capture.light_indices, StoredPixels.colours, progress)
    for position, colours in enumerate(images):
        colours /= _shading(capture, normals, slice(None), [position])[1]
        if capture.estimated_intensities is not None:
            colours /= np.float32(capture.estimated_intensities[position])
        yield colours
        del colours


def _shading(
    capture: Capture, normals: NDArray[np.float32], pixels: slice, positions: Sequence[int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return n.l (p, K) and attenuations (p, K) for pixels under K lights; (1, 1) for distant
    lights.
    """
    if capture.lamps is None:
        lights = capture.light_directions[list(positions)].astype(np.float32)
        return normals[pixels] @ lights.T, np.ones((1, 1), np.float32)
    assert capture.lamps.points is not None
    directions, attenuation = capture.lamps.choose_lights(positions).light_at(
        capture.lamps.points[pixels]
    )
    return np.einsum("pfc,pc->pf", directions, normals[pixels]), attenuation


def agreeing_lights(
    observations: NDArray[np.float32], cosine: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return which observations (P, F) are lit, but neither highlights nor in cast shadow.

    `cosine` (P, F) is n.l.
    """
    lit = cosine > 0.15  # excludes grazing light
    albedo = np.divide(observations, cosine, out=np.full_like(observations, np.inf), where=lit)
    # Sorting moves the lit observations to the front.
    ordered, number = np.sort(albedo, axis=1), lit.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum((number - 1) // 2, 0)[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        close: NDArray[np.bool_] = lit & (np.abs(albedo - middle) <= 0.3 * middle)
    return close
