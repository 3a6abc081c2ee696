"""The gloss of each pixel, from the material net: everything about its material but the base."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
import torch
from torch import Tensor

from splinecli.lights.lighting import LightingAt, PixelIndices
from splinecli.maths import Bools, Float32Array
from splinecli.networks.material_net import Gloss
from splinecli.networks.set_branch import sample_of
from splinecli.networks.weights import material_networks
from splinecli.system.machine import one_thread_each, side_by_side

_MOST_PIXELS = 60_000  # in larger captures, the net is applied to every second, third, ... row and column
_CANDIDATES = 4096  # pixels from which the context of a capture is chosen
_BATCH = 1024
_UNKNOWN_ERROR = 10.0  # of the roughness of a black pixel
_SMOOTH = 2.0  # pixels: standard deviation of the mean over neighbours


@dataclass(frozen=True, eq=False)
class GlossMaps:
    """The gloss of P pixels, each (P,); see networks.material_net.Gloss. `level` is in the unit of the observations."""

    roughness: Float32Array
    roughness_error: Float32Array
    metalness: Float32Array
    level: Float32Array
    minnaert: Float32Array
    tail: Float32Array
    log_base: Float32Array
    log_base_error: Float32Array


def estimate_gloss(mask: Bools, lighting_at: LightingAt) -> GlossMaps:
    """Estimate the gloss of the P pixels of a mask (H, W). Raises ModelError if the weights are damaged."""
    network, material_net = material_networks()
    rows, columns = np.nonzero(mask)
    step = max(1, ceil(sqrt(len(rows) / _MOST_PIXELS)))
    chosen = np.flatnonzero((rows % step == 0) & (columns % step == 0))
    if not len(chosen):
        chosen = np.arange(len(rows))

    def tensors(pixels: PixelIndices) -> tuple[Tensor, ...]:
        light = lighting_at(pixels)
        parts = light.observations, light.directions
        return tuple(torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in parts)

    candidates = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _CANDIDATES)).astype(np.intp)]
    sample = candidates[sample_of(lighting_at(candidates).observations)]
    found = np.empty((len(chosen), len(Gloss._fields)), np.float32)
    with torch.inference_mode(), one_thread_each():
        observations, directions = tensors(sample)
        context = network.encode_context(observations, directions)
        assert context is not None  # spline-net has a set branch
        of_sample, _ = network.encode_pixels(observations, directions, context=context)
        _, summary = material_net(of_sample, context.brightness)

    def estimate(start: int) -> None:
        part = slice(start, start + _BATCH)
        observations, directions = tensors(chosen[part])
        with torch.inference_mode():
            pixels, _ = network.encode_pixels(observations, directions, context=context)
            gloss = material_net(pixels, context.brightness, summary)[0]
            is_black = observations.amax(dim=1) <= 0
            known = gloss._replace(
                roughness_error=torch.where(is_black, _UNKNOWN_ERROR, gloss.roughness_error),
                log_level=gloss.log_level + pixels.scale[:, 0].log(),
            )
            found[part] = torch.stack(known, dim=1).numpy()

    for _ in side_by_side(estimate, range(0, len(chosen), _BATCH)):
        pass
    columns_of = dict(zip(Gloss._fields, found.T, strict=True))
    weights = columns_of["roughness_error"] ** np.float32(-2)
    spread = {name: _spread(values, weights, chosen, mask, step) for name, values in columns_of.items()}
    return GlossMaps(level=np.exp(spread.pop("log_level")), **spread)


def _spread(values: Float32Array, weights: Float32Array, chosen: PixelIndices, mask: Bools, step: int) -> Float32Array:
    """Return the weighted means over the neighbourhoods of all pixels of a mask, from the values of chosen ones."""
    from cv2 import GaussianBlur

    planes = []
    for numbers in (weights, weights * values):
        of_pixels = np.zeros(np.count_nonzero(mask), np.float32)
        of_pixels[chosen] = numbers
        plane = np.zeros(mask.shape, np.float32)
        plane[mask] = of_pixels
        planes.append(GaussianBlur(plane, (0, 0), max(_SMOOTH, 0.7 * step))[mask])
    usual = np.float32(np.average(values, weights=weights))
    return np.divide(planes[1], planes[0], out=np.full_like(planes[0], usual), where=planes[0] > 1e-6 * weights.max())
