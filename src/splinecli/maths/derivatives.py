"""Slopes and curvatures of a surface, from its normals alone: no integration, so no drift and no tears.

For a surface z(x, y) with unit normals n = (-p, -q, 1) / sqrt(1 + p^2 + q^2), let J be the matrix of the derivatives of
(nx, ny) by x and y. Its determinant is the Gaussian curvature, because normals turn by as much as the surface does
(Gauss), and half its trace is the mean curvature (do Carmo, Differential Geometry of Curves and Surfaces, 1976, 3-3).
"""

import numpy as np
from numpy.typing import NDArray

SMALLEST_Z = 0.05
"""Normals beyond 87 degrees from the camera axis have no usable slope."""

CURVATURE_SIGMA = 2.0
"""Standard deviation in pixels of the Gaussian filter of the normals before they are derived."""


def gradient_of_normals(normal_map: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the slopes p = dz/dx and q = dz/dy, (H, W, 2); NaN outside the mask and where the surface is too steep.

    Args:
        normal_map: (H, W, 3), unit in the mask; x right, y up, z to the camera.
        mask: (H, W).
    """
    z = np.where(mask & (normal_map[..., 2] >= SMALLEST_Z), normal_map[..., 2], np.nan)
    return np.asarray(-normal_map[..., :2] / z[..., None], np.float32)


def curvature_of_normals(
    normal_map: NDArray[np.float32], mask: NDArray[np.bool_], sigma: float = CURVATURE_SIGMA
) -> NDArray[np.float32]:
    """Return mean and Gaussian curvature (H, W, 2), in 1/pixel and 1/pixel^2; NaN outside the mask.

    Both are positive on a bump: a sphere of radius R has 1/R and 1/R^2. A hollow has a negative mean curvature.

    Args:
        normal_map, mask: see gradient_of_normals.
        sigma: standard deviation of a Gaussian filter of the normals, in pixels. Noise falls with its square.
    """
    (xx, xy), (yx, yy) = (_derivatives(normal_map[..., component], mask, sigma) for component in (0, 1))
    curvatures = np.stack(((xx + yy) / 2, xx * yy - xy * yx), axis=-1)
    return np.where(mask[..., None], curvatures, np.nan).astype(np.float32)


def _derivatives(
    values: NDArray[np.float32], mask: NDArray[np.bool_], sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives (H, W) of values by x (right) and y (up).

    They are the slopes of a plane that is fitted to the values of the mask with Gaussian weights. Moments of a Gaussian
    are its derivatives. Inside, the slopes are the derivatives of the filtered values; at the mask's edge, those would
    be too small.
    """
    from scipy.ndimage import gaussian_filter

    def moment(of: NDArray[np.float64], down: int, right: int) -> NDArray[np.float64]:
        """Return the sum of the weighted `of`, times offsets to these powers."""
        found = sigma ** (2 * (down + right)) * gaussian_filter(of, sigma, order=(down, right), mode="constant")
        return np.asarray(found + (sigma**2 * moment(of, 0, 0) if 2 in (down, right) else 0))

    inside = mask.astype(np.float64)
    inner = np.where(mask, values, 0).astype(np.float64)
    weight = np.maximum(moment(inside, 0, 0), 1e-9)
    right, down, value = (moment(*m) / weight for m in ((inside, 0, 1), (inside, 1, 0), (inner, 0, 0)))
    least = 1e-3 * sigma**2  # where the mask is a line
    rr = moment(inside, 0, 2) / weight - right**2 + least
    dd = moment(inside, 2, 0) / weight - down**2 + least
    rd = moment(inside, 1, 1) / weight - right * down
    of_right = moment(inner, 0, 1) / weight - value * right
    of_down = moment(inner, 1, 0) / weight - value * down
    determinant = np.maximum(rr * dd - rd**2, least**2)
    return (dd * of_right - rd * of_down) / determinant, -(rr * of_down - rd * of_right) / determinant
