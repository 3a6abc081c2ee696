"""Bilateral normal integration: heights from normals, with discontinuities at the edges of objects.

Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022. `bilateral_equations` has the
equations, `laplacian` the linear solver. Frame: x right, y up, z to the camera (docs/files-and-frames.md).
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths.normals import unit
from splinecli.surface.bilateral_equations import BilateralEquations
from splinecli.surface.blocks import Blocks
from splinecli.surface.camera import focal_length
from splinecli.surface.laplacian import LaplacianSolver

Floats = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-2  # accepts normals from float16 and 8-bit images, and refuses zero vectors
_EXACT = 1e-6  # rms residual in pixels; below it there is nothing to improve
_FIRST_PRECISION = 1e-9
_LATER_PRECISION = 0.03
_STILL = 50  # times the tolerance, in pixels: the rms movement of large maps at which they are finished
_COARSE_FROM = 100_000  # pixels; smaller maps are fast at their own scale


def integrate_normals(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    camera_matrix: NDArray[np.floating] | None = None,
    *,
    stiffness: float = 2.0,
    max_iterations: int = 150,
    tolerance: float = 1e-4,
    progress: Callable[[int, int], None] | None = None,
) -> Floats:
    """Integrate a normal map (H, W, 3) to a height or depth map (H, W), float64, NaN outside the mask.

    For an orthographic camera, the result is the height towards the camera in pixels. With a camera matrix, it is the
    positive depth along the viewing axis, of unknown scale. Normals do not fix the offset between parts that share no
    side of a pixel: each part has mean height 0, or geometric mean depth 1.

    Args:
        normal_map: unit normals in the mask, row 0 at the top; x right, y up, z to the camera.
        mask: (H, W), True at the pixels to integrate. None takes all finite normals that are not zero.
        camera_matrix: (3, 3) in pixels, [[fx, s, cx], [0, fy, cy], [0, 0, 1]], as in OpenCV: columns count to the
            right, rows count down, and (0, 0) is the centre of the first pixel. None is an orthographic camera.
        stiffness: how easily the surface tears at edges. 0 is least squares, which never tears.
        max_iterations: largest number of linear solves. 1 is least squares.
        tolerance: relative change of the sum of squares at which the iteration stops. Maps of more than 100,000 pixels
            also stop when the surface moves by at most 50 times as many pixels.
        progress: called with the number of iterations done and `max_iterations`.

    Raises:
        UsageError: the shapes or types of the arrays do not fit, or an option is out of range.
        InputError: the mask is empty, a normal in the mask is not a unit vector, or the camera matrix is not valid.
    """
    _check_options(stiffness, max_iterations, tolerance)
    if mask is None:
        mask = _mask_of_normals(normal_map)
    _check_maps(normal_map, mask)
    heights = _integrate(
        normal_map, mask, camera_matrix, stiffness, max_iterations, tolerance, progress or (lambda *_: None)
    )
    return _depth_map(heights, mask, camera_matrix)


def _integrate(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None,
    stiffness: float,
    max_iterations: int,
    tolerance: float,
    progress: Callable[[int, int], None],
    *,
    is_coarse: bool = False,
) -> Floats:
    """Return the heights (P,) of the mask's pixels; see integrate_normals.

    A large map starts from the heights of blocks of 2 x 2 pixels: where the surface tears shows at coarser scales, too.
    Large maps and blocks are finished when the surface hardly moves.
    """
    equations = BilateralEquations.from_normals(normal_map, mask, camera_matrix)
    n_pixels = len(equations.facing)
    heights: Floats = np.zeros(n_pixels)
    cost, movement, still = np.inf, np.inf, 0.0
    # At heights of zero all weights are equal, so the first solve is least squares and needs full precision.
    # Each later solve moves the surface a little further, for which few digits suffice.
    precision = _FIRST_PRECISION
    if is_coarse:
        still = _STILL * tolerance
    if n_pixels > _COARSE_FROM and stiffness > 0 and max_iterations > 1:
        blocks = Blocks.of_step(mask, 2)
        coarse = np.zeros((*blocks.mask.shape, 3))
        coarse[blocks.mask] = unit(blocks.average(normal_map[mask].astype(np.float64), mask))
        camera = blocks.shrink_camera(camera_matrix)
        of_blocks = np.zeros(blocks.mask.shape)
        of_blocks[blocks.mask] = _integrate(
            coarse, blocks.mask, camera, stiffness, max_iterations, tolerance, lambda *_: None, is_coarse=True
        )
        heights = blocks.step * np.asarray(blocks.interpolate(of_blocks, mask), np.float64)
        precision, still = _LATER_PRECISION, _STILL * tolerance
    solver = LaplacianSolver(equations.pairs, n_pixels)
    for iteration in range(max_iterations):
        weights, flows, new_cost = equations.weigh(heights, stiffness)
        if iteration > 1 and abs(cost - new_cost) <= tolerance * new_cost + _EXACT**2 * n_pixels:
            break
        if movement < still:
            break
        cost = new_cost
        change = solver.solve(weights, flows, precision=precision)
        heights += change
        movement = float(np.std(change))
        precision = _LATER_PRECISION
        progress(iteration + 1, max_iterations)
    return heights


def _mask_of_normals(normal_map: NDArray[np.floating]) -> NDArray[np.bool_]:
    if normal_map.ndim != 3 or normal_map.shape[2] != 3:
        raise UsageError(f"the normal map has shape {normal_map.shape}, expected (H, W, 3)")
    mask: NDArray[np.bool_] = np.isfinite(normal_map).all(axis=2) & normal_map.any(axis=2)
    if not mask.any():
        raise InputError("the normal map has no normal: all vectors are zero or not finite")
    return mask


def _depth_map(
    heights: Floats, mask: NDArray[np.bool_], camera_matrix: NDArray[np.floating] | None
) -> Floats:
    from scipy.ndimage import label

    parts = label(mask)[0][mask] - 1  # label joins pixels that share a side, as the equations do
    heights = heights - (np.bincount(parts, heights) / np.bincount(parts))[parts]
    depth = np.full(mask.shape, np.nan)
    depth[mask] = heights if camera_matrix is None else np.exp(-heights / focal_length(camera_matrix))
    return depth


def _check_options(stiffness: float, max_iterations: int, tolerance: float) -> None:
    if not (isfinite(stiffness) and stiffness >= 0):
        raise UsageError(f"the stiffness is {stiffness:g}, expected a number of at least 0")
    if max_iterations < 1:
        raise UsageError(f"max_iterations is {max_iterations}, expected at least 1")
    if not (isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"the tolerance is {tolerance:g}, expected a number of at least 0")


def _check_maps(normal_map: NDArray[np.floating], mask: NDArray[np.bool_]) -> None:
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(f"the mask is {mask.dtype} {mask.shape}, expected bool (H, W)")
    if normal_map.shape != (*mask.shape, 3):
        raise UsageError(
            f"the normal map has shape {normal_map.shape}, expected {(*mask.shape, 3)} for this mask"
        )
    if not mask.any():
        raise InputError("the mask is empty", hint="Mark the pixels of the object in it")
    wrong = mask.copy()
    length = np.linalg.norm(normal_map[mask].astype(np.float64), axis=1)
    wrong[mask] = ~(np.abs(length - 1) <= _UNIT_TOLERANCE)  # also True for NaN
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise InputError(
            f"{np.count_nonzero(wrong)} of {length.size} normals in the mask are not unit vectors, the first in row "
            f"{row}, column {column}",
            hint="Leave pixels without a normal out of the mask",
        )
