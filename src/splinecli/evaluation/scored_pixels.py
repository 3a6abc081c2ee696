"""The pixels an evaluation looks at: those with ground truth, or a random part of them."""

from __future__ import annotations

import numpy as np

from splinecli.capture import Capture
from splinecli.capture.lights.draws import PIXELS_STREAM
from splinecli.errors import InputError


def keep_scored_pixels(capture: Capture, *, max_pixels: int | None = None, seed: int = 0) -> Capture:
    """The capture without its pixels that have no ground truth.

    With `max_pixels`, at most so many of the others, drawn by the seed: the same ones for every method and
    trial. Estimators work pixel by pixel, so the normals of those that stay are what they were.

    Raises:
        InputError: there is no ground truth at all.
    """
    if capture.ground_truth is None:
        raise InputError(f"{capture.name}: no ground truth, so nothing to score against")
    scored = np.any(capture.ground_truth[capture.mask], axis=1)
    chosen = np.flatnonzero(scored)
    if max_pixels is not None and len(chosen) > max_pixels:
        generator = np.random.default_rng([PIXELS_STREAM, seed, len(chosen)])
        chosen = np.sort(generator.permutation(chosen)[:max_pixels])
    if len(chosen) == capture.n_pixels:
        return capture
    return capture.choose_pixels(chosen)
