"""The albedo map: how much of the light each pixel throws back, in colour, once its normal is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture, CaptureSource

LIT = 0.15
"""Lights count where n.l is above this."""

AGREEING = 0.3
"""Observations count whose albedo is within this share of the pixel's median: no highlights, no cast shadows."""

_TILE_PIXELS = 65_536


def albedo_map(
    source: CaptureSource,
    capture: Capture,
    normal_map: NDArray[np.float32],
    progress: Callable[[], object] | None = None,
) -> NDArray[np.float32]:
    """Diffuse albedo (H, W, 3) RGB, linear, zero outside the mask and where no light reaches.

    By Lambert's law, I / (n.l), least squares over the lights that agree with the pixel's median. Its scale is that of
    the images over the light intensities: known up to one factor for the whole capture, unless those are absolute.

    Args:
        source: of the capture; its images are read once more, one at a time, for their colours.
        normal_map: (H, W, 3), unit in the capture's mask.
        progress: called once after each image.

    Raises:
        InputError: an image can no longer be read.
    """
    normals = normal_map[capture.mask]
    lights = capture.light_directions.astype(np.float32)
    counts = np.empty(capture.observations.shape, np.bool_)
    for start in range(0, len(normals), _TILE_PIXELS):
        tile = slice(start, start + _TILE_PIXELS)
        counts[tile] = _agreeing(capture.observations[tile], normals[tile] @ lights.T)
    read = source.colours(capture.mask)
    total, squares = np.zeros((len(normals), 3), np.float32), np.zeros(len(normals), np.float32)
    for position, index in enumerate(capture.light_indices):
        cosine = (normals @ lights[position]) * counts[:, position]
        colours = read(index)
        if capture.estimated_intensities is not None:
            colours /= np.float32(capture.estimated_intensities[position])
        weight = cosine
        if capture.restored is not None:
            # The colours of restored observations are saturated, so the other observations decide.
            weight = cosine * np.where(capture.restored[:, position], np.float32(1e-3), np.float32(1))
        total += weight[:, None] * colours
        squares += weight * cosine
        if progress is not None:
            progress()
    albedo = np.zeros((*capture.mask.shape, 3), np.float32)
    albedo[capture.mask] = np.divide(
        total, squares[:, None], out=np.zeros_like(total), where=squares[:, None] > 0
    )
    return albedo


def _agreeing(observations: NDArray[np.float32], cosine: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which observations (P, F) are lit and neither highlight nor cast shadow; cosine (P, F) of normal and light."""
    lit = cosine > LIT
    albedo = np.divide(observations, cosine, out=np.full_like(observations, np.inf), where=lit)
    # The median over the lit ones, which sorting brings to the front.
    ordered, number = np.sort(albedo, axis=1), lit.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum((number - 1) // 2, 0)[:, None], axis=1)
    with np.errstate(invalid="ignore"):
        close: NDArray[np.bool_] = lit & (np.abs(albedo - middle) <= AGREEING * middle)
    return close
