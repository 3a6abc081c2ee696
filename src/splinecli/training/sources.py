"""The sources of training and validation pixels: the pixel generator, pixel sets, and mixtures of them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from splinecli.errors import InputError
from splinecli.pixel_sets.source import PixelSetSource
from splinecli.pixel_sets.store import Entry, PixelSet, open_pixel_set
from splinecli.synthesis.batches import PixelBatch
from splinecli.synthesis.pixels import PixelGenerator
from splinecli.training.config import GENERATOR, TrainingConfig


class MixedSource:
    """Draws each batch from one of several sources, with probabilities proportional to their weights."""

    def __init__(
        self, sources: Sequence[PixelGenerator | PixelSetSource], weights: Sequence[float], generator: torch.Generator
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

    The scenes with the lowest hashes of their names are for validation. So the choice for one scene hardly depends on
    the other scenes of the set. A share above 0 gives at least one scene, and one is always left for training.
    """
    scenes = sorted({entry.scene for entry in entries}, key=lambda scene: hashlib.sha256(scene.encode()).digest())
    count = max(1, round(share * len(scenes))) if share > 0 and len(scenes) > 1 else 0
    validation = set(scenes[: min(count, len(scenes) - 1)])
    return (
        [entry for entry in entries if entry.scene not in validation],
        [entry for entry in entries if entry.scene in validation],
    )


PixelSource = PixelGenerator | PixelSetSource | MixedSource
"""Draws batches of pixels. Its random generator determines the batches."""

Scenes = dict[str, tuple[PixelSet, list[Entry]]]
"""By path, the pixel sets of a run, each with its entries for training or for validation."""


@dataclass(frozen=True)
class OpenSets:
    """The pixel sets of a run."""

    # training, validation: the scenes for either. A set with a single scene is validated on its training pixels.
    training: Scenes
    validation: Scenes
    single_scene_sets: tuple[str, ...]  # these sets

    @property
    def sha256(self) -> dict[str, str]:
        """The checksum of each set by path."""
        return {name: pixel_set.sha256 for name, (pixel_set, _) in self.training.items()}


def open_sets(config: TrainingConfig) -> OpenSets:
    """Open the pixel sets of a configuration.

    Raises InputError if a pixel set is missing, unfinished or does not match its manifest, or has no scene left for
    training.
    """
    names = [name for name, weight in config.sources.items() if weight > 0 and name != GENERATOR]
    sets = {name: open_pixel_set(Path(name)) for name in names}
    parts = _split_sets(sets, config.held_share)
    return OpenSets(
        {name: (sets[name], training) for name, (training, _) in parts.items()},
        {name: (sets[name], validation or training) for name, (training, validation) in parts.items()},
        tuple(name for name, (_, validation) in parts.items() if not validation),
    )


def pixel_source(
    config: TrainingConfig, scenes: Scenes, generator: torch.Generator, *, validates: bool = False
) -> PixelSource:
    """Return the source of a configuration's pixels. Validation pixels all have `usual_lights` lights."""
    pixels, usual = config.pixels, config.pixels.usual_lights
    if validates:
        pixels = replace(pixels, min_lights=usual, max_lights=usual)
    weights = {name: weight for name, weight in config.sources.items() if weight > 0}
    opened = [
        PixelGenerator(pixels, generator) if name == GENERATOR else PixelSetSource(*scenes[name], pixels, generator)
        for name in weights
    ]
    return opened[0] if len(opened) == 1 else MixedSource(opened, list(weights.values()), generator)


def _split_sets(sets: dict[str, PixelSet], share: float) -> dict[str, tuple[list[Entry], list[Entry]]]:
    """Return training and validation entries of each set, where no shape is in both.

    Two sets may contain the same shape. A shape that one of them uses for validation is not used for training.
    """
    parts = {name: split_scenes(pixel_set.entries, share) for name, pixel_set in sets.items()}
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
    return parts
