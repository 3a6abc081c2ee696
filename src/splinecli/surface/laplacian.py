"""The linear solver of integration: a weighted Laplacian of the graph of pixels.

Conjugate gradients with an algebraic multigrid preconditioner.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Pixels = NDArray[np.int32]

# Small costs on the change of gaps and of heights in one solve; the equations have costs up to 1. Pixels that no
# equation ties to others keep their heights, and the system is never singular.
_DAMPING_OF_GAPS = 1e-7
_DAMPING_OF_HEIGHTS = 1e-12
_MAX_STEPS = 200
_STEPS_BEFORE_RENEWAL = 15  # above this number of steps, a new preconditioner saves more time than it costs


class LaplacianSolver:
    """Solve the normal equations of pairs of neighbours again and again, with other weights each time.

    The setup of multigrid costs as much as several solves, so it is kept while the weights stay similar.
    """

    def __init__(self, pairs: tuple[tuple[Pixels, Pixels], ...], n_pixels: int) -> None:
        from scipy.sparse import csr_matrix

        self._near = np.concatenate([near for near, _ in pairs])
        self._far = np.concatenate([far for _, far in pairs])
        self._n_pixels = n_pixels
        self._preconditioner: Any = None
        # The matrix always has the same pattern. A matrix of positions says which value goes where.
        pixels = np.arange(n_pixels, dtype=np.int32)
        rows = np.concatenate((self._near, self._far, pixels))
        columns = np.concatenate((self._far, self._near, pixels))
        positions = np.arange(len(rows), dtype=np.int32)
        self._pattern = csr_matrix((positions, (rows, columns)), shape=(n_pixels, n_pixels))

    def solve(
        self,
        weights: Floats,
        flows: Floats,
        *,
        precision: float,
        pull: Floats | float = 0.0,
        distance: Floats | float = 0.0,
    ) -> Floats:
        """Return the change of heights (P,) that minimises the sum of squares.

        Args:
            weights: (E,) half the second derivative by the gap of each pair.
            flows: (E,) half the first derivative by the gap of each pair.
            precision: the relative residual at which the solver stops.
            pull: (P,) half the second derivative by the height of each pixel, of what pulls it to a known height.
            distance: (P,) of the heights above these known ones.
        """
        from pyamg import ruge_stuben_solver
        from scipy.sparse.linalg import cg

        matrix = self._laplacian(weights + _DAMPING_OF_GAPS, pull)
        if self._preconditioner is None:
            # On these matrices, classical multigrid is faster than smoothed aggregation, both to set up and to use.
            self._preconditioner = ruge_stuben_solver(matrix).aspreconditioner()
        steps = 0

        def count(_: Floats) -> None:
            nonlocal steps
            steps += 1

        change: Floats
        change, _ = cg(
            matrix,
            self._sum(flows, self._near) - self._sum(flows, self._far) - pull * distance,
            rtol=precision,
            maxiter=_MAX_STEPS,
            M=self._preconditioner,
            callback=count,
        )
        if steps > _STEPS_BEFORE_RENEWAL:
            self._preconditioner = None
        return change

    def _laplacian(self, weights: Floats, pull: Floats | float) -> Any:
        from scipy.sparse import csr_matrix

        diagonal = self._sum(weights, self._near) + self._sum(weights, self._far) + _DAMPING_OF_HEIGHTS + pull
        values = np.concatenate((-weights, -weights, diagonal))[self._pattern.data]
        return csr_matrix((values, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape)

    def _sum(self, of_pairs: Floats, pixels: Pixels) -> Floats:
        return np.asarray(np.bincount(pixels, of_pairs, self._n_pixels), np.float64)
