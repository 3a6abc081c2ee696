"""Bilateral normal integration: heights from normals, with discontinuities at the edges of objects.

Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022. Large maps are
integrated from coarse to fine. A coarse surface from another source may determine the shape at long
wavelengths (Nehab, Rusinkiewicz, Davis and Ramamoorthi, Efficiently combining positions and normals
for precise 3D geometry, SIGGRAPH 2005). `bilateral_equations` contains the equations and the linear
solver. Frame: x right, y up, z to the camera (docs/files-and-frames.md).
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from splinecli.errors import InputError, UsageError
from splinecli.maths import Bools, Float32Array, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import Blocks, focal_length, on_map
from splinecli.surface.bilateral_equations import (
    DISCONTINUITY,
    SMALLEST_COSINE,
    BilateralEquations,
    LaplacianSolver,
)
from splinecli.system.progress import Progress, ignore

STILL = 0.01  # rms movement in pixels below which the surface is finished
# Tolerance for the forces on the heights, relative to a flat surface, as in the paper's code. The
# forces on a part that is torn off all around are not larger.
LEAST_FORCE = 1e-3
COARSEST = 64_000  # pixels; larger maps start from blocks of 2 x 2 pixels
SOLVES_OF_COARSEST = 150
# largest value of a prior in pixels or millimetres, above which float32 only represents integers
_LARGEST_VALUE = 1e7
RELIEF_WIDTH = 64.0  # pixels: the wavelength at which the high-pass filter halves the amplitude


def integrate_normals(
    normal_map: Floats,
    mask: Bools | None = None,
    camera_matrix: Floats | None = None,
    *,
    discontinuity: float = DISCONTINUITY,
    prior: Floats | None = None,
    prior_detail: float | None = None,
    progress: Progress = ignore,
) -> Float64Array:
    """Integrate a normal map (H, W, 3) into a height or depth map (H, W) float64, NaN outside the
    mask.

    For an orthographic camera, the result is the height towards the camera in pixels. With a camera
    matrix, it is the positive depth along the viewing axis, of unknown scale. Normals do not
    determine the offset between parts of the mask whose pixels share no side, so each part has mean
    height 0 or geometric mean depth 1.

    Args:
        normal_map: unit normals in the mask, row 0 at the top; x right, y up, z to the camera.
        mask: (H, W), True at the pixels to integrate. None uses all finite, non-zero normals.
        camera_matrix: (3, 3) in pixels, [[fx, s, cx], [0, fy, cy], [0, 0, 1]], as in OpenCV:
            columns count to the right, rows count down, and (0, 0) is the centre of the first
            pixel. None assumes an orthographic camera.
        discontinuity: sensitivity to discontinuities. 0 is least squares, which gives a continuous
            surface.
        prior: (H, W), a coarse surface from another source, such as a scanner: heights or depths
            like the result, NaN where they are unknown. The result has its large-scale shape, its
            offset and, for depths, its scale.
        prior_detail: the wavelength in pixels at which prior and normals have equal weight. At
            longer wavelengths, the prior dominates. None means 15 % of the square root of the
            mask's area.
        progress: is called with shares of the work, which may add up to less than 1.

    Raises:
        UsageError: the shapes or types of the arrays do not match, or an option is out of range.
        InputError: the mask is empty, a normal in the mask is not a unit vector, the camera matrix
            is not valid, or the prior has no value in the mask, or clearly has another direction or
            unit.
    """
    if not 0 <= discontinuity < inf:
        raise UsageError(f"the discontinuity is {discontinuity:g}, expected a number of at least 0")
    if mask is None:
        if normal_map.ndim != 3 or normal_map.shape[2] != 3:
            raise UsageError(f"the normal map has shape {normal_map.shape}, expected (H, W, 3)")
        mask = np.asarray(np.isfinite(normal_map).all(axis=2) & normal_map.any(axis=2))
        if not mask.any():
            raise InputError(
                "the normal map has no normals, because all vectors are zero or not finite"
            )
    _check_maps(normal_map, mask)
    known = None
    if prior is not None:
        known = _heights_of_prior(prior, mask, camera_matrix)
        if prior_detail is None:
            prior_detail = 0.15 * float(np.sqrt(np.count_nonzero(mask)))
        if not 0 < prior_detail < inf:
            problem = f"the detail of the prior is {prior_detail:g} pixels"
            raise UsageError(f"{problem}, expected a positive number")
    surface = _Surface(normal_map, mask, camera_matrix, known, prior_detail or 0.0)
    if known is not None:
        _check_prior(surface)
    heights = _integrate(surface, discontinuity, STILL, progress)
    return _depth_map(heights, mask, camera_matrix, known)


def relief_of_normals(normal_map: Float32Array, mask: Bools) -> Float32Array:
    """Return the relief (H, W) in pixels, positive towards the camera; NaN outside the mask (H, W).

    The relief shows dents, scratches and tool marks without the large-scale shape. It is the
    surface of the normals (H, W, 3), pulled to height zero. At k radians per pixel, the gain of
    this filter is k^2 / (k^2 + (2 pi / RELIEF_WIDTH)^2). The normals are unit in the mask; x right,
    y up, z to the camera. Raises InputError if the mask is empty.
    """
    flat = np.zeros(mask.shape)
    return integrate_normals(
        normal_map, mask, discontinuity=0, prior=flat, prior_detail=RELIEF_WIDTH
    ).astype(np.float32)


class _Surface(NamedTuple):
    """The input of integrate_normals for the pixels of a mask. The prior is given as heights
    (P,).
    """

    normal_map: Floats
    mask: Bools
    camera_matrix: Floats | None
    prior: Float64Array | None
    prior_detail: float

    def of_blocks(self, blocks: Blocks, *, keep_edges: bool) -> _Surface:
        """Return the surface at the scale of blocks; see _normals_of."""
        of_pixels = self.normal_map[self.mask].astype(np.float64)
        normals = _normals_of(blocks, of_pixels, self.mask, keep_edges=keep_edges)
        prior = None
        if self.prior is not None:
            values = np.stack((np.nan_to_num(self.prior), np.isfinite(self.prior)), axis=1)
            sums, known = blocks.average(values, self.mask).T
            prior = np.divide(
                sums, known * blocks.step, out=np.full(len(sums), np.nan), where=known > 0
            )
        camera = blocks.shrink_camera(self.camera_matrix)
        detail = self.prior_detail / blocks.step
        return _Surface(on_map(normals, blocks.mask), blocks.mask, camera, prior, detail)


def _integrate(
    surface: _Surface, discontinuity: float, still: float, progress: Progress
) -> Float64Array:
    """Return the heights (P,) of the mask's pixels, with the method of integrate_normals.

    Iteration stops when their rms movement is below `still` pixels. A large map starts from the
    heights of blocks of 2 x 2 pixels, so that the tears of the surface and their sizes are found at
    the coarsest scale, where many solves take little time. Finer scales follow the edges.
    """
    normal_map, mask, camera_matrix, prior, prior_detail = surface
    equations = BilateralEquations.from_normals(normal_map, mask, camera_matrix)
    n_pixels = len(equations.facing)
    heights = np.zeros(n_pixels)
    most, own_share = SOLVES_OF_COARSEST if discontinuity > 0 else 1, 1.0
    is_huge = n_pixels > 8_000_000  # the heights of blocks are only interpolated
    if is_huge or (n_pixels > COARSEST and discontinuity > 0):
        blocks = Blocks.of_step(mask, 2)
        coarse = surface.of_blocks(blocks, keep_edges=not is_huge)
        own_share = 0.75
        of_blocks = _integrate(
            coarse, discontinuity, still / 2, lambda share: progress((1 - own_share) * share)
        )
        of_map = on_map(of_blocks, blocks.mask)
        heights = blocks.step * np.asarray(blocks.interpolate(of_map, mask), np.float64)
        if is_huge:
            return heights
        most = min(20, max(4, 1_000_000 // n_pixels))
    solver = LaplacianSolver(equations.pairs, n_pixels)
    # Normals determine gaps, which are smaller at longer wavelengths. At this wavelength, prior and
    # normals have the same weight.
    pull = 0.0 if prior is None else (2 * np.pi / prior_detail) ** 2 * np.isfinite(prior)
    known_heights = 0.0 if prior is None else np.nan_to_num(prior)
    # At heights of zero, all weights are equal, so the first solve is least squares. If the surface
    # then tears around a part, the forces on it are tiny, and exact solves would let it drift by
    # several pixels. Therefore, small forces are ignored.
    of_flat = solver.forces(equations.weigh(np.zeros(n_pixels), 0.0)[1]) + pull * known_heights
    least = LEAST_FORCE * float(np.linalg.norm(of_flat))
    for number in range(most):
        weights, flows = equations.weigh(heights, discontinuity)
        forces = solver.forces(flows) - pull * (heights - known_heights)
        change = solver.solve(weights, forces, pull=pull, least=least if number else 0.0)
        heights += change
        progress(own_share / most)
        if number and np.std(change) < still:
            break
    return heights


def _normals_of(
    blocks: Blocks, normals: Float64Array, mask: Bools, *, keep_edges: bool
) -> Float64Array:
    """Return the normals (p, 3) of blocks from the normals of their pixels (P, 3).

    A block has the normal of the mean slope. With keep_edges, a block that contains an edge has its
    steepest normal instead, which belongs to the rim, because a mean over the edge would connect
    the two sides by a slope.
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
    # A block contains an edge if a normal deviates from the mean by more than this angle.
    mixed = (closest < np.cos(np.radians(20.0))) & (steepest[:, 2] > SMALLEST_COSINE)
    return np.asarray(np.where(mixed[:, None], steepest, mean))


def _heights_of_prior(prior: Floats, mask: Bools, camera_matrix: Floats | None) -> Float64Array:
    """Return a prior as heights (P,) in the unit of the equations, NaN where it is unknown."""
    if prior.shape != mask.shape:
        raise UsageError(
            f"the prior has shape {prior.shape}, expected {mask.shape} as in the normal map"
        )
    heights = prior[mask].astype(np.float64)
    beyond = np.isfinite(heights) & (np.abs(heights) > _LARGEST_VALUE)
    _refuse(beyond, mask, f"beyond {_LARGEST_VALUE:g}")
    if camera_matrix is not None:
        smallest = 1 / _LARGEST_VALUE
        _refuse((heights > 0) & (heights < smallest), mask, f"below {smallest:g}")
        heights = -focal_length(camera_matrix) * np.log(np.where(heights > 0, heights, np.nan))
    heights[~np.isfinite(heights)] = np.nan
    if np.isnan(heights).all():
        raise InputError("the prior has no value in the mask")
    return heights


def _refuse(wrong: Bools, mask: Bools, reason: str) -> None:
    """Raise InputError with this reason if a value (P,) of a prior in a mask (H, W) is wrong."""
    if wrong.any():
        row, column = np.argwhere(mask)[wrong.argmax()]
        problem = f"{np.count_nonzero(wrong)} of {wrong.size} values of the prior are {reason}"
        raise InputError(
            f"{problem}, the first in row {row}, column {column}",
            hint="Use the unit of the result, and NaN where the value is unknown",
        )


def _check_prior(surface: _Surface) -> None:
    """Raise InputError for a prior that is negated, in another unit, or contains outliers."""
    step = max(1, round(min(surface.prior_detail, *surface.mask.shape) / 4))
    coarse = surface.of_blocks(Blocks.of_step(surface.mask, step), keep_edges=False)
    equations = BilateralEquations.from_normals(
        coarse.normal_map, coarse.mask, coarse.camera_matrix
    )
    assert coarse.prior is not None
    slopes, expected = [], []
    for slant, (near, far) in zip(equations.slants, equations.pairs, strict=True):
        facing = equations.facing[near] + equations.facing[far]
        usable = np.isfinite(coarse.prior[near] + coarse.prior[far]) & (facing > SMALLEST_COSINE)
        slopes.append((coarse.prior[far] - coarse.prior[near])[usable])
        expected.append(-((slant[near] + slant[far]) / np.maximum(facing, SMALLEST_COSINE))[usable])
    found, wanted = np.concatenate(slopes), np.concatenate(expected)
    both = float(found @ wanted)
    correlation = both / max(float(np.linalg.norm(found) * np.linalg.norm(wanted)), 1e-12)
    steeper = both / max(float(wanted @ wanted), 1e-12)
    # A blurred prior is flatter than the normals.
    if abs(correlation) > 0.3 and not 0.2 < steeper < 5.0:  # slopes of prior and normals
        raise InputError(
            f"the prior is {steeper:.2g} times as steep as the normals, expected about 1",
            hint="Use heights towards the camera, or depths with a camera matrix, in the unit of"
            " the result",
        )
    assert surface.prior is not None
    farthest = 3.0 * max(np.ptp(np.flatnonzero(surface.mask.any(axis=axis))) + 1 for axis in (0, 1))
    away = np.abs(surface.prior - np.nanmedian(surface.prior)) > farthest
    _refuse(away, surface.mask, "farther from their median than 3 times the width of the object")


def _depth_map(
    heights: Float64Array, mask: Bools, camera_matrix: Floats | None, prior: Float64Array | None
) -> Float64Array:
    from scipy.ndimage import label

    parts = label(mask)[0][mask] - 1  # label connects pixels that share a side, as the equations do
    offsets = np.bincount(parts, heights) / np.bincount(parts)
    if prior is not None:
        # Parts without a prior have the mean height of the known pixels.
        is_known = np.bincount(parts, np.isfinite(prior)) > 0
        offsets = np.where(is_known, 0, offsets - np.nanmean(prior))
    heights = heights - offsets[parts]
    depth = np.full(mask.shape, np.nan)
    if camera_matrix is not None:
        heights = np.exp(-heights / focal_length(camera_matrix))
    depth[mask] = heights
    return depth


def _check_maps(normal_map: Floats, mask: Bools) -> None:
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(f"the mask is {mask.dtype} {mask.shape}, expected bool (H, W)")
    if normal_map.shape != (*mask.shape, 3):
        raise UsageError(
            f"the normal map has shape {normal_map.shape}, expected {(*mask.shape, 3)} for this"
            " mask"
        )
    if not mask.any():
        raise InputError("the mask is empty", hint="Mark the pixels of the object in it")
    wrong = mask.copy()
    length = np.linalg.norm(normal_map[mask].astype(np.float64), axis=1)
    # The tolerance accepts normals from float16 and 8-bit images, but not zero vectors or NaN.
    wrong[mask] = ~(np.abs(length - 1) <= 1e-2)
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        problem = f"{np.count_nonzero(wrong)} of {length.size} normals in the mask are not unit"
        hint = "Exclude pixels without a normal from the mask"
        first = f"the first in row {row}, column {column}"
        raise InputError(f"{problem} vectors, {first}", hint=hint)
