"""Where training pixels come from: the online generator, pixel sets, and mixtures of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.errors import InputError
from splinecli.observation_map import cell_directions, rotate_about_view_axis, sparse_map
from splinecli.pixel_sets.store import Entry, PixelSet, open_pixel_set
from splinecli.synthesis.batches import CaptureConfig, DenseMap, PixelBatch, join_batches, photograph
from splinecli.synthesis.lights import draw_light_counts
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training.config import GENERATOR, TrainingConfig

FILL_STEPS = 3
"""Gaps of a dense map are interpolated up to so many cells from a light."""

_MAPPED_BYTES = 128 << 20  # mapped pages are let go when about so many bytes of them were touched
_AROUND_BYTES = 64 << 10  # what the system maps around a page that is touched


class PixelSource(Protocol):
    """Draws batches of pixels, reproducible from the seed of its generator."""

    def draw(self, pixels: int) -> PixelBatch:
        """A batch of P pixels."""
        ...


@dataclass(frozen=True)
class SampledScene:
    """P pixels known under F lights each: radiance, known (bool) (P, F), light_directions (P, F, 3)."""

    normals: Tensor
    radiance: Tensor
    light_directions: Tensor
    known: Tensor

    def rotate(self, cosine: Tensor, sine: Tensor) -> SampledScene:
        """The pixels turned about the view axis."""
        lights = rotate_about_view_axis(self.light_directions, cosine[:, None], sine[:, None])
        return SampledScene(
            rotate_about_view_axis(self.normals, cosine, sine), self.radiance, lights, self.known
        )

    def dense_truth(self, size: int) -> DenseMap:
        """The map of all lights, with gaps interpolated."""
        sampled = sparse_map(self.radiance, self.light_directions, self.known, size=size)
        inside = cell_directions(size)[1].to(sampled.holds)
        return fill_gaps(sampled.values, sampled.holds * inside, inside)


def fill_gaps(values: Tensor, known: Tensor, inside: Tensor) -> DenseMap:
    """Interpolate cells without a value that lie between others, from their neighbours, in FILL_STEPS rounds.

    Args:
        values, known: (P, 1, w, w); a value counts where known is 1.
        inside: (w, w), 1 in the unit disc; nothing is filled outside.
    """
    near = values.new_tensor([[1.0, 2.0, 1.0], [2.0, 0.0, 2.0], [1.0, 2.0, 1.0]])
    across = near * values.new_tensor([-1.0, 0.0, 1.0])
    kernels = torch.stack((near, across, across.T))[:, None]
    filled, weight = values * known, known
    for _ in range(FILL_STEPS):
        total, x, y = torch.chunk(torch.nn.functional.conv2d(weight, kernels, padding=1), 3, dim=1)
        mean = torch.nn.functional.conv2d(filled * weight, kernels[:1], padding=1) / total.clamp(min=1)
        # Between its neighbours, not beside them: their middle is at most half a cell away.
        between = (total > 0) & (torch.hypot(x, y) <= 0.5 * total)
        gap = (weight == 0) & between & (inside > 0)
        filled, weight = torch.where(gap, mean, filled), torch.where(gap, torch.ones_like(weight), weight)
    return DenseMap(filled, known, weight)


class PixelSetSource:
    """Pixels of some entries of a set, all pixels alike likely, under lights drawn anew each time.

    The lights of a pixel are drawn, as in CNN-PS (Ikehata, ECCV 2018), from those within a random largest
    angle, U(20, 90) degrees, from the view axis; where those are too few, the closest others join them. The
    capture's faults are those of `config`.
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
        self._ends = torch.tensor([entry.n_pixels for entry in entries]).cumsum(0)
        self._observations: dict[int, NDArray[np.floating]] = {}
        self._small: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        self._touched = 0

    def draw(self, pixels: int) -> PixelBatch:
        """A batch of P pixels."""
        scene = self._read(pixels)
        counts = draw_light_counts(
            pixels, self.config.min_lights, self.config.max_lights, self.config.usual_lights, self.generator
        )
        order, valid = self._choose_lights(scene, counts)
        directions = scene.light_directions.gather(1, order[..., None].expand(*order.shape, 3))
        return photograph(
            scene, scene.radiance.gather(1, order), directions, valid, self.config, self.generator
        )

    def _choose_lights(self, scene: SampledScene, counts: Tensor) -> tuple[Tensor, Tensor]:
        uniform = torch.rand(scene.known.shape, generator=self.generator, device=self.generator.device)
        largest = torch.rand(len(counts), 1, generator=self.generator, device=self.generator.device)
        # As cosines, which fall as the angle grows.
        lowest = torch.deg2rad(20 + 70 * largest).cos()
        z = scene.light_directions[..., 2]
        rank = torch.where(z >= lowest, uniform, 2 - z).masked_fill(~scene.known, torch.inf)
        order = rank.argsort(dim=1)[:, : int(counts.max())]
        chosen = torch.arange(order.shape[1], device=counts.device) < counts[:, None]
        return order, chosen & scene.known.gather(1, order)

    def _read(self, pixels: int) -> SampledScene:
        device = self.generator.device
        flat = torch.randint(int(self._ends[-1]), (pixels,), generator=self.generator, device=device).cpu()
        flat = flat.sort().values
        which = torch.searchsorted(self._ends, flat, right=True)
        present = which.bincount().nonzero().flatten().tolist()
        lights = max(self.entries[index].n_lights for index in present)
        radiance = np.zeros((pixels, lights), np.float32)
        directions = np.zeros((pixels, lights, 3), np.float32)
        directions[..., 2] = 1
        known = np.zeros((pixels, lights), np.bool_)
        normals = np.empty((pixels, 3), np.float32)
        for index in present:
            entry = self.entries[index]
            observations, entry_normals, entry_directions = self._mapped(index)
            here = (which == index).numpy()
            rows = (flat[which == index] - (self._ends[index] - entry.n_pixels)).numpy()
            radiance[here, : entry.n_lights] = observations[rows]
            directions[here, : entry.n_lights] = entry_directions
            known[here, : entry.n_lights] = True
            normals[here] = entry_normals[rows]
            self._touched += len(rows) * (_AROUND_BYTES + observations[0].nbytes)
        if self._touched > _MAPPED_BYTES:
            self._observations, self._touched = {}, 0
        return SampledScene(
            *(torch.from_numpy(array).to(device) for array in (normals, radiance, directions, known))
        )

    def _mapped(self, index: int) -> tuple[NDArray[np.floating], NDArray[np.float32], NDArray[np.float32]]:
        """Observations, which stay on disk, normals and light directions, which are small."""
        if index not in self._observations:
            pixels = self.pixel_set.load(self.entries[index])
            self._observations[index] = pixels.observations
            if index not in self._small:
                self._small[index] = np.array(pixels.normals), np.array(pixels.light_directions)
        return self._observations[index], *self._small[index]


class MixedSource:
    """Each pixel from a source drawn by weight."""

    def __init__(
        self, sources: Sequence[PixelSource], weights: Sequence[float], generator: torch.Generator
    ) -> None:
        self.sources = tuple(sources)
        self.weights = torch.tensor(weights, dtype=torch.float64)
        self.generator = generator

    def draw(self, pixels: int) -> PixelBatch:
        """A batch of P pixels, those of one source together."""
        device = self.generator.device
        chosen = torch.multinomial(
            self.weights.to(device), pixels, replacement=True, generator=self.generator
        )
        counts = chosen.bincount(minlength=len(self.sources)).tolist()
        return join_batches(
            [source.draw(count) for source, count in zip(self.sources, counts, strict=True) if count]
        )


def hold_back(entries: Sequence[Entry], share: float) -> tuple[list[Entry], list[Entry]]:
    """Entries to train on and entries held for validation: a share of the scenes, at least one of two or more.

    The lowest by a hash of their names: whether a scene is held does not depend on the others, as far as the
    share allows.
    """
    scenes = sorted(
        {entry.scene for entry in entries}, key=lambda scene: hashlib.sha256(scene.encode()).digest()
    )
    count = max(1, round(share * len(scenes))) if share > 0 and len(scenes) > 1 else 0
    held = set(scenes[: min(count, len(scenes) - 1)])
    return (
        [entry for entry in entries if entry.scene not in held],
        [entry for entry in entries if entry.scene in held],
    )


@dataclass(frozen=True)
class Sources:
    """What a run trains on, and what it is validated on, each with a generator of its own.

    sets: SHA-256 of the pixel sets by path; unheld: the sets of which nothing could be held back.
    """

    training: PixelSource
    validation: PixelSource
    sets: dict[str, str]
    unheld: tuple[str, ...]


def open_sources(
    config: TrainingConfig, generator: torch.Generator, validation_generator: torch.Generator
) -> Sources:
    """The sources of a configuration; validation uses held scenes, under `usual_lights` lights.

    A set of a single scene has none to hold back and is validated on itself.

    Raises:
        InputError: a pixel set is missing, unfinished or does not match its manifest.
    """
    count = config.pixels.usual_lights
    checked = replace(config.pixels, min_lights=count, max_lights=count)
    training: list[PixelSource] = []
    validation: list[PixelSource] = []
    used_sources = {name: weight for name, weight in config.sources.items() if weight > 0}
    sets = {name: open_pixel_set(Path(name)) for name in used_sources if name != GENERATOR}
    parts = {name: hold_back(pixel_set.entries, config.held_share) for name, pixel_set in sets.items()}
    # The same shape may stand in two sets, or twice in one: it is not trained on where it is held anywhere.
    held_shapes = {entry.sha256["normals"] for _, held in parts.values() for entry in held}
    unheld = []
    for name in used_sources:
        if name == GENERATOR:
            training.append(PixelGenerator(config.pixels, generator))
            validation.append(PixelGenerator(checked, validation_generator))
            continue
        used, held = parts[name]
        used = [entry for entry in used if entry.sha256["normals"] not in held_shapes]
        if not used:
            raise InputError(
                "all its scenes are held back for validation, here or in another set",
                path=name,
                hint="Name each set once, or set held_share to 0",
            )
        if not held:
            unheld.append(name)
        training.append(PixelSetSource(sets[name], used, config.pixels, generator))
        validation.append(PixelSetSource(sets[name], held or used, checked, validation_generator))
    digests = {name: pixel_set.sha256 for name, pixel_set in sets.items()}
    if len(training) == 1:
        return Sources(training[0], validation[0], digests, tuple(unheld))
    weights = list(used_sources.values())
    return Sources(
        MixedSource(training, weights, generator),
        MixedSource(validation, weights, validation_generator),
        digests,
        tuple(unheld),
    )
