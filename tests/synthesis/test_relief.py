"""Relief on a surface, against a field of waves whose slopes are known."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from splinecli.errors import InputError
from splinecli.synthesis.shapes import Relief, draw_detail, read_relief

SIDE = 64
ALONG, DOWN = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE, (np.arange(SIDE) + 0.5) / SIDE)
HEIGHT_SLOPES = np.stack(
    (0.6 * np.cos(2 * np.pi * (ALONG + DOWN)), 0.6 * np.cos(2 * np.pi * (ALONG + DOWN))), axis=2
).astype(np.float32)
"""The slopes of the height 0.3 / pi sin(2 pi (u + v)) along columns and rows."""


@pytest.mark.parametrize("green_up", [True, False])
def test_slopes_are_found_whichever_way_green_points(tmp_path: Path, green_up: bool) -> None:
    normals = np.dstack((-HEIGHT_SLOPES, np.ones((SIDE, SIDE))))
    normals[..., 1] *= -1 if green_up else 1
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    path = tmp_path / "waves.png"
    cv2.imwrite(str(path), np.rint((normals + 1) / 2 * 65535).astype(np.uint16)[..., ::-1])
    np.testing.assert_allclose(read_relief(path), HEIGHT_SLOPES, atol=1e-3)


def test_a_gray_image_is_no_relief(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "gray.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match="found a gray image, expected a normal map"):
        read_relief(tmp_path / "gray.png")


def test_a_plate_gets_the_normals_of_the_height() -> None:
    relief = Relief(HEIGHT_SLOPES, np.eye(3, dtype=np.float32), period=0.5)
    places = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)
    places[:, 2] = 0
    up = np.tile(np.float32((0, 0, 1)), (500, 1))
    slope = 0.6 * np.cos(2 * np.pi * (places[:, 0] + places[:, 1]) / 0.5)
    expected = np.stack((-slope, -slope, np.ones(500)), axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((relief.bend(up, places) * expected).sum(axis=1), -1, 1)))
    assert off.max() < 4.5  # half a texel of 64 along both axes


def test_no_normal_turns_away_from_the_camera() -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(4000, 3)).astype(np.float32)
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    relief = draw_detail(6 * HEIGHT_SLOPES, 128, np.random.default_rng(3))
    bent = relief.bend(normals, rng.uniform(-1, 1, (4000, 3)).astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1, atol=1e-5)
    assert (bent[:, 2] >= np.minimum(normals[:, 2], 0.1) - 1e-3).all()
    assert np.degrees(np.arccos(np.clip((bent * normals).sum(axis=1), -1, 1))).mean() > 3
