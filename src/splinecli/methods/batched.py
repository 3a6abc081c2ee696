"""Estimators made of one torch function: they split the pixels into batches and scale each pixel."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.errors import UsageError
from splinecli.maths.observation_map import map_scale
from splinecli.methods.estimator import Directions, Observations, directions_at
from splinecli.methods.least_squares import TOWARDS_CAMERA
from splinecli.system.machine import side_by_side
from splinecli.system.progress import Progress

Solve = Callable[[Tensor, Tensor], Tensor]
"""(observations (P, F), the largest of each pixel 1; light directions (F, 3) or (P, F, 3)) -> normals (P, 3).

The normals may have any length, 0 for a pixel that has none. All observations are finite, and none is negative."""


@dataclass(frozen=True)
class BatchedEstimator:
    """An estimator that calls `solve` on batches of pixels, in float64.

    Each pixel is first divided by its largest observation. Thresholds and priors then mean the same for dark and bright
    pixels, and the scale of the images does not matter. Raises UsageError for a batch size below 1.
    """

    name: str  # in the registry
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
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> NDArray[np.float32]:
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3); see Estimator."""

        def solve_scaled(batch: Tensor, lights: Tensor) -> Tensor:
            batch = batch.clamp(min=0)
            normals = self.solve(batch / map_scale(batch), lights)
            # The length may be tiny, and normalize would treat such a vector as zero. So divide in two steps.
            largest = normals.abs().amax(dim=1, keepdim=True).clamp(min=1e-300)
            return torch.nn.functional.normalize(normals / largest, dim=1)

        return estimate_in_batches(
            solve_scaled,
            observations,
            light_directions,
            batch_size=self.batch_size,
            device=self.device,
            dtype=torch.float64,
            progress=progress,
        )


def estimate_in_batches(
    solve: Solve,
    observations: Observations,
    light_directions: Directions,
    *,
    batch_size: int,
    device: str,
    dtype: torch.dtype,
    columns: int = 3,
    progress: Progress | None = None,
) -> NDArray[np.float32]:
    """Call `solve` on batches of observations, side by side, and return its results (P, columns) as float32.

    Args:
        solve: returns unit normals in its first three columns. Zero vectors are replaced by (0, 0, 1).
        observations: (P, F); `solve` gets them unscaled.
        light_directions: (F, 3) or (P, F, 3).
        columns: number of columns that `solve` returns. Those behind the normal are not changed.
        progress: called after each batch with the number of its pixels.
    """
    results = np.empty((len(observations), columns), np.float32)

    def solve_batch(start: int) -> int:
        rows = slice(start, start + batch_size)
        batch = torch.as_tensor(observations[rows]).to(device, dtype)
        lights = torch.as_tensor(directions_at(light_directions, rows), dtype=dtype, device=device)
        solved = solve(batch, lights)
        solved[~solved[:, :3].any(dim=1), :3] = solved.new_tensor(TOWARDS_CAMERA)
        results[rows] = solved.cpu().numpy()
        return len(batch)

    for count in side_by_side(solve_batch, range(0, len(observations), batch_size)):
        if progress is not None:
            progress(count)
    return results
