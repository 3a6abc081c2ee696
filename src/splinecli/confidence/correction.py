"""Correct what a network expects of its errors by what the capture as a whole says."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture import Capture
from splinecli.confidence.features import capture_features
from splinecli.light.indirect_light import PixelPlaces
from splinecli.light.lamp_light import LightOf, Rows, parts_of_rows
from splinecli.methods.estimator import Estimator
from splinecli.system.side_by_side import side_by_side

Floats = NDArray[np.float32]


def correct_errors(capture: Capture, estimator: Estimator, light_of: LightOf, normals: Floats, errors: Floats) -> bool:
    """Correct the distributions of errors (P, 2) in place; return whether that was possible.

    It is not where the capture is too small, or where the correction was not made for the estimator's weights. A pixel
    that is dark under every light stays as it is.

    Args:
        light_of: gives the observations and the light directions of some pixels.
        normals, errors: (P, 3) and (P, 2), the estimate. See networks/error_head.py.
    """
    import torch

    from splinecli.networks.weights import capture_head

    head = None if estimator.weights is None else capture_head(estimator.weights["sha256"])
    if head is None:
        return False
    found = capture_features(capture.mask, light_of, normals, errors, capture.light_directions)
    if found is None:
        return False
    features, scale = found
    whole = torch.tensor(astuple(features), dtype=torch.float32)
    places = PixelPlaces(capture.mask)

    def correct(rows: Rows) -> None:
        brightness = capture.observations[rows].mean(axis=1)
        rows, brightness = rows[brightness > 0], brightness[brightness > 0]
        pixels = scale.features(brightness, normals[rows], *places.places(rows))
        own = torch.from_numpy(errors[rows])
        errors[rows] = head(own, torch.from_numpy(pixels.astype(np.float32)), whole).numpy()

    for _ in side_by_side(correct, parts_of_rows(len(normals))):
        pass
    return True


def add_light_error(errors: Floats, light_errors_deg: NDArray[np.float64]) -> None:
    """Widen distributions of errors (P, 2) in place by the expected errors (F,) of lights that were estimated.

    Such lights are wrong together: the normals turn with them, by about as much. The medians of both errors add up as
    those of independent errors do.
    """
    turn = np.radians(light_errors_deg.mean())
    errors[:, 0] = np.logaddexp(2 * errors[:, 0], 2 * np.log(turn)) / 2
