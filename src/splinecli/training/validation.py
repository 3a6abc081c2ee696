"""The validation error of a run, and sample observation maps for maps.png."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.maths.normals import angle_between_deg
from splinecli.networks.spline_net import PixelMaps, SplineNet, to_pixel_frame
from splinecli.synthesis.batches import PixelBatch
from splinecli.training.losses import angles
from splinecli.training.objective import dense_truth_in_frame

SHOWN_PIXELS = 8


def validation_deg(network: SplineNet, batches: Sequence[PixelBatch], *, bfloat16: bool = False) -> float:
    """Return the mean angular error over batches, in degrees."""
    found = []
    for batch in batches:
        maps, _, normals = _estimate(network, batch, bfloat16=bfloat16)
        found.append(angles(normals, to_pixel_frame(batch.truth.normals, maps)))
    return math.degrees(torch.cat(found).mean().item())


class SampleMaps(NamedTuple):
    """Observation maps of N pixels, NaN in empty cells, and the errors of their normals.

    Attributes:
        sparse: the sparse maps, (N, w, w).
        dense: LI-Net's dense maps, (N, w, w); None without a LI-Net.
        truth: the true maps with gaps filled, (N, w, w).
        error_deg: (N,).
    """

    sparse: NDArray[np.float32]
    dense: NDArray[np.float32] | None
    truth: NDArray[np.float32]
    error_deg: NDArray[np.float32]


def sample_maps(network: SplineNet, batches: Sequence[PixelBatch]) -> SampleMaps:
    """Return the maps of up to SHOWN_PIXELS pixels, evenly spaced over the batches."""
    shown = batches[:: max(1, len(batches) // SHOWN_PIXELS)][:SHOWN_PIXELS]
    found = [_sample(network, batch, SHOWN_PIXELS // len(shown)) for batch in shown]
    maps: list[Any] = [None if parts[0] is None else np.concatenate(parts) for parts in zip(*found, strict=True)]
    return SampleMaps(*maps)


def _sample(network: SplineNet, batch: PixelBatch, count: int) -> SampleMaps:
    maps, dense, normals = _estimate(network, batch)
    truth = dense_truth_in_frame(batch, maps, size=network.config.map_size)
    normal_truth = to_pixel_frame(batch.truth.normals, maps)
    error_deg = angle_between_deg(normals.cpu().numpy(), normal_truth.cpu().numpy())
    step = max(1, len(normals) // count)

    def picture(values: Tensor, known: Tensor) -> NDArray[np.float32]:
        values = values.float().masked_fill(known == 0, torch.nan)
        picked: NDArray[np.float32] = values[::step, 0][:count].cpu().numpy()
        return picked

    return SampleMaps(
        picture(maps.sparse, maps.occupied),
        None if dense is None else picture(dense, network.inside.expand_as(dense)),
        picture(truth.values, truth.filled),
        error_deg[::step][:count].astype(np.float32),
    )


@torch.no_grad()
def _estimate(
    network: SplineNet, batch: PixelBatch, *, bfloat16: bool = False
) -> tuple[PixelMaps, Tensor | None, Tensor]:
    """Return the networks' input, LI-Net's dense maps and NE-Net's normals, in the frames of the pixels."""
    network.eval()
    maps = network.build_maps(batch.observations, batch.light_directions, batch.valid)
    with torch.autocast(batch.observations.device.type, dtype=torch.bfloat16, enabled=bfloat16):
        dense = network.interpolate(maps)
        normals = network.estimate(maps, dense).normals
    return maps, dense, normals
