"""The sources of training and validation pixels: the pixel generator, pixel sets, and mixtures of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import torch

from splinecli.errors import InputError, UsageError
from splinecli.pixel_sets.source import PixelSetSource
from splinecli.pixel_sets.store import Entry, PixelSet, open_pixel_set
from splinecli.synthesis.batches import PixelBatch
from splinecli.synthesis.pixels import PixelGenerator, PixelGeneratorConfig
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
    """Split entries into training and validation entries, scene by scene.

    The scenes with the lowest hashes of their names are for validation. So the choice for one scene hardly
    depends on the other scenes of the set.

    Args:
        entries: all entries of a set.
        share: share of the scenes that is for validation. Above 0, this is at least one scene, and one is
            always left for training.

    Returns:
        Training entries, validation entries.
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

SceneSource = tuple[tuple[PixelSet, tuple[Entry, ...], float], ...]
"""Pixel sets for the refinement net: of each its scenes for training or validation, and its weight."""

Source = TypeVar("Source", PixelSource, SceneSource)


@dataclass(frozen=True)
class Sources(Generic[Source]):
    """The sources of a run.

    Attributes:
        training, validation: the sources for either; pixels for validation have a generator of their own.
        sets: SHA-256 of each pixel set by path.
        single_scene_sets: the sets without a validation scene, which are validated on their training pixels.
    """

    training: Source
    validation: Source
    sets: dict[str, str]
    single_scene_sets: tuple[str, ...]


def open_sources(
    config: TrainingConfig, generator: torch.Generator, validation_generator: torch.Generator
) -> Sources[PixelSource]:
    """Open the sources of a configuration.

    Validation draws from the validation scenes, under `usual_lights` lights. A set with a single scene has no
    validation scene and is validated on its training pixels.

    Raises:
        InputError: a pixel set is missing, unfinished or does not match its manifest, or has no scene left for
            training.
    """
    weights = {name: weight for name, weight in config.sources.items() if weight > 0}
    sets = {name: open_pixel_set(Path(name)) for name in weights if name != GENERATOR}
    parts = _split_sets(sets, config.held_share)
    usual = config.pixels.usual_lights
    validation_pixels = replace(config.pixels, min_lights=usual, max_lights=usual)

    def open_all(pixels: PixelGeneratorConfig, own: torch.Generator, *, validate: bool) -> PixelSource:
        opened: list[PixelGenerator | PixelSetSource] = []
        for name in weights:
            if name == GENERATOR:
                opened.append(PixelGenerator(pixels, own))
            else:
                training, validation = parts[name]
                entries = validation or training if validate else training
                opened.append(PixelSetSource(sets[name], entries, pixels, own))
        return opened[0] if len(opened) == 1 else MixedSource(opened, list(weights.values()), own)

    return Sources(
        open_all(config.pixels, generator, validate=False),
        open_all(validation_pixels, validation_generator, validate=True),
        {name: pixel_set.sha256 for name, pixel_set in sets.items()},
        tuple(name for name, (_, validation) in parts.items() if not validation),
    )


def open_scenes(config: TrainingConfig) -> Sources[SceneSource]:
    """Open the pixel sets of a configuration as whole scenes.

    Raises:
        UsageError: there are no pixel sets, or the generator is among the sources.
        InputError: as for open_sources.
    """
    if config.sources.get(GENERATOR, 0) > 0:
        raise UsageError(
            "the refinement net learns from pixel sets of rendered scenes, and the sources name the pixel generator",
            hint="Run splinecli prepare --scenes 60 -o SET, then splinecli train SET --preset refine",
        )
    sets = {name: open_pixel_set(Path(name)) for name, weight in config.sources.items() if weight > 0}
    parts = _split_sets(sets, config.held_share)

    def together(validate: bool) -> SceneSource:
        return tuple(
            (sets[name], tuple(validation or training if validate else training), config.sources[name])
            for name, (training, validation) in parts.items()
        )

    return Sources(
        together(False),
        together(True),
        {name: pixel_set.sha256 for name, pixel_set in sets.items()},
        tuple(name for name, (_, validation) in parts.items() if not validation),
    )


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
