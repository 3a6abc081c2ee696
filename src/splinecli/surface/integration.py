"""Bilateral normal integration: heights from normals, torn where the surface is.

Cao, Santo, Shi, Okura and Matsushita, Bilateral normal integration, ECCV 2022. Frame: x right, y up, z to the camera
(docs/conventions.md).

The unknown is one height h per pixel, in pixels: z itself for an orthographic camera, -f log(depth) for a pinhole of
focal length f. A pixel's normal n fixes how h changes from it to its neighbours on the right and below,

    facing * (h' - h) + slant = 0,      facing = -n.r,   slant = f n.dr,

with r the ray through the pixel, scaled to z = -1, and dr its change to the neighbour; orthographic rays are all
(0, 0, -1), and f dr is one pixel. Such an equation holds towards both sides of a pixel, or, at the edge of something,
towards one: each side gets the share

    sigmoid(stiffness * facing^2 * (gap towards the other side^2 - gap towards this side^2))

of the squared residual. Shares and heights are found in turn. A side without a neighbour counts as a gap of zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import InputError, UsageError
from splinecli.normals import unit

Floats = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-2  # normals from float16 and 8-bit pictures pass, zero ones do not
# Cosine to the ray, at 87 degrees: from there on a degree changes the slope by a third, so that the normal tells
# nothing of the height. Nor does one that faces away; the neighbours' equations speak for such pixels.
_GRAZING = 0.05
# Costs on the change of gaps and of heights in one iteration, beside those of at most 1 in the equations. What no
# equation holds together stays where it was, instead of making the system singular.
_HOLD_GAPS = 1e-7
_HOLD_HEIGHTS = 1e-12
_EXACT = 1e-6  # rms residual, in pixels, below which there is nothing to improve
_STALE_AFTER = 15  # steps of conjugate gradients for which a new preconditioner pays


def integrate_normals(
    normal_map: NDArray[np.floating],
    mask: NDArray[np.bool_],
    *,
    camera_matrix: NDArray[np.floating] | None = None,
    stiffness: float = 2.0,
    max_iterations: int = 150,
    tolerance: float = 1e-4,
    progress: Callable[[int, int], None] | None = None,
) -> Floats:
    """The height or depth (H, W), NaN outside the mask, of a normal map (H, W, 3), unit in the mask (H, W).

    Without a camera matrix the camera is orthographic and the result the height towards it, in pixels. With one it
    is the depth along the viewing axis, positive, of unknown scale. Normals say nothing of the offset between parts
    that do not touch (at sides of pixels): each has mean height 0, or geometric mean depth 1.

    Args:
        normal_map: row 0 at the top.
        camera_matrix: (3, 3) in pixels, [[fx, s, cx], [0, fy, cy], [0, 0, 1]]: columns to the right and rows down,
            (0, 0) the centre of the first pixel, as in OpenCV.
        stiffness: how readily the surface tears; 0 is least squares, which never does.
        max_iterations: of solving for heights; 1 is least squares.
        tolerance: stops when the sum of squares changes by no more than this share of itself.
        progress: is told the iterations done and the most there can be.

    Raises:
        UsageError: the arrays' shapes or types do not fit, or an option is out of range.
        InputError: the mask is empty, a normal in it is not unit, or the camera matrix is none.
    """
    _check_options(stiffness, max_iterations, tolerance)
    _check_maps(normal_map, mask)
    equations = _Equations.of(normal_map, mask, camera_matrix)
    heights = np.zeros(len(equations.facing))
    system = _System(equations)
    cost = np.inf
    for iteration in range(max_iterations):
        weights, flows, new_cost = equations.weigh(heights, stiffness)
        if iteration > 1 and abs(cost - new_cost) <= tolerance * new_cost + _EXACT**2 * len(heights):
            break
        cost = new_cost
        # At heights of zero all shares are a half, so that least squares come first, solved to the end. After that the
        # surface is moved a little further each time, which needs few digits.
        heights += system.solve(weights, flows, precision=1e-9 if iteration == 0 else 0.03)
        if progress is not None:
            progress(iteration + 1, max_iterations)
    return _depth_map(heights, mask, camera_matrix)


def pixel_rays(mask: NDArray[np.bool_], camera_matrix: NDArray[np.floating]) -> Floats:
    """The points (P, 3) at depth 1, z = -1, that a pinhole at the origin sees in the pixels of the mask (H, W).

    Raises InputError or UsageError, as integrate_normals does, for what is no camera matrix.
    """
    rows, columns = np.nonzero(mask)
    image = np.stack((columns, rows, np.ones(len(rows))), axis=1).astype(np.float64)
    return image @ _inverse(camera_matrix)


def focal_length(camera_matrix: NDArray[np.floating]) -> float:
    """In pixels; of both axes the geometric mean."""
    return float(np.sqrt(np.linalg.det(np.asarray(camera_matrix, np.float64)[:2, :2])))


@dataclass(frozen=True)
class _Equations:
    """facing (P,), zero where a normal tells nothing, and for columns and for rows: the slants (P,), zero there too,
    and the pairs of neighbours, numbers (E,) of the pixels on the left or above and of those on the right or below.
    """

    facing: Floats
    slants: tuple[Floats, Floats]
    pairs: tuple[tuple[NDArray[np.int32], NDArray[np.int32]], ...]

    @classmethod
    def of(
        cls,
        normal_map: NDArray[np.floating],
        mask: NDArray[np.bool_],
        camera_matrix: NDArray[np.floating] | None,
    ) -> _Equations:
        normals = unit(normal_map[mask].astype(np.float64))
        if camera_matrix is None:
            facing, cosine = normals[:, 2], normals[:, 2]
            to_right, down = np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
        else:
            rays = pixel_rays(mask, camera_matrix)
            facing = -np.einsum("pi,pi->p", normals, rays)
            cosine = facing / np.linalg.norm(rays, axis=1)
            to_right, down, _ = focal_length(camera_matrix) * _inverse(camera_matrix)
        telling = cosine > _GRAZING
        number = np.full(mask.shape, -1, np.int32)
        number[mask] = np.arange(len(normals))
        return cls(
            facing * telling,
            (normals @ to_right * telling, normals @ down * telling),
            (_pairs(number[:, :-1], number[:, 1:]), _pairs(number[:-1], number[1:])),
        )

    def weigh(self, heights: Floats, stiffness: float) -> tuple[Floats, Floats, float]:
        """The sum of squares at the heights (P,), its shares as they are there, and for each pair of neighbours
        half its second and first derivative by their gap, first those in rows, then those in columns.
        """
        cost, weights, flows = 0.0, [], []
        for slant, (near, far) in zip(self.slants, self.pairs, strict=True):
            gap = heights[far] - heights[near]
            ahead, behind = np.zeros_like(heights), np.zeros_like(heights)
            ahead[near], behind[far] = gap, gap
            share_ahead = _sigmoid(stiffness * self.facing**2 * (behind**2 - ahead**2))
            weight, flow = np.zeros_like(gap), np.zeros_like(gap)
            # Each pair has the equations of both its pixels.
            for pixels, share in ((near, share_ahead[near]), (far, 1 - share_ahead[far])):
                facing = self.facing[pixels]
                residual = facing * gap + slant[pixels]
                weight += share * facing**2
                flow += share * facing * residual
                cost += float(share @ residual**2)
            weights.append(weight)
            flows.append(flow)
        return np.concatenate(weights), np.concatenate(flows), cost


class _System:
    """The normal equations, a Laplacian of the pixels' graph: conjugate gradients behind algebraic multigrid.

    Setting multigrid up costs several solutions; it serves while the weights it was made for are near enough.
    """

    def __init__(self, equations: _Equations) -> None:
        from scipy.sparse import csr_matrix

        self._near = np.concatenate([near for near, _ in equations.pairs])
        self._far = np.concatenate([far for _, far in equations.pairs])
        self._n_pixels = len(equations.facing)
        self._preconditioner: Any = None
        # Where each of the values off and on the diagonal goes in the matrix, which always has the same places.
        pixels = np.arange(self._n_pixels, dtype=np.int32)
        rows = np.concatenate((self._near, self._far, pixels))
        columns = np.concatenate((self._far, self._near, pixels))
        places = np.arange(len(rows), dtype=np.int32)
        self._places = csr_matrix((places, (rows, columns)), shape=(self._n_pixels, self._n_pixels))

    def solve(self, weights: Floats, flows: Floats, *, precision: float) -> Floats:
        """The change of heights (P,) that minimises the sum of squares, to a relative residual of `precision`."""
        from pyamg import ruge_stuben_solver
        from scipy.sparse.linalg import cg

        # Of pyamg's hierarchies the classical one is the faster to set up and to use on these matrices.
        matrix = self._laplacian(weights + _HOLD_GAPS)
        if self._preconditioner is None:
            self._preconditioner = ruge_stuben_solver(matrix).aspreconditioner()
        steps = 0

        def count(_: Floats) -> None:
            nonlocal steps
            steps += 1

        change: Floats
        change, _ = cg(
            matrix,
            self._divergence(flows),
            rtol=precision,
            maxiter=200,
            M=self._preconditioner,
            callback=count,
        )
        if steps > _STALE_AFTER:
            self._preconditioner = None
        return change

    def _laplacian(self, weights: Floats) -> Any:
        from scipy.sparse import csr_matrix

        diagonal = self._sum(weights, self._near) + self._sum(weights, self._far) + _HOLD_HEIGHTS
        values = np.concatenate((-weights, -weights, diagonal))[self._places.data]
        return csr_matrix((values, self._places.indices, self._places.indptr), shape=self._places.shape)

    def _divergence(self, flows: Floats) -> Floats:
        return self._sum(flows, self._near) - self._sum(flows, self._far)

    def _sum(self, of_pairs: Floats, pixels: NDArray[np.int32]) -> Floats:
        return np.asarray(np.bincount(pixels, of_pairs, self._n_pixels), np.float64)


def _depth_map(
    heights: Floats, mask: NDArray[np.bool_], camera_matrix: NDArray[np.floating] | None
) -> Floats:
    from scipy.ndimage import label

    parts = label(mask)[0][mask] - 1  # label's neighbours are those at the sides, too
    heights = heights - (np.bincount(parts, heights) / np.bincount(parts))[parts]
    depth = np.full(mask.shape, np.nan)
    depth[mask] = heights if camera_matrix is None else np.exp(-heights / focal_length(camera_matrix))
    return depth


def _pairs(near: NDArray[np.int32], far: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    both = (near >= 0) & (far >= 0)
    return near[both], far[both]


def _sigmoid(values: Floats) -> Floats:
    from scipy.special import expit

    shares: Floats = expit(values)
    return shares


def _inverse(camera_matrix: NDArray[np.floating]) -> Floats:
    """Its rows: what one column, one row and the origin of the image are at depth 1, in the frame."""
    matrix = np.asarray(camera_matrix, np.float64)
    if matrix.shape != (3, 3):
        raise UsageError(f"the camera matrix has shape {matrix.shape}, expected (3, 3)")
    if not (
        np.isfinite(matrix).all()
        and min(matrix[0, 0], matrix[1, 1], np.linalg.det(matrix[:2, :2])) > 0
        and (matrix[2] == (0, 0, 1)).all()
    ):
        raise InputError(
            f"{matrix.tolist()} is no camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above zero",
            hint="Give it in pixels, columns to the right and rows down",
        )
    return np.asarray(np.linalg.inv(matrix).T * (1, -1, -1), np.float64)


def _check_options(stiffness: float, max_iterations: int, tolerance: float) -> None:
    if not (isfinite(stiffness) and stiffness >= 0):
        raise UsageError(f"the stiffness is {stiffness:g}, expected a number from 0 up")
    if max_iterations < 1:
        raise UsageError(f"max_iterations is {max_iterations}, expected at least 1")
    if not (isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"the tolerance is {tolerance:g}, expected a number from 0 up")


def _check_maps(normal_map: NDArray[np.floating], mask: NDArray[np.bool_]) -> None:
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(f"the mask is {mask.dtype} {mask.shape}, expected bool (H, W)")
    if normal_map.shape != (*mask.shape, 3):
        raise UsageError(
            f"the normal map has shape {normal_map.shape}, expected {(*mask.shape, 3)} as the mask"
        )
    if not mask.any():
        raise InputError("the mask is empty", hint="Mark the pixels of the object in it")
    wrong = mask.copy()
    length = np.linalg.norm(normal_map[mask].astype(np.float64), axis=1)
    wrong[mask] = ~(np.abs(length - 1) <= _UNIT_TOLERANCE)  # NaN, too
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise InputError(
            f"{np.count_nonzero(wrong)} of {length.size} normals in the mask are not unit vectors, the first in row "
            f"{row}, column {column}",
            hint="Take pixels without a normal out of the mask",
        )
