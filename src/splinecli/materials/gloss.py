"""Estimate the gloss of each pixel, all parameters of the material except the base, with the
material net.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np
import torch

from splinecli.estimate.methods.batched import context_sample, float_tensors
from splinecli.lights.lighting import LightingAt
from splinecli.materials.material_net import Gloss, material_networks
from splinecli.maths import Bools, Float32Array
from splinecli.maths.pixel_grid import on_map, slices
from splinecli.system.machine import one_thread_each, side_by_side

# In larger captures, the net is applied to every second, third, ... row and column
_MOST_PIXELS = 60_000
_BATCH = 1024
_UNKNOWN_ERROR = 10.0  # error of the roughness of a black pixel
_SMOOTH = 2.0  # standard deviation of the smoothing in pixels


def estimate_gloss(mask: Bools, lighting_at: LightingAt) -> Gloss:
    """Return the gloss of the P pixels of a mask (H, W), with `log_level` in the unit of the
    observations.

    Raises ModelError if the weights are damaged.
    """
    network, material_net = material_networks()
    rows, columns = np.nonzero(mask)
    step = max(1, ceil(sqrt(len(rows) / _MOST_PIXELS)))
    chosen = np.flatnonzero((rows % step == 0) & (columns % step == 0))
    if not len(chosen):
        chosen = np.arange(len(rows))
    with torch.inference_mode(), one_thread_each():
        observations, directions = context_sample(lighting_at, mask)
        of_sample, context = network.encode_pixels(observations, directions)
        assert context is not None  # spline-net has a set branch
        _, summary = material_net(of_sample, context.brightness)
    found = np.empty((len(Gloss._fields), len(chosen)), np.float32)

    def estimate(part: slice) -> None:
        light = lighting_at(chosen[part])
        observations, directions = float_tensors(light.observations, light.directions)
        pixels, _ = network.encode_pixels(observations, directions, context=context)
        gloss = material_net(pixels, context.brightness, summary)[0]
        is_black = observations.amax(dim=1) <= 0
        known = gloss._replace(
            roughness_error=torch.where(is_black, _UNKNOWN_ERROR, gloss.roughness_error),
            log_level=gloss.log_level + pixels.scale[:, 0].log(),
        )
        found[:, part] = torch.stack(known).numpy()

    for _ in side_by_side(estimate, slices(len(chosen), _BATCH)):
        pass

    def blurred_from_chosen(values: Float32Array) -> Float32Array:
        of_pixels = np.zeros(len(rows), np.float32)
        of_pixels[chosen] = values
        return blurred(of_pixels, mask, max(_SMOOTH, 0.7 * step))

    weights = found[Gloss._fields.index("roughness_error")] ** np.float32(-2)
    total = blurred_from_chosen(weights)
    reached = total > 1e-6 * weights.max()  # false far from all chosen pixels
    smooth = []
    for values in found:
        usual = np.float32(np.average(values, weights=weights))
        sums = blurred_from_chosen(weights * values)
        smooth.append(
            torch.from_numpy(np.divide(sums, total, out=np.full_like(total, usual), where=reached))
        )
    return Gloss(*smooth)


def blurred(values: Float32Array, mask: Bools, deviation: float) -> Float32Array:
    """Return a Gaussian blur of values (P,) at the pixels of a mask (H, W), with zeros outside."""
    from cv2 import GaussianBlur

    return np.asarray(GaussianBlur(on_map(values, mask), (0, 0), deviation)[mask], np.float32)
