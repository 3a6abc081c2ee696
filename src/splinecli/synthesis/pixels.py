"""The online pixel generator: pixels made one by one, in batches, on the device of its random generator.

Each pixel is a scene of its own (normal, material, neighbouring walls, ambient light) that can be asked for
its radiance under any light: under a random rig for the sparse observations, under every cell's direction for
the complete dense map. After PX-Net (Logothetis et al., ICCV 2021), which trains a per-pixel network without
rendered objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splinecli.errors import ModelError
from splinecli.observation_map import MAP_SIZE, cell_directions, dot, rotate_about_view_axis
from splinecli.synthesis.batches import CaptureConfig, DenseMap, PixelBatch, photograph
from splinecli.synthesis.effects import (
    Wall,
    draw_ambient,
    draw_wall,
)
from splinecli.synthesis.lights import draw_light_counts, draw_light_directions
from splinecli.synthesis.material import Material
from splinecli.synthesis.measured import MeasuredLibrary
from splinecli.synthesis.measured_files import read_measured
from splinecli.synthesis.mixed_material import MixedMaterial, choose
from splinecli.synthesis.principled import draw_material


@dataclass(frozen=True)
class PixelGeneratorConfig(CaptureConfig):
    """Switches and shares of the pixel generator (a share of 0 switches an effect off), beside its captures'."""

    cast_shadows: bool = True
    interreflections: bool = True
    wall_share: float = 0.45
    second_wall_share: float = 0.2
    ambient_share: float = 0.5
    mixed_share: float = 0.2
    # Share of the materials that come from a file of measured ones (docs/files-and-frames.md), and its path.
    measured_share: float = 0.0
    measured_materials: str = ""


@dataclass(frozen=True)
class PixelScene:
    """P pixels seen from +z. `mixed` is a second surface of the first M of them (an edge, two materials)."""

    normals: Tensor
    material: Material
    walls: tuple[Wall, ...]
    ambient: Tensor
    mixed: PixelScene | None = None
    mixed_weight: Tensor | None = None

    def radiance(self, directions: Tensor) -> Tensor:
        """Radiance (P, D) under unit lights (D, 3) or (P, D, 3); matte white that faces its light is 1."""
        visible = torch.ones((), device=self.normals.device)
        returned = self.material.albedo() * self.ambient
        for wall in self.walls:
            visible = visible * wall.visibility(directions)
            returned = returned + wall.reflected(self.normals, self.material, directions)
        normal_z = self.normals[:, 2:]
        direct = self.material.shade(dot(self.normals, directions), normal_z, directions[..., 2])
        total = direct * visible + returned
        if self.mixed is not None and self.mixed_weight is not None:
            count = len(self.mixed_weight)
            of_mixed = directions if directions.ndim == 2 else directions[:count]
            second = self.mixed.radiance(of_mixed)
            blended = torch.lerp(total[:count], second, self.mixed_weight)
            total = torch.cat((blended, total[count:]))
        return total

    def rotate(self, cosine: Tensor, sine: Tensor) -> PixelScene:
        """Each pixel's scene turned about the view axis by an angle of its own; cosine and sine (P,)."""
        mixed = self.mixed
        if mixed is not None:
            mixed = mixed.rotate(cosine[: len(mixed.normals)], sine[: len(mixed.normals)])
        return PixelScene(
            rotate_about_view_axis(self.normals, cosine, sine),
            self.material,
            tuple(wall.rotate(cosine, sine) for wall in self.walls),
            self.ambient,
            mixed,
            self.mixed_weight,
        )

    def dense_map(self, size: int = MAP_SIZE) -> Tensor:
        """The complete map (P, 1, size, size): radiance at the cells' centres, zero outside the unit disc."""
        directions, inside = cell_directions(size)
        directions, inside = directions.to(self.normals.device), inside.to(self.normals.device)
        dense = self.normals.new_zeros(len(self.normals), 1, size, size)
        dense[:, 0, inside] = self.radiance(directions[inside])
        return dense

    def dense_truth(self, size: int) -> DenseMap:
        """The complete map, known in the whole disc."""
        _, inside = cell_directions(size)
        known = inside.to(self.normals).expand(len(self.normals), 1, size, size)
        return DenseMap(self.dense_map(size), known, known)


def draw_visible_normals(pixels: int, generator: torch.Generator) -> Tensor:
    """Unit normals (P, 3) towards the camera, uniform by projected area: as a sphere's pixels show them."""
    radius = 0.997 * torch.sqrt(torch.rand(pixels, generator=generator, device=generator.device))
    azimuth = 2 * torch.pi * torch.rand(pixels, generator=generator, device=generator.device)
    return torch.stack((radius * azimuth.cos(), radius * azimuth.sin(), (1 - radius**2).sqrt()), dim=-1)


def draw_neighbour_normals(normals: Tensor, generator: torch.Generator) -> Tensor:
    """Normals across an edge: each moved by a Gaussian of sigma 0.5 and kept towards the camera."""
    moved = normals + 0.5 * torch.randn(normals.shape, generator=generator, device=normals.device)
    moved = torch.cat((moved[:, :2], moved[:, 2:].abs().clamp(min=0.05)), dim=1)
    return torch.nn.functional.normalize(moved, dim=1)


def read_library(config: PixelGeneratorConfig, device: torch.device) -> MeasuredLibrary | None:
    """The measured materials that a configuration asks for; none where their share is 0.

    Raises ModelError where it names no file, InputError where the file cannot be used.
    """
    if not config.measured_share:
        return None
    if not config.measured_materials:
        raise ModelError(
            f"training setting 'measured_share' is {config.measured_share}, but 'measured_materials' names no file",
            hint="Name a file of measured materials there, or set the share to 0",
        )
    return read_measured(config.measured_materials, device)


def draw_reflectance(
    pixels: int, share: float, library: MeasuredLibrary | None, generator: torch.Generator
) -> Material:
    """Random materials, each with probability `share` from the library, else from the principled model."""
    material = draw_material(pixels, generator)
    if library is None or not share:
        return material
    measured = library.draw(pixels, generator)
    kind = (torch.rand(pixels, generator=generator, device=generator.device) < share).long()
    return MixedMaterial((material, measured), kind, torch.arange(pixels, device=kind.device))


def draw_scene(
    pixels: int,
    config: PixelGeneratorConfig,
    generator: torch.Generator,
    library: MeasuredLibrary | None = None,
) -> PixelScene:
    """Random pixels. Of the mixed ones half lie on an edge (a second normal), half blend two materials.

    `library` saves reading the file of measured materials anew. Where their share is 0, no random number is
    drawn for them. Raises ModelError, InputError as read_library.
    """
    library = library or read_library(config, generator.device)
    normals = draw_visible_normals(pixels, generator)
    material = draw_reflectance(pixels, config.measured_share, library, generator)
    walls = tuple(
        draw_wall(
            normals, share, generator, shadows=config.cast_shadows, interreflections=config.interreflections
        )
        for share in (config.wall_share, config.second_wall_share)
        if share > 0 and (config.cast_shadows or config.interreflections)
    )
    ambient = draw_ambient(pixels, config.ambient_share, generator)
    count = round(config.mixed_share * pixels)
    if not count:
        return PixelScene(normals, material, walls, ambient)
    # Every second mixed pixel is an edge, with one material on two normals; the others are two materials.
    edge = (torch.arange(count, device=normals.device) % 2 == 0)[:, None]
    other = draw_reflectance(count, config.measured_share, library, generator)
    second = choose(edge, material.take(slice(count)), other)
    second_normals = torch.where(edge, draw_neighbour_normals(normals[:count], generator), normals[:count])
    mixed = PixelScene(second_normals, second, (), ambient[:count])
    weight = torch.rand(count, 1, generator=generator, device=normals.device) * torch.where(edge, 0.4, 0.7)
    return PixelScene(normals, material, walls, ambient, mixed, weight)


class PixelGenerator:
    """Draws batches of pixels; reproducible from the seed of `generator`, on whose device all is made."""

    def __init__(self, config: PixelGeneratorConfig, generator: torch.Generator) -> None:
        """Read the measured materials, if any. Raises ModelError, InputError."""
        self.config = config
        self.generator = generator
        self.library = read_library(config, generator.device)

    def draw(self, pixels: int) -> PixelBatch:
        """A batch of P pixels, each with lights of its own number and spread; F is the largest number."""
        config, generator = self.config, self.generator
        scene = draw_scene(pixels, config, generator, self.library)
        counts = draw_light_counts(
            pixels, config.min_lights, config.max_lights, config.usual_lights, generator
        )
        true_directions = draw_light_directions(pixels, int(counts.max()), generator)
        valid = torch.arange(true_directions.shape[1], device=counts.device) < counts[:, None]
        return photograph(scene, scene.radiance(true_directions), true_directions, valid, config, generator)
