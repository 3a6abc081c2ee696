"""An analytic capture: a convex Lambertian dome, every light seen from everywhere, so that least squares is exact."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from splinecli.normals import unit

SIZE = 12  # pixels a side; the outermost ring is outside the mask


def ring_of_lights(n_lights: int) -> NDArray[np.float64]:
    """Directions 15 to 40 degrees from the view axis."""
    azimuth = np.arange(n_lights) * np.radians(137.5)
    zenith = np.radians(np.linspace(15, 40, n_lights))
    return np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1
    )


def dome_normals() -> NDArray[np.float64]:
    """(SIZE, SIZE, 3) up to 35 degrees from the view axis: less than 90 from every light."""
    y, x = 0.4 * np.mgrid[1 : -1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    return unit(np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=2))


@pytest.fixture
def write_dome(tmp_path: Path) -> Callable[..., Path]:
    """Write a capture folder below tmp_path: 16-bit images, mask, lights, and ground truth by default."""

    def write(
        name: str = "dome", *, n_lights: int = 8, ground_truth: bool = True, without_truth: int = 0
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir(parents=True)
        lights, normals = ring_of_lights(n_lights), dome_normals()
        for number, light in enumerate(lights):
            photograph = np.rint(0.9 * 65535 * (normals @ light)).astype(np.uint16)
            assert cv2.imwrite(str(folder / f"{number:03}.png"), photograph)
        mask = np.zeros((SIZE, SIZE), np.uint8)
        mask[1:-1, 1:-1] = 255
        assert cv2.imwrite(str(folder / "mask.png"), mask)
        np.savetxt(folder / "light_directions.txt", lights)
        if ground_truth:
            normals[1, 1 : 1 + without_truth] = 0
            np.save(folder / "normal_gt.npy", normals)
        return folder

    return write
