"""Bilateral normal integration: heights from normals, with discontinuities at the edges of objects.

Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022, with two changes: the surface tears only
where it contradicts the normals, and large maps are integrated from coarse to fine. `bilateral_equations` has the
equations, `laplacian` the linear solver. Frame: x right, y up, z to the camera (docs/files-and-frames.md).
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.maths.normals import unit
from splinecli.surface.bilateral_equations import SMALLEST_COSINE, STIFFNESS, BilateralEquations
from splinecli.surface.blocks import Blocks
from splinecli.surface.camera import focal_length
from splinecli.surface.laplacian import LaplacianSolver

Floats = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-2  # accepts normals from float16 and 8-bit images, and refuses zero vectors
_FIRST_PRECISION, _LATER_PRECISION = 1e-9, 0.03  # relative residuals of the linear solves
_STILL = 0.002  # pixels: the rms movement at which the surface is finished
_COARSEST = 8_000  # pixels; larger maps start from blocks of 2 x 2 pixels
_FINEST = 8_000_000  # pixels; larger maps have the heights of their blocks, interpolated
_SOLVES_OF_COARSEST = 150
_MOST_SOLVES, _FEWEST_SOLVES = 20, 4  # the most at finer scales, of small maps and of large ones
_SOLVED_PIXELS = 1_000_000  # in all solves at a scale together, but for the fewest
_MIXED_DEG = 20.0  # between a block's mean normal and one of its normals: the block contains an edge

Progress = Callable[[float], object]
"""Called with the share of the work that was just done."""


def integrate_normals(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    camera_matrix: NDArray[np.floating] | None = None,
    *,
    stiffness: float = STIFFNESS,
    progress: Progress = lambda share: None,
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
        progress: see Progress. The shares may add up to less than 1.

    Raises:
        UsageError: the shapes or types of the arrays do not fit, or an option is out of range.
        InputError: the mask is empty, a normal in the mask is not a unit vector, or the camera matrix is not valid.
    """
    if not (isfinite(stiffness) and stiffness >= 0):
        raise UsageError(f"the stiffness is {stiffness:g}, expected a number of at least 0")
    if mask is None:
        mask = _mask_of_normals(normal_map)
    _check_maps(normal_map, mask)
    return _depth_map(_integrate(normal_map, mask, camera_matrix, stiffness, progress), mask, camera_matrix)


def _integrate(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_],
    camera_matrix: NDArray[np.floating] | None,
    stiffness: float,
    progress: Progress,
) -> Floats:
    """Return the heights (P,) of the mask's pixels; see integrate_normals.

    A large map starts from the heights of blocks of 2 x 2 pixels: where the surface tears, and by how much, is found
    at the coarsest scale, where many solves take little time. Finer scales follow the edges.
    """
    equations = BilateralEquations.from_normals(normal_map, mask, camera_matrix)
    n_pixels = len(equations.facing)
    heights: Floats = np.zeros(n_pixels)
    # At heights of zero all weights are equal, so the first solve is least squares and needs full precision.
    # Each later solve moves the surface a little further, for which few digits suffice.
    precision, most, own_share = _FIRST_PRECISION, _SOLVES_OF_COARSEST if stiffness > 0 else 1, 1.0
    is_huge = n_pixels > _FINEST
    if is_huge or (n_pixels > _COARSEST and stiffness > 0):
        blocks = Blocks.of_step(mask, 2)
        coarse = np.zeros((*blocks.mask.shape, 3))
        coarse[blocks.mask] = _normals_of(blocks, normal_map[mask].astype(np.float64), mask, keep_edges=not is_huge)
        of_blocks, own_share = np.zeros(blocks.mask.shape), 0.75
        of_blocks[blocks.mask] = _integrate(
            coarse,
            blocks.mask,
            blocks.shrink_camera(camera_matrix),
            stiffness,
            lambda share: progress((1 - own_share) * share),
        )
        heights = blocks.step * np.asarray(blocks.interpolate(of_blocks, mask), np.float64)
        if is_huge:
            return heights
        precision, most = _LATER_PRECISION, min(_MOST_SOLVES, max(_FEWEST_SOLVES, _SOLVED_PIXELS // n_pixels))
    solver = LaplacianSolver(equations.pairs, n_pixels)
    for _ in range(most):
        weights, flows = equations.weigh(heights, stiffness)
        change = solver.solve(weights, flows, precision=precision)
        heights += change
        progress(own_share / most)
        if precision == _LATER_PRECISION and np.std(change) < _STILL:
            break
        precision = _LATER_PRECISION
    return heights


def _normals_of(blocks: Blocks, normals: Floats, mask: NDArray[np.bool_], *, keep_edges: bool) -> Floats:
    """Return the normals (p, 3) of blocks from those of their pixels (P, 3): of the mean slope, or of the steepest one.

    With keep_edges, a block that contains an edge has the steepest normal, which belongs to the rim. The mean over an
    edge would be a slope that joins what it separates.
    """
    slopes = normals / np.maximum(normals[:, 2:], SMALLEST_COSINE)
    mean = unit(blocks.average(slopes, mask))
    if not keep_edges:
        return mean
    block = blocks.numbers_at(*np.nonzero(mask))
    closest = np.ones(len(mean))
    np.minimum.at(closest, block, np.einsum("pi,pi->p", normals, mean[block]))
    by_steepness = np.lexsort((normals[:, 2], block))
    first = np.searchsorted(block[by_steepness], np.arange(len(mean)))
    steepest = normals[by_steepness[first]]
    mixed = (closest < np.cos(np.radians(_MIXED_DEG))) & (steepest[:, 2] > SMALLEST_COSINE)
    return np.asarray(np.where(mixed[:, None], steepest, mean))


def _mask_of_normals(normal_map: NDArray[np.floating]) -> NDArray[np.bool_]:
    if normal_map.ndim != 3 or normal_map.shape[2] != 3:
        raise UsageError(f"the normal map has shape {normal_map.shape}, expected (H, W, 3)")
    mask: NDArray[np.bool_] = np.isfinite(normal_map).all(axis=2) & normal_map.any(axis=2)
    if not mask.any():
        raise InputError("the normal map has no normal: all vectors are zero or not finite")
    return mask


def _depth_map(heights: Floats, mask: NDArray[np.bool_], camera_matrix: NDArray[np.floating] | None) -> Floats:
    from scipy.ndimage import label

    parts = label(mask)[0][mask] - 1  # label joins pixels that share a side, as the equations do
    heights = heights - (np.bincount(parts, heights) / np.bincount(parts))[parts]
    depth = np.full(mask.shape, np.nan)
    depth[mask] = heights if camera_matrix is None else np.exp(-heights / focal_length(camera_matrix))
    return depth


def _check_maps(normal_map: NDArray[np.floating], mask: NDArray[np.bool_]) -> None:
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(f"the mask is {mask.dtype} {mask.shape}, expected bool (H, W)")
    if normal_map.shape != (*mask.shape, 3):
        raise UsageError(f"the normal map has shape {normal_map.shape}, expected {(*mask.shape, 3)} for this mask")
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
