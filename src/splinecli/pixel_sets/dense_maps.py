"""Dense observation maps of pixels that are known under a limited number of lights."""

from __future__ import annotations

import torch
from torch import Tensor

from splinecli.synthesis.batches import DenseMap

FILL_ROUNDS = 3
"""Each round fills gaps one cell further from the cells with a light."""


def fill_gaps(values: Tensor, known: Tensor, inside: Tensor) -> DenseMap:
    """Interpolate the cells that lie between cells with a value.

    A cell without a value gets the weighted mean of its eight neighbours in each of FILL_ROUNDS rounds. A cell
    whose neighbours all lie on one side of it stays empty.

    Args:
        values: (P, 1, w, w) observations.
        known: (P, 1, w, w), 1 in cells with an observation, else 0.
        inside: (w, w), 1 in the unit disc. Cells outside stay empty.

    Returns:
        The filled maps, with the given cells as `known` and all usable cells as `filled`.
    """
    near = values.new_tensor([[1.0, 2.0, 1.0], [2.0, 0.0, 2.0], [1.0, 2.0, 1.0]])
    across = near * values.new_tensor([-1.0, 0.0, 1.0])
    kernels = torch.stack((near, across, across.T))[:, None]
    filled, weight = values * known, known
    for _ in range(FILL_ROUNDS):
        total, x, y = torch.chunk(torch.nn.functional.conv2d(weight, kernels, padding=1), 3, dim=1)
        mean = torch.nn.functional.conv2d(filled * weight, kernels[:1], padding=1) / total.clamp(min=1)
        # The centroid of the neighbours with a value is at most half a cell away.
        between = (total > 0) & (torch.hypot(x, y) <= 0.5 * total)
        gap = (weight == 0) & between & (inside > 0)
        filled, weight = torch.where(gap, mean, filled), torch.where(gap, torch.ones_like(weight), weight)
    return DenseMap(filled, known, weight)
