"""Methods that are a function of a batch of pixels, in torch: batches, devices, and the scale of the intensities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.errors import UsageError
from splinecli.methods.least_squares import TOWARDS_CAMERA
from splinecli.observation_map import map_scale

Solve = Callable[[Tensor, Tensor], Tensor]
"""(observations (P, F) with a largest value of 1 each, light directions (F, 3)) -> normals (P, 3), of any length.

All observations are finite and none is negative. A zero vector says that the pixel has no normal.
"""


@dataclass(frozen=True)
class BatchedEstimator:
    """A method as an estimator: `solve` on batches of pixels.

    Args:
        name: the method's name in the registry.
        solve: see Solve. Every pixel is divided by its largest observation first: thresholds and priors then mean
            the same for dark and bright pixels, and scaling the images changes nothing.
        batch_size: pixels at a time.
    """

    name: str
    solve: Solve
    device: str
    batch_size: int
    precision: str = "float64"
    weights: None = None

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise UsageError("batch size is a whole number from 1")

    @property
    def fingerprint(self) -> str:
        return f"{self.name} {self.precision}"

    def estimate(
        self, observations: NDArray[np.float32], light_directions: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Unit normals (P, 3) from observations (P, F) under lights (F, 3)."""

        def solve_scaled(batch: Tensor, lights: Tensor) -> Tensor:
            batch = batch.clamp(min=0)
            found = self.solve(batch / map_scale(batch), lights)
            # Lengths tell nothing and may be tiny: in two steps, for normalize takes such vectors for zero.
            largest = found.abs().amax(dim=1, keepdim=True).clamp(min=1e-300)
            return torch.nn.functional.normalize(found / largest, dim=1)

        return estimate_in_batches(
            solve_scaled,
            observations,
            light_directions,
            batch_size=self.batch_size,
            device=self.device,
            dtype=torch.float64,
        )


@torch.inference_mode()
def estimate_in_batches(
    solve: Solve,
    observations: NDArray[np.float32],
    light_directions: NDArray[np.float64],
    *,
    batch_size: int,
    device: str,
    dtype: torch.dtype,
    columns: int = 3,
) -> NDArray[np.float32]:
    """What `solve` makes of the observations as they are: unit normals (P, 3), or zero, which becomes (0, 0, 1).

    Args:
        columns: that `solve` gives: the normal's three, and others behind them, which are kept as they are.
    """
    lights = torch.as_tensor(light_directions, dtype=dtype, device=device)
    results = np.empty((len(observations), columns), np.float32)
    for start in range(0, len(observations), batch_size):
        batch = torch.as_tensor(observations[start : start + batch_size]).to(device, dtype)
        found = solve(batch, lights)
        found[~found[:, :3].any(dim=1), :3] = found.new_tensor(TOWARDS_CAMERA)
        results[start : start + batch_size] = found.cpu().numpy()
    return results
