"""The albedo map: the share of the light that each pixel reflects, in colour, computed from the normal map."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource
from splinecli.capture.linearise import StoredPixels, take_pixels

LIT = 0.15  # a light counts for a pixel if n.l is above this
AGREEING = 0.3  # an observation counts within this share of the median albedo: no highlights, no cast shadows
RESTORED_WEIGHT = 1e-3  # of a restored observation, whose colour is saturated: the others decide
_TILE_PIXELS = 65_536


def albedo_map(
    source: CaptureSource,
    capture: Capture,
    normal_map: NDArray[np.float32],
    progress: Callable[[], object] = lambda: None,
) -> NDArray[np.float32]:
    """Return the linear RGB diffuse albedo (H, W, 3), zero outside the mask and where no light reaches.

    A pixel's albedo is the least-squares solution of Lambert's law, I = albedo * n.l, over the lights that agree with
    the pixel's median of I / (n.l). Its scale is that of the images divided by the light intensities, so it is known up
    to one factor for the whole capture unless the intensities are absolute.

    The images of the source are read again, one at a time, for their colours; `progress` is called after each. The
    capture is what the source read; under near lamps, with the points of its surface. The normal map (H, W, 3) is unit
    in its mask. Raises InputError if an image can no longer be read.
    """
    normals = take_pixels(normal_map, capture.mask)
    counts = np.empty(capture.observations.shape, np.bool_)
    for start in range(0, len(normals), _TILE_PIXELS):
        tile = slice(start, start + _TILE_PIXELS)
        cosines, strengths = _shading(capture, normals, tile, range(capture.n_lights))
        counts[tile] = _agreeing(capture.observations[tile] / strengths, cosines)
    total, squares = np.zeros((len(normals), 3), np.float32), np.zeros(len(normals), np.float32)
    images = source.read_pixels(capture.mask, capture.light_indices, StoredPixels.colours, progress)
    for position, colours in enumerate(images):
        cosines, strengths = _shading(capture, normals, slice(None), [position])
        cosine = cosines[:, 0] * counts[:, position]
        colours /= strengths
        if capture.estimated_colours is not None:
            colours /= capture.estimated_colours[position].astype(np.float32)
        if capture.estimated_intensities is not None:
            colours /= np.float32(capture.estimated_intensities[position])
        weight = cosine
        if capture.restored is not None:
            weight = cosine * np.where(capture.restored[:, position], np.float32(RESTORED_WEIGHT), np.float32(1))
        colours *= weight[:, None]  # in place, because large captures need the memory
        total += colours
        squares += weight * cosine
        del colours
    albedo = np.zeros((*capture.mask.shape, 3), np.float32)
    albedo[capture.mask] = np.divide(total, squares[:, None], out=total, where=squares[:, None] > 0)
    return albedo


def _shading(
    capture: Capture, normals: NDArray[np.float32], rows: slice, positions: Sequence[int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return n.l (p, K) of some pixels under K lights, and the strengths of these: (p, K), or (1, 1) if distant."""
    if capture.lamps is None:
        lights = capture.light_directions[list(positions)].astype(np.float32)
        return normals[rows] @ lights.T, np.ones((1, 1), np.float32)
    assert capture.lamps.points is not None
    directions, strengths = capture.lamps.choose_lights(positions).light_at(capture.lamps.points[rows])
    return np.einsum("pfc,pc->pf", directions, normals[rows]), strengths


def _agreeing(observations: NDArray[np.float32], cosine: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which observations (P, F) are lit and neither highlights nor in cast shadow; `cosine` (P, F) is n.l."""
    lit = cosine > LIT
    albedo = np.divide(observations, cosine, out=np.full_like(observations, np.inf), where=lit)
    # The median of the lit observations, which sorting moves to the front.
    ordered, number = np.sort(albedo, axis=1), lit.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum((number - 1) // 2, 0)[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        close: NDArray[np.bool_] = lit & (np.abs(albedo - middle) <= AGREEING * middle)
    return close
