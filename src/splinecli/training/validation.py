"""Checks on pixels that a run never trains on, and the page of maps for the person who watches it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.networks.spline_net import SplineNet, to_pixel_frame
from splinecli.synthesis.batches import PixelBatch
from splinecli.training.losses import angular_loss
from splinecli.training.objective import truth_in_frame

SHOWN_PIXELS = 8


def validation_deg(network: SplineNet, batch: PixelBatch, *, bfloat16: bool = False) -> float:
    """Mean angular error in degrees."""
    return math.degrees(angular_loss(*_estimate(network, batch, bfloat16=bfloat16)[:2]).item())


class SampleMaps(NamedTuple):
    """Maps of N pixels, each (N, w, w), NaN where there is nothing, and the errors of their normals (N,)."""

    sparse: NDArray[np.float32]
    dense: NDArray[np.float32]
    truth: NDArray[np.float32]
    error_deg: NDArray[np.float32]


def sample_maps(network: SplineNet, batch: PixelBatch) -> SampleMaps:
    """What the networks see, guess and should have guessed of some pixels of a batch, spread evenly over it."""
    step = max(1, len(batch.observations) // SHOWN_PIXELS)
    normals, truth, sparse, holds, dense, dense_truth, filled = _estimate(network, batch)
    inside = network.inside.expand_as(dense)

    def picture(values: Tensor, known: Tensor) -> NDArray[np.float32]:
        values = values.float().masked_fill(known == 0, torch.nan)
        picked: NDArray[np.float32] = values[::step, 0][:SHOWN_PIXELS].cpu().numpy()
        return picked

    errors = torch.linalg.vector_norm(normals - truth, dim=1).div(2).clamp(max=1).asin().mul(2).rad2deg()
    return SampleMaps(
        picture(sparse, holds),
        picture(dense, inside),
        picture(dense_truth, filled),
        errors[::step][:SHOWN_PIXELS].cpu().numpy(),
    )


@torch.no_grad()
def _estimate(network: SplineNet, batch: PixelBatch, *, bfloat16: bool = False) -> tuple[Tensor, ...]:
    network.eval()
    views = network.look(batch.observations, batch.light_directions, batch.valid)
    with torch.autocast(batch.observations.device.type, dtype=torch.bfloat16, enabled=bfloat16):
        dense = network.interpolate(views)
        normals = network.estimate(views, dense)
    truth, _ = truth_in_frame(batch, views, size=network.config.map_size)
    normals_truth = to_pixel_frame(batch.scene.normals, views)
    return normals, normals_truth, views.sparse, views.holds, dense.float(), truth.values, truth.filled
