"""Slopes and curvatures of analytic surfaces."""

import numpy as np
import pytest

from scenes import square_grid
from splinecli.maths.normals import curvature_of_normals, gradient_of_normals, unit

SIZE, REACH = 120, 60.0
X, Y = square_grid(SIZE, REACH * (1 - 1 / SIZE))
RADIUS = 75.0


def normals(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return unit(np.stack((-p, -q, np.ones_like(p)), axis=-1)).astype(np.float32)


def sphere(sign: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals of a ball (1) or of a bowl (-1), and a ragged mask."""
    inside = np.hypot(X, Y) < 55
    inside[50:60, 40:44] = False
    z = np.sqrt(RADIUS**2 - X**2 - Y**2, where=inside, out=np.ones_like(X))
    return normals(-sign * X / z, -sign * Y / z), inside


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sphere(sign: int) -> None:
    normal_map, mask = sphere(sign)
    found = curvature_of_normals(normal_map, mask)
    expected = np.tile((sign / RADIUS, 1 / RADIUS**2), (len(found[mask]), 1))
    np.testing.assert_allclose(found[mask], expected, rtol=0.02)
    assert np.isnan(found[~mask]).all()
    slopes = gradient_of_normals(normal_map, mask)
    np.testing.assert_allclose(slopes[mask], -normal_map[mask][:, :2] / normal_map[mask][:, 2:], rtol=1e-5)


def test_a_cylinder_and_a_saddle() -> None:
    everywhere = np.ones(X.shape, bool)
    inner = np.hypot(X, Y) < 40
    cylinder = curvature_of_normals(normals(-X / np.sqrt(RADIUS**2 - X**2), 0 * X), everywhere)[inner]
    np.testing.assert_allclose(cylinder[:, 0], 0.5 / RADIUS, rtol=0.02)
    np.testing.assert_allclose(cylinder[:, 1], 0, atol=1e-6)
    # z = x y / R, whose curvature at the middle is -1/R^2 (Gauss) and 0 (mean).
    saddle = curvature_of_normals(normals(Y / 300, X / 300), everywhere)[SIZE // 2, SIZE // 2]
    assert saddle[1] == pytest.approx(-1 / 300**2, rel=0.02) and abs(saddle[0]) < 1e-6


def test_noise_falls_with_the_square_of_sigma() -> None:
    noisy = unit(normals(0 * X, 0 * X) + 0.02 * np.random.default_rng(1).normal(size=(*X.shape, 3))).astype(np.float32)
    inner = np.hypot(X, Y) < 40
    spread = [curvature_of_normals(noisy, np.ones(X.shape, bool), sigma)[inner][:, 0].std() for sigma in (1.5, 3)]
    assert spread[0] / spread[1] == pytest.approx(4, rel=0.3)


def test_a_steep_normal_has_no_slope() -> None:
    steep = np.tile(np.float32((0.9995, 0, 0.03)), (3, 3, 1))
    assert np.isnan(gradient_of_normals(steep, np.ones((3, 3), bool))).all()
