"""Capture + Estimator -> NormalEstimate, in tiles: memory beyond the capture is bounded by one tile."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.methods import Estimator
from splinecli.metrics import AngularErrors, angular_error_map_deg, summarise_errors

TILE_PIXELS = 16_384


@dataclass(frozen=True)
class NormalEstimate:
    """The normals of one capture.

    normal_map: (H, W, 3) float32, unit, zero outside the mask. error_map_deg: (H, W) float32, NaN where there
    is no ground truth, or None without any; errors: its summary. seconds: spent estimating.
    """

    capture: Capture
    normal_map: NDArray[np.float32]
    seconds: float
    error_map_deg: NDArray[np.float32] | None = None
    errors: AngularErrors | None = None


def estimate_normals(
    capture: Capture,
    estimator: Estimator,
    *,
    tile_pixels: int = TILE_PIXELS,
    progress: Callable[[int], None] | None = None,
) -> NormalEstimate:
    """Run an estimator over a capture, `tile_pixels` at a time; `progress` is told the pixels just done."""
    started = time.perf_counter()
    normals = np.empty((capture.n_pixels, 3), np.float32)
    for start in range(0, capture.n_pixels, tile_pixels):
        tile = capture.observations[start : start + tile_pixels]
        normals[start : start + tile_pixels] = estimator.estimate(tile, capture.light_directions)
        if progress is not None:
            progress(len(tile))
    seconds = time.perf_counter() - started
    normal_map = np.zeros((*capture.mask.shape, 3), np.float32)
    normal_map[capture.mask] = normals
    if capture.ground_truth is None:
        return NormalEstimate(capture, normal_map, seconds)
    error_map = angular_error_map_deg(normal_map, capture.ground_truth, capture.mask)
    return NormalEstimate(capture, normal_map, seconds, error_map, summarise_errors(error_map))
