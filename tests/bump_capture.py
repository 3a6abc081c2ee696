"""A small matte capture under near or distant lamps, whose images follow Lambert's and the inverse-square law."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

SIZE, WIDTH_MM = 32, 64.0
POSITIONS = np.array(
    [(0, 20, 200), (70, 10, 170), (-80, 20, 160), (20, 90, 150), (-10, -80, 170), (60, 60, 140), (-60, -70, 150)]
) * 1.0  # fmt: skip
"""Lamps in millimetres, at about three widths of the object."""


def write_bump(folder: Path, positions: np.ndarray = POSITIONS, *, distant: bool = False) -> Path:
    """A matte bump, 64 mm wide, without a mask, under equally strong lamps."""
    folder.mkdir(parents=True)
    place = ((np.arange(SIZE) + 0.5) / SIZE - 0.5) * WIDTH_MM
    x, y = np.meshgrid(place, -place)
    heights = 8 * np.cos(x / 20) * np.cos(y / 25)
    normals = np.dstack(
        (8 / 20 * np.sin(x / 20) * np.cos(y / 25), 8 / 25 * np.cos(x / 20) * np.sin(y / 25), 1 + 0 * x)
    )
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    points = np.dstack((x, y, heights - heights.mean()))
    for number, lamp in enumerate(positions, start=1):
        towards = lamp - (0 if distant else 1) * points
        distance = np.linalg.norm(towards, axis=2)
        shading = np.clip((towards * normals).sum(axis=2) / distance, 0, None)
        picture = shading * (1 if distant else 150.0**2 / distance**2)
        cv2.imwrite(str(folder / f"{number}.png"), np.rint(picture * 30_000).astype(np.uint16))
    np.save(folder / "normals_gt.npy", normals.astype(np.float32))
    return folder
