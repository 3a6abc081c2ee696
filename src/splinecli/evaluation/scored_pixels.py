"""The pixels that an evaluation scores: those with ground truth, or a random part of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.capture.lights.draws import PIXELS_STREAM
from splinecli.errors import InputError


def scored_rows(capture: Capture, *, max_pixels: int | None = None, seed: int = 0) -> NDArray[np.intp]:
    """Return the rows of the observations that have ground truth, in rising order.

    With `max_pixels`, the seed chooses at most that many of them: the same pixels for every method and trial. A method
    that sees neighbours estimates all pixels, and only these are scored.

    Raises:
        InputError: the capture has no ground truth.
    """
    if capture.ground_truth is None:
        raise InputError(f"{capture.name}: the capture has no ground truth")
    rows = np.flatnonzero(np.any(capture.ground_truth[capture.mask], axis=1))
    if max_pixels is not None and len(rows) > max_pixels:
        generator = np.random.default_rng([PIXELS_STREAM, seed, len(rows)])
        rows = np.sort(generator.permutation(rows)[:max_pixels])
    return rows
