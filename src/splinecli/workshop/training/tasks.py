"""Training data of a run: pixels for LI-Net, NE-Net and the error head, or whole scenes for the
refinement net.

Pixels come from the pixel generator, from pixel sets, or from a mixture.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.errors import InputError, UsageError
from splinecli.estimate.networks.spline_net import PixelMaps, SplineNet
from splinecli.maths.normals import angle_between_deg
from splinecli.workshop.pixel_sets.source import PixelSetSource
from splinecli.workshop.pixel_sets.store import Entry, PixelSet, open_pixel_set
from splinecli.workshop.synthesis import stream_seed
from splinecli.workshop.synthesis.batches import PixelBatch
from splinecli.workshop.synthesis.pixels import PixelGenerator
from splinecli.workshop.training import CAPTURES
from splinecli.workshop.training.config import GENERATOR, TrainingConfig
from splinecli.workshop.training.objective import (
    Losses,
    angles,
    compute_losses,
    dense_truth_in_frame,
    fixed,
    part_of_step,
    to_pixel_frame,
)
from splinecli.workshop.training.refinement import (
    STEPS_PER_CAPTURE,
    CaptureFolder,
    ScenePool,
    refinement_losses,
    stack_maps,
)


class MixedSource:
    """Draws each batch from one of several sources, with probabilities proportional to their
    weights.
    """

    def __init__(
        self,
        sources: Sequence[PixelGenerator | PixelSetSource],
        weights: Sequence[float],
        generator: torch.Generator,
    ) -> None:
        self.sources = tuple(sources)
        self.weights = torch.tensor(weights, dtype=torch.float64)
        self.generator = generator

    def draw(self, pixels: int) -> PixelBatch:
        """Draw a batch of P pixels."""
        weights = self.weights.to(self.generator.device)
        chosen = int(torch.multinomial(weights, 1, generator=self.generator))
        return self.sources[chosen].draw(pixels)


def split_scenes(entries: Sequence[Entry], share: float) -> tuple[list[Entry], list[Entry]]:
    """Split the entries of a set into training and validation entries, scene by scene.

    The scenes whose names have the lowest hashes are used for validation, so the choice of a scene
    hardly depends on the other scenes of the set. A share above 0 selects at least one scene, and
    always leaves one for training.
    """
    scenes = sorted(
        {entry.scene for entry in entries},
        key=lambda scene: hashlib.sha256(scene.encode()).digest(),
    )
    count = max(1, round(share * len(scenes))) if share > 0 and len(scenes) > 1 else 0
    validation = set(scenes[: min(count, len(scenes) - 1)])
    return (
        [entry for entry in entries if entry.scene not in validation],
        [entry for entry in entries if entry.scene in validation],
    )


PixelSource = PixelGenerator | PixelSetSource | MixedSource
# by path, each with its entries for training or for validation
Scenes = dict[str, tuple[PixelSet, list[Entry]]]


@dataclass(frozen=True)
class OpenSets:
    """The pixel sets of a run."""

    # training, validation: the scenes for each purpose. A set with a single scene is validated on
    # its training pixels.
    training: Scenes
    validation: Scenes
    single_scene_sets: tuple[str, ...]  # the paths of these sets

    @property
    def sha256(self) -> dict[str, str]:
        """The checksum of each set, by path."""
        return {name: pixel_set.sha256 for name, (pixel_set, _) in self.training.items()}


def open_sets(config: TrainingConfig) -> OpenSets:
    """Open the pixel sets of a configuration.

    Raises InputError if a pixel set is missing, unfinished or does not match its manifest, or has
    no scene left for training.
    """
    names = [name for name, weight in config.sources.items() if weight > 0 and name != GENERATOR]
    sets = {name: open_pixel_set(Path(name)) for name in names}
    parts = {
        name: split_scenes(pixel_set.entries, config.held_share) for name, pixel_set in sets.items()
    }
    # Two sets may contain the same shape. A shape that one of them uses for validation is not used
    # for training.
    shapes = {entry.sha256["normals"] for _, validation in parts.values() for entry in validation}
    for name, (training, validation) in parts.items():
        kept = [entry for entry in training if entry.sha256["normals"] not in shapes]
        if not kept:
            raise InputError(
                "all scenes of the set are used for validation, here or in another set",
                path=name,
                hint="Name each set once, or set held_share to 0",
            )
        parts[name] = kept, validation
    return OpenSets(
        {name: (sets[name], training) for name, (training, _) in parts.items()},
        {
            name: (sets[name], validation or training)
            for name, (training, validation) in parts.items()
        },
        tuple(name for name, (_, validation) in parts.items() if not validation),
    )


def pixel_source(
    config: TrainingConfig, scenes: Scenes, generator: torch.Generator, *, validates: bool = False
) -> PixelSource:
    """Return the source of a configuration's pixels. Validation pixels all have `usual_lights`
    lights.
    """
    pixels, usual = config.pixels, config.pixels.usual_lights
    if validates:
        pixels = replace(pixels, min_lights=usual, max_lights=usual)
    weights = {name: weight for name, weight in config.sources.items() if weight > 0}
    opened = [
        PixelGenerator(pixels, generator)
        if name == GENERATOR
        else PixelSetSource(*scenes[name], pixels, generator)
        for name in weights
    ]
    return opened[0] if len(opened) == 1 else MixedSource(opened, list(weights.values()), generator)


VALIDATION_PIXELS = 2048
VALIDATION_SCENES = 12
SHOWN_PIXELS = 8

# Random streams of a step. Its shards are numbered from 0. DROPOUT_STREAM is for process 0; the
# streams of the other processes follow.
_BATCH_STREAM, _VALIDATION_STREAM, _POOL_STREAM, DROPOUT_STREAM = (
    2**31,
    2**31 + 1,
    2**31 - 1,
    2**31 + 2,
)


class SampleMaps(NamedTuple):
    """Observation maps of N pixels, NaN in empty cells, and the errors of their normals."""

    sparse: NDArray[np.float32]  # the sparse maps, (N, w, w)
    dense: NDArray[np.float32] | None  # LI-Net's dense maps, (N, w, w); None without a LI-Net
    truth: NDArray[np.float32]  # the true maps with gaps filled, (N, w, w)
    error_deg: NDArray[np.float32]  # (N,)


class PixelTask:
    """Batches of pixels from the sources of a run: `source` for training, and other sources for
    `validation`.
    """

    long_start = ""  # message about the work of `prepare` if it takes minutes

    def __init__(self, config: TrainingConfig, shards: range, device: torch.device) -> None:
        self.config = config
        self.shards = shards
        self.device = device
        self.generator = torch.Generator(device)
        held = torch.Generator(device)
        held.manual_seed(stream_seed(config.seed, 0, _VALIDATION_STREAM))
        self.sets = open_sets(config)
        self.source = pixel_source(config, self.sets.training, self.generator)
        self._held = pixel_source(config, self.sets.validation, held, validates=True)

    def prepare(self, network: SplineNet, folder: Path, *, rank: int, step: int) -> None:
        """Prepare the data of process `rank` for step `step`. Only process 0 validates.

        `folder` is the folder of the run.
        """
        if rank == 0:
            # At least 64 pixels at a time, because a draw has one source
            pixels = min(max(64, self.config.pixels.capture_pixels), VALIDATION_PIXELS)
            self.validation = [self._held.draw(pixels) for _ in range(VALIDATION_PIXELS // pixels)]

    def draw(self, step: int) -> tuple[list[tuple[PixelBatch, Tensor]], bool]:
        """Draw this process's shards of a step's batch.

        Returns the pixels of each shard, their additional rotations in degrees (P,), and whether
        all are mirrored.
        """
        config = self.config
        canonical = config.network.is_canonical
        self.generator.manual_seed(stream_seed(config.seed, step, _BATCH_STREAM))
        mirrored = canonical and bool(
            torch.rand((), generator=self.generator, device=self.device) < 0.5
        )
        jitter_deg = config.turn_jitter_deg if canonical else 0.0
        pixels = config.batch_size // config.shards
        shards = []
        for shard in self.shards:
            self.generator.manual_seed(stream_seed(config.seed, step, shard))
            batch = self.source.draw(pixels)
            turn = 2 * torch.rand(pixels, generator=self.generator, device=self.device) - 1
            shards.append((batch, turn * jitter_deg))
        return shards, mirrored

    def losses(self, network: SplineNet, step: int, *, bfloat16: bool) -> Iterator[Losses]:
        """Yield the losses of each of this process's shards of a step's batch."""
        shards, mirrored = self.draw(step)
        # One shard at a time: its pixels have similar numbers of lights, so little computation is
        # wasted on padding.
        for batch, turn_deg in shards:
            yield compute_losses(
                network,
                batch,
                self.config,
                part=part_of_step(self.config, step),
                turn_deg=turn_deg,
                mirrored=mirrored,
                bfloat16=bfloat16,
            )

    def validation_deg(self, network: SplineNet, *, bfloat16: bool) -> float:
        """Return the mean angular error of the validation pixels, in degrees."""
        found = []
        for batch in self.validation:
            maps, _, normals = _estimate(network, batch, bfloat16=bfloat16)
            found.append(angles(normals, to_pixel_frame(batch.truth.normals, maps)))
        return math.degrees(torch.cat(found).mean().item())

    def sample_maps(self, network: SplineNet) -> SampleMaps:
        """Return the maps of up to SHOWN_PIXELS validation pixels, evenly spaced."""
        shown = self.validation[:: max(1, len(self.validation) // SHOWN_PIXELS)][:SHOWN_PIXELS]
        found = [_sample(network, batch, SHOWN_PIXELS // len(shown)) for batch in shown]
        maps: list[Any] = [
            None if parts[0] is None else np.concatenate(parts)
            for parts in zip(*found, strict=True)
        ]
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
    """Return the networks' input, LI-Net's dense maps and NE-Net's normals, in the pixels'
    frames.
    """
    network.eval()
    maps = network.build_maps(batch.observations, batch.light_directions, batch.valid)
    with torch.autocast(batch.observations.device.type, dtype=torch.bfloat16, enabled=bfloat16):
        dense = network.interpolate(maps)
        normals = network.estimate(maps, dense, captures=batch.captures).normals
    return maps, dense, normals


class RefinementTask:
    """Captures of whole scenes, photographed before and during training; see ScenePool."""

    long_start = "preparing the captures, which may take minutes"

    def __init__(self, config: TrainingConfig, shards: range, device: torch.device) -> None:
        self.config = config
        self.shards = shards
        self.device = device
        self.generator = torch.Generator()
        if config.sources.get(GENERATOR, 0) > 0:
            raise UsageError(
                "the refinement net learns from pixel sets of rendered scenes, and the sources"
                " name the pixel generator",
                hint=(
                    "Run splinecli prepare --scenes 60 -o SET, then splinecli train SET --preset"
                    " refine"
                ),
            )
        self.sets = open_sets(config)

    def prepare(self, network: SplineNet, folder: Path, *, rank: int, step: int) -> None:
        first = self.config.first_captures
        pool = self._pool(
            self.sets.training, network, stream_seed(self.config.seed, rank, _POOL_STREAM)
        )
        # One is added before step 0 and so on.
        count = first - (-step // STEPS_PER_CAPTURE)
        self.captures = CaptureFolder(pool, folder / CAPTURES, count)
        if rank == 0:
            seed = stream_seed(self.config.seed, 0, _VALIDATION_STREAM)
            held = self._pool(self.sets.validation, network, seed)
            self.validation = [
                stack_maps([held.photograph(number)]) for number in range(VALIDATION_SCENES)
            ]

    def _pool(self, scenes: Scenes, network: SplineNet, seed: int) -> ScenePool:
        weighted = [(*scenes[name], self.config.sources[name]) for name in scenes]
        return ScenePool(weighted, network, self.config.pixels, seed)

    def losses(self, network: SplineNet, step: int, *, bfloat16: bool) -> Iterator[Losses]:
        if step % STEPS_PER_CAPTURE == 0:
            self.captures.add()
        missing = torch.full((), torch.nan, device=self.device)
        for shard in self.shards:
            self.generator.manual_seed(stream_seed(self.config.seed, step, shard))
            maps = self.captures.draw(self.config.batch_size // self.config.shards, self.generator)
            with fixed(network, "refine_net"):
                found = refinement_losses(
                    network,
                    maps.to(self.device),
                    detail_weight=self.config.detail_weight,
                    bfloat16=bfloat16,
                )
            yield Losses(found.total, found.angle, missing, missing, missing, missing)

    @torch.no_grad()
    def validation_deg(self, network: SplineNet, *, bfloat16: bool) -> float:
        network.eval()
        found = [
            refinement_losses(network, maps.to(self.device), bfloat16=bfloat16).angle
            for maps in self.validation
        ]
        return math.degrees(float(torch.stack(found).mean()))

    def sample_maps(self, network: SplineNet) -> None:
        return None
