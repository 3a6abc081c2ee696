"""Batches of training pixels, whatever they come from: what a capture would hold of them, and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from splinecli.synthesis.effects import (
    add_sensor_noise,
    disturb_light_directions,
    disturb_light_intensities,
    draw_exposure,
    quantise,
)


@dataclass(frozen=True)
class CaptureConfig:
    """How pixels are photographed: lights from `min_lights` to `max_lights`, 30 % of the pixels under
    `usual_lights`; and the shares of the pixels whose capture has each fault, 0 switches it off.
    """

    min_lights: int = 4
    max_lights: int = 96
    usual_lights: int = 10
    light_direction_error_share: float = 0.5
    light_intensity_error_share: float = 0.5
    saturated_share: float = 0.08
    sensor_noise: bool = True
    eight_bit_share: float = 0.15


class DenseMap(NamedTuple):
    """values (P, 1, w, w); known and filled, of the same shape, are 1 where values are true and where they
    are usable: measured, or interpolated from measured neighbours. Zero elsewhere, as outside the unit disc.
    """

    values: Tensor
    known: Tensor
    filled: Tensor

    def flip_y(self) -> DenseMap:
        """The maps of the mirrored scenes (cells' centres lie symmetrically, so rows are turned over)."""
        return DenseMap(*(cells.flip(2) for cells in self))


class Scene(Protocol):
    """The truth behind P pixels."""

    @property
    def normals(self) -> Tensor:
        """Unit normals (P, 3)."""
        ...

    def rotate(self, cosine: Tensor, sine: Tensor) -> Self:
        """Each pixel turned about the view axis by an angle of its own; cosine and sine (P,)."""
        ...

    def dense_truth(self, size: int) -> DenseMap:
        """The complete maps at the scale of the scene's radiance."""
        ...


@dataclass(frozen=True)
class PixelBatch:
    """What a capture holds of P pixels: observations, valid (bool) (P, F) and light_directions (P, F, 3).

    `scene` is the truth behind them and `exposure` (P, 1) the factor from its radiance to the observations.
    """

    observations: Tensor
    light_directions: Tensor
    valid: Tensor
    scene: Scene
    exposure: Tensor


@dataclass(frozen=True)
class JoinedScene:
    """The pixels of several scenes after one another."""

    parts: tuple[Scene, ...]

    @property
    def normals(self) -> Tensor:
        return torch.cat([part.normals for part in self.parts])

    def rotate(self, cosine: Tensor, sine: Tensor) -> JoinedScene:
        counts = [len(part.normals) for part in self.parts]
        angles = zip(self.parts, torch.split(cosine, counts), torch.split(sine, counts), strict=True)
        return JoinedScene(tuple(part.rotate(c, s) for part, c, s in angles))

    def dense_truth(self, size: int) -> DenseMap:
        maps = zip(*(part.dense_truth(size) for part in self.parts), strict=True)
        return DenseMap(*(torch.cat(cells) for cells in maps))


def join_batches(batches: Sequence[PixelBatch]) -> PixelBatch:
    """One batch of all pixels; those with fewer lights get further ones that are not valid."""
    if len(batches) == 1:
        return batches[0]
    lights = max(batch.valid.shape[1] for batch in batches)

    def join(name: str) -> Tensor:
        fields = [getattr(batch, name) for batch in batches]
        return torch.cat(
            [
                torch.cat(
                    (field, field.new_zeros(len(field), lights - field.shape[1], *field.shape[2:])), dim=1
                )
                for field in fields
            ]
        )

    return PixelBatch(
        join("observations"),
        join("light_directions"),
        join("valid"),
        JoinedScene(tuple(batch.scene for batch in batches)),
        torch.cat([batch.exposure for batch in batches]),
    )


def photograph(
    scene: Scene,
    radiance: Tensor,
    directions: Tensor,
    valid: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
) -> PixelBatch:
    """What a camera and a calibration with faults make of radiance (P, F) under directions (P, F, 3)."""
    radiance = radiance * valid
    exposure = draw_exposure(radiance, config.saturated_share, generator)
    observed = disturb_light_intensities(radiance * exposure, config.light_intensity_error_share, generator)
    observed = observed.clamp(max=1)
    if config.sensor_noise:
        observed = add_sensor_noise(observed, generator)
        observed = quantise(observed, config.eight_bit_share, generator)
    calibrated = disturb_light_directions(directions, config.light_direction_error_share, generator)
    return PixelBatch(observed * valid, calibrated, valid, scene, exposure)
