"""The equations of bilateral normal integration, their weights, and their linear solver.

Each pixel has one unknown height h, in pixels: z for an orthographic camera, -f log(depth) for a
pinhole camera with focal length f. The normal n of a pixel determines how h changes to the next
pixel on the right and below:

    facing * (h' - h) + slant = 0,      facing = -n.r,   slant = f n.dr.

Here r is the ray through the pixel, scaled to z = -1, and dr its change to the neighbour.
Orthographic rays are all (0, 0, -1), and f dr is one pixel.

Away from edges, the equation of a pixel applies to both its neighbours on an axis. At an edge, it
applies to only one of them. Therefore, the squared residual towards each side is weighted by

    share = sigmoid(discontinuity * facing^2 * (gap towards the other side^2 - gap towards this
    side^2)).

On a side without a neighbour, the gap is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Bools, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import focal_length, pixel_rays, ray_basis

PixelNumbers = NDArray[np.int32]
DISCONTINUITY = 2.0  # how easily the surface tears, as in the paper
_MOST_STEPS = 5_000  # steps of conjugate gradients, as in the paper's code
_FEW_PIXELS = 3_000  # solved directly, in less time than multigrid takes to import

# The cosine between a normal and its ray at 87 degrees. Beyond this angle, one degree changes the
# slope by a third or more, so the normal is not a reliable indication of the height. The heights of
# such pixels, and of pixels whose normals face away from the camera, are determined by their
# neighbours.
SMALLEST_COSINE = 0.05


@dataclass(frozen=True)
class BilateralEquations:
    """The equations of P pixels."""

    facing: Float64Array  # (P,), zero for unusable normals
    # (P,) along the rows and (P,) along the columns, zero for unusable normals
    slants: tuple[Float64Array, Float64Array]
    # pairs of neighbours along the rows, and along the columns: (E,) indices of the left or upper
    # pixels, and (E,) indices of the right or lower pixels
    pairs: tuple[tuple[PixelNumbers, PixelNumbers], tuple[PixelNumbers, PixelNumbers]]

    @classmethod
    def from_normals(
        cls, normal_map: Floats, mask: Bools, camera_matrix: Floats | None
    ) -> BilateralEquations:
        """Return the equations of a normal map (H, W, 3) at the pixels of a mask (H, W)."""
        normals = unit(normal_map[mask].astype(np.float64))
        if camera_matrix is None:
            facing, cosine = normals[:, 2], normals[:, 2]
            to_right, down = np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
        else:
            rays = pixel_rays(mask, camera_matrix)
            facing = -np.einsum("pi,pi->p", normals, rays)
            cosine = facing / np.linalg.norm(rays, axis=1)
            to_right, down, _ = focal_length(camera_matrix) * ray_basis(camera_matrix)
        usable = cosine > SMALLEST_COSINE
        number = np.full(mask.shape, -1, np.int32)
        number[mask] = np.arange(len(normals))
        pairs = []
        for near, far in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:])):
            both = (near >= 0) & (far >= 0)
            pairs.append((near[both], far[both]))
        slants = (normals @ to_right * usable, normals @ down * usable)
        return cls(facing * usable, slants, (pairs[0], pairs[1]))

    def weigh(
        self, heights: Float64Array, discontinuity: float
    ) -> tuple[Float64Array, Float64Array]:
        """Return the weights and the flows (E,) of all pairs at the heights (P,).

        For the gap of a pair, the weight is half the second derivative of the sum of squares, and
        the flow half its first derivative. Pairs along the rows come first, then pairs along the
        columns.
        """
        from scipy.special import expit

        weights, flows = [], []
        for slant, (near, far) in zip(self.slants, self.pairs, strict=True):
            gap = heights[far] - heights[near]
            ahead, behind = np.zeros((2, len(heights)))
            ahead[near], behind[far] = gap, gap
            # Both pixels of a pair have an equation for its gap.
            residuals = [self.facing[pixels] * gap + slant[pixels] for pixels in (near, far)]
            share_ahead = expit(discontinuity * self.facing**2 * (behind**2 - ahead**2))
            weight, flow = np.zeros((2, len(gap)))
            shares = share_ahead[near], 1 - share_ahead[far]
            for pixels, share, residual in zip((near, far), shares, residuals, strict=True):
                weight += share * self.facing[pixels] ** 2
                flow += share * self.facing[pixels] * residual
            weights.append(weight)
            flows.append(flow)
        return np.concatenate(weights), np.concatenate(flows)


class LaplacianSolver:
    """A solver for the normal equations of pairs of neighbours that is used repeatedly with new
    weights.

    The matrix is a weighted Laplacian of the graph of pixels.
    """

    def __init__(self, pairs: tuple[tuple[PixelNumbers, PixelNumbers], ...], n_pixels: int) -> None:
        from scipy.sparse import csr_matrix

        self._near = np.concatenate([near for near, _ in pairs])
        self._far = np.concatenate([far for _, far in pairs])
        self._n_pixels = n_pixels
        # The sparsity pattern is constant. A matrix of positions maps each value to its place.
        pixels = np.arange(n_pixels, dtype=np.int32)
        rows = np.concatenate((self._near, self._far, pixels))
        columns = np.concatenate((self._far, self._near, pixels))
        positions = np.arange(len(rows), dtype=np.int32)
        self._pattern = csr_matrix((positions, (rows, columns)), shape=(n_pixels, n_pixels))

    def forces(self, flows: Float64Array) -> Float64Array:
        """Return the forces on the heights (P,), which are half the negative derivative of the
        cost.
        """
        return self._sum(flows, self._near) - self._sum(flows, self._far)

    def solve(
        self,
        weights: Float64Array,
        forces: Float64Array,
        *,
        pull: Float64Array | float = 0.0,
        least: float = 0.0,
    ) -> Float64Array:
        """Return the change of the heights (P,) that minimises the sum of squares.

        Weights (E,) are half the second derivative with respect to the gap of each pair, and
        `forces` (P,) half the negative first derivative with respect to each height. `pull` (P,) is
        half the second derivative of the cost that pulls the heights to known ones; `forces` must
        include it. The norm of the remaining forces is at most `least`. If it is 0, the solution is
        accurate to seven digits.
        """
        from scipy.sparse import csr_matrix, diags_array
        from scipy.sparse.linalg import cg, spsolve

        # Small costs on changes of the gaps and heights keep the system from being singular, so
        # pixels without equations keep their heights. The equations have costs up to 1.
        weights = weights + 1e-10
        diagonal = self._sum(weights, self._near) + self._sum(weights, self._far) + 1e-12 + pull
        values = np.concatenate((-weights, -weights, diagonal))[self._pattern.data]
        matrix = csr_matrix(
            (values, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape
        )
        change: Float64Array
        if least > 0:
            # Multigrid would move whole parts even if the forces on them are this small.
            inverse = diags_array(1 / np.maximum(diagonal, 1e-5))
            change, _ = cg(matrix, forces, rtol=0, atol=least, maxiter=_MOST_STEPS, M=inverse)
            return change
        if self._n_pixels < _FEW_PIXELS:
            return np.asarray(spsolve(matrix, forces))
        from pyamg import ruge_stuben_solver

        # For these matrices, classical multigrid is faster than smoothed aggregation, including its
        # setup.
        multigrid = ruge_stuben_solver(matrix).aspreconditioner()
        change, _ = cg(matrix, forces, rtol=1e-7, maxiter=200, M=multigrid)
        return change

    def _sum(self, of_pairs: Float64Array, pixels: PixelNumbers) -> Float64Array:
        return np.asarray(np.bincount(pixels, of_pairs, self._n_pixels), np.float64)
