"""Capture + Estimator -> NormalEstimate, in tiles: what a method needs to work is bounded by one tile.

The normals themselves, and the errors, grow with the capture.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.errors import SplinecliError
from splinecli.methods import Estimator
from splinecli.methods.estimator import tells_confidence
from splinecli.metrics import AngularErrors, angular_error_map_deg, summarise_errors

TILE_PIXELS = 16_384
_UNIT_TOLERANCE = 1e-2  # float16 and bfloat16 normals pass, zero ones and NaN do not


@dataclass(frozen=True)
class NormalEstimate:
    """The normals of one capture.

    normal_map: (H, W, 3) float32, unit, zero outside the mask. error_map_deg: (H, W) float32, NaN where there
    is no ground truth, or None without any; errors: its summary. seconds: spent estimating. confidence_map:
    (H, W) float32, the probability that the normal is off by no more than CONFIDENT_DEG, zero outside the mask; None
    where the method does not tell.
    """

    capture: Capture
    normal_map: NDArray[np.float32]
    seconds: float
    error_map_deg: NDArray[np.float32] | None = None
    errors: AngularErrors | None = None
    confidence_map: NDArray[np.float32] | None = None

    @property
    def expected_under_5(self) -> float | None:
        """The share of the pixels whose normals are probably off by no more than 5 degrees; None without confidence."""
        if self.confidence_map is None:
            return None
        return float(self.confidence_map[self.capture.mask].mean())


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
    confidence = np.empty(capture.n_pixels, np.float32) if tells_confidence(estimator) else None
    for start in range(0, capture.n_pixels, tile_pixels):
        rows = slice(start, start + tile_pixels)
        tile = capture.observations[rows]
        if confidence is not None and tells_confidence(estimator):
            normals[rows], confidence[rows] = estimator.estimate_with_confidence(
                tile, capture.light_directions
            )
        else:
            normals[rows] = estimator.estimate(tile, capture.light_directions)
        if progress is not None:
            progress(len(tile))
    seconds = time.perf_counter() - started
    _check_unit(normals, estimator.name)
    normal_map = np.zeros((*capture.mask.shape, 3), np.float32)
    normal_map[capture.mask] = normals
    confidence_map = None
    if confidence is not None:
        confidence_map = np.zeros(capture.mask.shape, np.float32)
        confidence_map[capture.mask] = confidence
    if capture.ground_truth is None:
        return NormalEstimate(capture, normal_map, seconds, confidence_map=confidence_map)
    error_map = angular_error_map_deg(normal_map, capture.ground_truth, capture.mask)
    return NormalEstimate(
        capture, normal_map, seconds, error_map, summarise_errors(error_map), confidence_map
    )


def _check_unit(normals: NDArray[np.float32], method: str) -> None:
    # A zero normal would score 0 degrees, and NaN would drop out of a mean.
    for start in range(0, len(normals), TILE_PIXELS):
        length = np.linalg.norm(normals[start : start + TILE_PIXELS], axis=1)
        if not (np.abs(length - 1) <= _UNIT_TOLERANCE).all():
            raise SplinecliError(f"method {method} gave normals that are not unit vectors")
