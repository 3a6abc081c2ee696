"""Training batches from a pixel set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.maths.observation_map import cell_directions, rotate_about_view_axis, sparse_map
from splinecli.workshop.pixel_sets.store import Entry, PixelSet
from splinecli.workshop.synthesis.batches import CaptureConfig, DenseMap, PixelBatch
from splinecli.workshop.synthesis.lights import rank_in_cone
from splinecli.workshop.synthesis.whole_capture import photograph_captures

FILL_ROUNDS = 3  # each round extends one cell further from the cells with a light


@dataclass(frozen=True)
class SampledPixels:
    """P pixels of a pixel set with their ground truth, under up to F lights each."""

    normals: Tensor  # (P, 3) unit normals
    radiance: Tensor  # (P, F)
    light_directions: Tensor  # (P, F, 3) unit vectors towards the lights
    known: Tensor  # (P, F), False for the padding of pixels with fewer lights

    def rotate(self, cosine: Tensor, sine: Tensor) -> SampledPixels:
        """Rotate each pixel about the view axis by its own angle, given as cosine and sine (P,)."""
        lights = rotate_about_view_axis(self.light_directions, cosine[:, None], sine[:, None])
        return SampledPixels(
            rotate_about_view_axis(self.normals, cosine, sine), self.radiance, lights, self.known
        )

    def dense_truth(self, size: int) -> DenseMap:
        """Return the observation maps (P, 1, size, size) of all lights, with gaps interpolated."""
        sampled = sparse_map(self.radiance, self.light_directions, self.known, size=size)
        inside = cell_directions(size)[1].to(sampled.occupied)
        return fill_gaps(sampled.values, sampled.occupied * inside, inside)


def fill_gaps(values: Tensor, known: Tensor, inside: Tensor) -> DenseMap:
    """Interpolate between known cells. In the result, `known` marks these and `filled` all usable
    cells.

    In each of FILL_ROUNDS rounds, a cell without a value gets the weighted mean of its eight
    neighbours. A cell remains empty if all its neighbours with a value are on one side. Values and
    `known`, 1 in cells with an observation and 0 elsewhere, are (P, 1, w, w); `inside` (w, w) is 1
    in the unit disc, outside of which cells remain empty.
    """
    near = values.new_tensor([[1.0, 2.0, 1.0], [2.0, 0.0, 2.0], [1.0, 2.0, 1.0]])
    across = near * values.new_tensor([-1.0, 0.0, 1.0])
    kernels = torch.stack((near, across, across.T))[:, None]
    filled, weight = values * known, known
    for _ in range(FILL_ROUNDS):
        total, x, y = torch.chunk(torch.nn.functional.conv2d(weight, kernels, padding=1), 3, dim=1)
        mean = torch.nn.functional.conv2d(filled * weight, kernels[:1], padding=1) / total.clamp(
            min=1
        )
        # The centroid of the neighbours with a value is at most half a cell away.
        between = (total > 0) & (torch.hypot(x, y) <= 0.5 * total)
        gap = (weight == 0) & between & (inside > 0)
        filled, weight = (
            torch.where(gap, mean, filled),
            torch.where(gap, torch.ones_like(weight), weight),
        )
    return DenseMap(filled, known, weight)


class PixelSetSource:
    """Draws pixels from entries of a set, all with equal probability, under random lights.

    The lights are drawn within a cone; see choose_in_cone. All pixels of a capture (CaptureConfig)
    come from one entry and have the same lights. Batches are on the device of the generator.
    """

    def __init__(
        self,
        pixel_set: PixelSet,
        entries: Sequence[Entry],
        config: CaptureConfig,
        generator: torch.Generator,
    ) -> None:
        self.pixel_set = pixel_set
        self.entries = tuple(entries)
        self.config = config
        self.generator = generator
        self._counts = torch.tensor([entry.n_pixels for entry in entries])
        self._ends = self._counts.cumsum(0)
        self._observations: dict[int, NDArray[np.floating]] = {}
        self._normals_and_lights: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        self._bytes_read = 0

    def draw(self, pixels: int) -> PixelBatch:
        """Draw a batch of P pixels."""
        truth = self._sample(pixels)
        config, captures = self.config, self.config.captures(pixels)
        counts = config.light_counts(captures, self.generator)
        order, valid = self._choose_lights(truth, counts)
        directions = truth.light_directions.gather(1, order[..., None].expand(*order.shape, 3))
        radiance = truth.radiance.gather(1, order)
        return photograph_captures(truth, radiance, directions, valid, config, self.generator)

    def _choose_lights(self, truth: SampledPixels, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Return light indices (P, K) and a mask of the used ones, for the number of lights per
        capture (G,).
        """
        captures = len(counts)
        rank = rank_in_cone(truth.light_directions[:captures], self.generator)
        order = rank.masked_fill(~truth.known[:captures], torch.inf).argsort(dim=1)[
            :, : int(counts.max())
        ]
        chosen = torch.arange(order.shape[1], device=counts.device) < counts[:, None]
        used = chosen & truth.known[:captures].gather(1, order)
        size = len(truth.known) // captures
        return order.repeat(size, 1), used.repeat(size, 1)

    def _sample(self, pixels: int) -> SampledPixels:
        """Draw pixels and read them with all their lights."""
        device, captures = self.generator.device, self.config.captures(pixels)
        flat = torch.randint(
            int(self._ends[-1]), (captures,), generator=self.generator, device=device
        ).cpu()
        flat = flat.sort().values
        entry_of_pixel = torch.searchsorted(self._ends, flat, right=True)
        if captures < pixels:  # Weight entries by their number of pixels.
            entry_of_pixel = entry_of_pixel.repeat(pixels // captures)
            counts = self._counts[entry_of_pixel]
            place = torch.rand(
                pixels, generator=self.generator, device=device, dtype=torch.float64
            ).cpu()
            flat = self._ends[entry_of_pixel] - counts + (place * counts).long()
        present = entry_of_pixel.bincount().nonzero().flatten().tolist()
        lights = max(self.entries[index].n_lights for index in present)
        radiance = np.zeros((pixels, lights), np.float32)
        directions = np.zeros((pixels, lights, 3), np.float32)
        directions[..., 2] = 1
        known = np.zeros((pixels, lights), np.bool_)
        normals = np.empty((pixels, 3), np.float32)
        for index in present:
            entry = self.entries[index]
            observations, entry_normals, entry_directions = self._arrays(index)
            here = entry_of_pixel == index
            rows = (flat[here] - (self._ends[index] - entry.n_pixels)).numpy()
            here = here.numpy()
            radiance[here, : entry.n_lights] = observations[rows]
            directions[here, : entry.n_lights] = entry_directions
            known[here, : entry.n_lights] = True
            normals[here] = entry_normals[rows]
            # The operating system reads 64 kB when a page is first accessed.
            self._bytes_read += len(rows) * ((64 << 10) + observations[0].nbytes)
        if (
            self._bytes_read > 128 << 20
        ):  # close memory-mapped arrays, so that their pages can be freed
            self._observations, self._bytes_read = {}, 0
        return SampledPixels(
            *(
                torch.from_numpy(array).to(device)
                for array in (normals, radiance, directions, known)
            )
        )

    def _arrays(
        self, index: int
    ) -> tuple[NDArray[np.floating], NDArray[np.float32], NDArray[np.float32]]:
        """Return an entry's observations, which remain on disk, its normals and its light
        directions.
        """
        if index not in self._observations:
            pixels = self.pixel_set.load(self.entries[index])
            self._observations[index] = pixels.observations
            if index not in self._normals_and_lights:
                self._normals_and_lights[index] = (
                    np.array(pixels.normals),
                    np.array(pixels.light_directions),
                )
        return self._observations[index], *self._normals_and_lights[index]
