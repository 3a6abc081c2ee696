"""Photographs of made-up mirror balls: the oracle is the law of reflection, followed from the
camera to the lamp.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import spiral_lights
from splinecli.maths.normals import unit

Render = Callable[..., NDArray[np.float32]]


@pytest.fixture
def render_ball():
    """A mirror ball (H, W) before a gray wall, 3 x 3 samples a pixel: a lamp of 2 degrees, a dim
    room around it.

    The lamp is in a direction, or at a position in pixels from the middle of the image.
    """

    def render(
        light,
        x=103.3,
        y=88.7,
        radius=61.4,
        shape=(180, 210),
        lamp=30.0,
        *,
        near=False,
    ):
        height, width = shape
        offsets = (np.arange(3) - 1) / 3
        rows = (np.arange(height)[:, None] + offsets).ravel()
        cols = (np.arange(width)[:, None] + offsets).ravel()
        nx, ny = np.meshgrid((cols - x) / radius, (y - rows) / radius)
        inside = nx**2 + ny**2 < 1
        nz = np.sqrt(np.where(inside, 1 - nx**2 - ny**2, 0))
        # The ray from the camera, (0, 0, -1), mirrored.
        mirrored = np.stack((2 * nz * nx, 2 * nz * ny, 2 * nz**2 - 1), axis=-1)
        room = 0.02 + 0.01 * mirrored[..., 1]
        towards = light
        if near:
            centre = np.array((x - (width - 1) / 2, (height - 1) / 2 - y, 0))
            towards = unit(light - centre - radius * np.stack((nx, ny, nz), axis=-1))
        values = np.where((mirrored * towards).sum(axis=-1) > np.cos(np.radians(2)), lamp, room)
        values = np.where(inside, values, 0.15)
        return np.asarray(values.reshape(height, 3, width, 3).mean(axis=(1, 3)), np.float32)

    return render


@pytest.fixture
def lights():
    """Seven lights (7, 3), 0 to 60 degrees from the view."""
    return spiral_lights(7, 60, 0)
