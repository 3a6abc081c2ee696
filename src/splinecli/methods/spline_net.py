"""SPLINE-Net as an estimator: batches, devices, precision, and the average over several views of a pixel."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.errors import UsageError
from splinecli.networks.weights import LoadedNetwork

Precision = Literal["float32", "bfloat16"]

VIEW_SPAN_DEG = 20.0
"""Canonical networks know turns of up to 15 degrees either way; their views stay well inside."""


class SplineNetEstimator:
    """LI-Net, then NE-Net, on batches of pixels.

    Args:
        loaded: the network with its name and checksum.
        rotations: R, the number of views averaged. A network without a canonical azimuth sees the lights
            turned by 360 k / R degrees about the view axis, as CNN-PS does. For one with a canonical azimuth
            such turns change nothing; its views are mirror images and small turns across 20 degrees, which
            move the lights over the borders of the cells.
        batch_size: pixels at a time; memory grows with it (about 0.25 MB a pixel).
    """

    name = "spline-net"

    def __init__(
        self,
        loaded: LoadedNetwork,
        *,
        device: torch.device | str = "cpu",
        precision: Precision = "bfloat16",
        rotations: int = 1,
        batch_size: int = 1024,
    ) -> None:
        if rotations < 1 or batch_size < 1:
            raise UsageError("rotations and batch size are whole numbers from 1")
        self.weights = {"name": loaded.name, "sha256": loaded.sha256}
        self.device = str(device)
        self.precision = str(precision)
        self.batch_size = batch_size
        self._network = loaded.network.to(device)
        self._views = views(rotations, canonical=loaded.network.config.is_canonical)

    @torch.inference_mode()
    def estimate(
        self, observations: NDArray[np.float32], light_directions: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Unit normals (P, 3) from observations (P, F) under lights (F, 3)."""
        lights = torch.as_tensor(light_directions, dtype=torch.float32, device=self.device)
        normals = np.empty((len(observations), 3), np.float32)
        for start in range(0, len(observations), self.batch_size):
            batch = torch.as_tensor(observations[start : start + self.batch_size]).to(
                self.device, torch.float32
            )
            with torch.autocast(
                lights.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"
            ):
                total = sum(
                    (
                        self._network(batch, lights, turn_deg=turn, mirror=mirror)
                        for turn, mirror in self._views
                    ),
                    start=torch.zeros((), device=lights.device),
                )
            unit = torch.nn.functional.normalize(total, dim=-1)
            unit[batch.amax(dim=1) <= 0] = unit.new_tensor((0.0, 0.0, 1.0))
            normals[start : start + self.batch_size] = unit.cpu().numpy()
        return normals


def views(rotations: int, *, canonical: bool) -> list[tuple[float, bool]]:
    """The (turn in degrees, mirrored) of each of R views."""
    if not canonical:
        return [(360.0 * k / rotations, False) for k in range(rotations)]
    turns = (rotations + 1) // 2
    span = VIEW_SPAN_DEG if turns > 1 else 0.0
    step = span / max(turns - 1, 1)
    return [(step * (k // 2) - span / 2, k % 2 == 1) for k in range(rotations)]
