"""How sharp the images of a capture are: what the lens, the sensor and its interpolation left of the steps in them.

The refinement nets must raise detail that the camera has softened, and leave alone what is soft by itself. Normals do
not show the difference where a surface is smooth. The images do: shadows and highlights have sharp edges on any
surface.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_MOST_LIGHTS = 12  # more images say hardly more
_STEEP_SHARE = 0.03  # share of the local maxima of the gradient that count as edges
_FEWEST_EDGES = 20


def image_sharpness(mask: NDArray[np.bool_], observations: NDArray[np.floating]) -> Tensor:
    """Return two numbers (2,), each about -2 to 2, from the observations (P, F) of the true pixels of a mask (H, W).

    The first is the median, over the steepest local maxima of the gradient along rows and columns, of the share that
    the maximum has in the sum with its two neighbours: 1 for a step between two pixels, 0.58 behind a Gaussian with a
    sigma of 0.7 pixels. The second is the correlation of gradients of neighbouring pixels between different images,
    which noise does not change. Both are shifted and scaled; zero where the capture has no edges.
    """
    chosen = observations[:, :: -(-observations.shape[1] // _MOST_LIGHTS)]
    images = np.zeros((chosen.shape[1], *mask.shape), np.float32)
    level = float(np.quantile(chosen, 0.95))
    images[:, mask] = (chosen.T / max(level, 1e-12)).clip(max=1)
    peaks, above, below = [], 0.0, 0.0
    for axis in (1, 2):
        lines, inside = np.moveaxis(images, axis, 2), np.moveaxis(mask, axis - 1, 1)
        steps = np.diff(lines, axis=2) * (inside[:, 1:] & inside[:, :-1])
        before, middle, after = steps[..., :-2], steps[..., 1:-1], steps[..., 2:]
        size = np.abs(middle)
        whole = (inside[:, 3:] & inside[:, 2:-1] & inside[:, 1:-2] & inside[:, :-3])[None]
        is_peak = whole & (size >= np.abs(before)) & (size >= np.abs(after)) & (size > 0)
        rising = np.sign(middle)
        around = size + np.maximum(rising * before, 0) + np.maximum(rising * after, 0)
        peaks.append(np.stack((size[is_peak], size[is_peak] / around[is_peak])))
        triples = inside[:, 2:] & inside[:, 1:-1] & inside[:, :-2]
        one, other = steps[..., 1:] * triples, steps[..., :-1] * triples
        above += _between_images(one, other)
        below += (_between_images(one, one) + _between_images(other, other)) / 2
    sizes, shares = np.concatenate(peaks, axis=1)
    if len(sizes) < _FEWEST_EDGES:
        return torch.zeros(2)
    correlation = above / below if below > 0 else 0.5  # edges in different places
    share = float(np.median(shares[sizes >= np.quantile(sizes, 1 - _STEEP_SHARE)]))
    return torch.tensor((5 * (share - 0.6), 2 * (correlation - 0.5))).clamp(-2, 2)


def _between_images(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the sum of products of values (F, H, W) over all pairs of different images."""
    return float((one.sum(axis=0) * other.sum(axis=0) - (one * other).sum(axis=0)).sum())
