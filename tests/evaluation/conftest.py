"""An analytic capture: a convex Lambertian dome, every light seen from everywhere, so that least
squares is exact.
"""

import numpy as np
import pytest

from scenes import on_sphere, shade, spiral_lights, write_capture
from splinecli.evaluation.protocol import Evaluation, Protocol, Result

SIZE = 12  # pixels a side; the outermost ring is outside the mask


def dome_normals():
    """(SIZE, SIZE, 3) up to 35 degrees from the view axis: less than 90 from every light."""
    y, x = 0.4 * np.mgrid[1 : -1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    return on_sphere(x, y)


def evaluation_of(maes_deg, n_lights=10, *, seconds=1.0, skipped=(), **protocol):
    """An evaluation from {capture: {method: (MAE of each trial, ...)}}."""
    results = tuple(
        Result(method, capture, n_lights or 96, tuple(maes), seconds)
        for capture, methods in maes_deg.items()
        for method, maes in methods.items()
    )
    return Evaluation(Protocol(n_lights, len(results[0].maes_deg), **protocol), results, skipped)


@pytest.fixture
def write_dome(tmp_path):
    """Write a capture folder below tmp_path: 16-bit images, mask, lights, and ground truth by
    default.
    """

    def write(name="dome", *, n_lights=8, ground_truth=True, without_truth=0):
        lights, normals = spiral_lights(n_lights, 40, 15), dome_normals()
        photographs = np.uint16(np.rint(0.9 * 65535 * np.moveaxis(shade(normals, lights), 2, 0)))
        mask = np.pad(np.ones((SIZE - 2, SIZE - 2), bool), 1)
        normals[1, 1 : 1 + without_truth] = 0
        truth = normals if ground_truth else None
        return write_capture(tmp_path / name, photographs, lights, mask=mask, normals=truth)

    return write
