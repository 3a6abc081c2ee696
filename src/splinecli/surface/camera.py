"""The pinhole camera of integration and meshes: viewing rays and the focal length from a camera matrix.

A camera matrix is [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels. Columns count to the right, rows count down, and
(0, 0) is the centre of the first pixel, as in OpenCV. Rays are in the frame of docs/files-and-frames.md: x right, y up,
z to the camera.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths.arrays import Bools, Doubles, Floats

Places = NDArray[np.number[Any]]

_LARGEST = 1e6  # Largest number in a camera matrix. Beyond it, equations of integration overflow or are singular.


def pixel_rays(mask: Bools, camera_matrix: Floats) -> Doubles:
    """Return the points (P, 3) at depth 1, z = -1, that a camera at the origin sees in the pixels of a mask (H, W).

    Raises UsageError if the camera matrix is not 3 x 3, or InputError if the numbers are not those of a camera matrix.
    """
    rows, columns = np.nonzero(mask)
    return rays_at(rows, columns, camera_matrix)


def rays_at(rows: Places, columns: Places, camera_matrix: Floats) -> Doubles:
    """Return the points (N, 3) of pixel_rays at rows and columns (N,) of the image. Raises the same errors."""
    image = np.stack((columns, rows, np.ones(len(rows))), axis=1).astype(np.float64)
    return image @ ray_basis(camera_matrix)


def image_points(points: Floats, shape: tuple[int, ...], camera_matrix: Floats | None) -> Doubles:
    """Return the columns and rows (P, 2) at which a camera sees points (P, 3); without a matrix it is orthographic.

    The points are from the camera, or without a matrix in pixels from the centre of the image of `shape` (H, W).
    """
    if camera_matrix is None:
        return np.asarray(points[:, :2] * (1, -1) + ((shape[1] - 1) / 2, (shape[0] - 1) / 2), np.float64)
    image = points.astype(np.float64) * (1, -1, -1) @ np.asarray(camera_matrix, np.float64).T
    return np.asarray(image[:, :2] / image[:, 2:])


def focal_length(camera_matrix: Floats) -> float:
    """Return the focal length in pixels: the geometric mean of both axes."""
    return float(np.sqrt(np.linalg.det(np.asarray(camera_matrix, np.float64)[:2, :2])))


def ray_basis(camera_matrix: Floats) -> Doubles:
    """Return the rows (3, 3) that turn an image point (column, row, 1) into its ray.

    The first row is the step of a ray from one column to the next, the second the step from one row to the next, and
    the third the ray of the image's origin. Raises the errors of pixel_rays.
    """
    matrix = np.asarray(camera_matrix, np.float64)
    if matrix.shape != (3, 3):
        raise UsageError(f"the camera matrix has shape {matrix.shape}, expected (3, 3)")
    if not (
        (np.abs(matrix) <= _LARGEST).all()  # False for NaN
        and min(matrix[0, 0], matrix[1, 1], np.linalg.det(matrix[:2, :2])) > 1 / _LARGEST
        and (matrix[2] == (0, 0, 1)).all()
    ):
        raise InputError(
            f"{matrix.tolist()} is not a camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
            " with positive fx and fy, and numbers of at most a million",
            hint="Give it in pixels, with columns to the right and rows down",
        )
    return np.asarray(np.linalg.inv(matrix).T * (1, -1, -1), np.float64)
