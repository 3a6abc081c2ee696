"""The online pixel generator: it makes training pixels in batches, on the device of its random generator.

Each pixel has its own normal and walls, and a material of its own or of its capture. It gives its radiance under any
light. A random rig gives the sparse observations, and the directions of all cells give the complete dense map. PX-Net
(Logothetis et al., ICCV 2021) trains a per-pixel network in this way, without rendered objects.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splinecli.maths.observation_map import MAP_SIZE, cell_directions, dot, rotate_about_view_axis
from splinecli.records import Share
from splinecli.synthesis.batches import CaptureConfig, DenseMap, PixelBatch
from splinecli.synthesis.effects import Wall, draw_ambient, draw_wall
from splinecli.synthesis.lights import draw_light_counts, draw_light_directions
from splinecli.synthesis.principled import PrincipledMaterial, choose, draw_material
from splinecli.synthesis.random_numbers import draw_uniform
from splinecli.synthesis.whole_capture import photograph_captures


@dataclass(frozen=True)
class PixelGeneratorConfig(CaptureConfig):
    """Switches and shares of the pixel generator and of its captures. A share of 0 switches an effect off."""

    cast_shadows: bool = True
    interreflections: bool = True
    wall_share: Share = 0.45
    second_wall_share: Share = 0.2
    mixed_share: Share = 0.2


@dataclass(frozen=True)
class PixelScene:
    """P pixels seen from +z. `mixed` is a second surface of the first M pixels: an edge, or a second material."""

    normals: Tensor
    material: PrincipledMaterial
    walls: tuple[Wall, ...]
    ambient: Tensor
    mixed: PixelScene | None = None
    mixed_weight: Tensor | None = None

    def radiance(self, directions: Tensor) -> Tensor:
        """Return the radiance (P, D) under unit lights (D, 3) or (P, D, 3). Matte white that faces its light has 1."""
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
        """Turn each pixel about the view axis by its own angle, given as cosine and sine (P,)."""
        mixed = self.mixed
        if mixed is not None:
            mixed = mixed.rotate(cosine[: len(mixed.normals)], sine[: len(mixed.normals)])
        walls = tuple(wall.rotate(cosine, sine) for wall in self.walls)
        return replace(self, normals=rotate_about_view_axis(self.normals, cosine, sine), walls=walls, mixed=mixed)

    def dense_truth(self, size: int = MAP_SIZE) -> DenseMap:
        """Return the complete maps: radiance at the cells' centres, known in the whole disc."""
        directions, inside = (part.to(self.normals.device) for part in cell_directions(size))
        dense = self.normals.new_zeros(len(self.normals), 1, size, size)
        dense[:, 0, inside] = self.radiance(directions[inside])
        known = inside.to(self.normals).expand_as(dense)
        return DenseMap(dense, known, known)


def draw_visible_normals(pixels: int, generator: torch.Generator) -> Tensor:
    """Draw unit normals (P, 3) towards the camera, uniform by projected area as on the pixels of a sphere."""
    radius = 0.997 * torch.sqrt(torch.rand(pixels, generator=generator, device=generator.device))
    azimuth = 2 * torch.pi * torch.rand(pixels, generator=generator, device=generator.device)
    return torch.stack((radius * azimuth.cos(), radius * azimuth.sin(), (1 - radius**2).sqrt()), dim=-1)


def draw_neighbour_normals(normals: Tensor, generator: torch.Generator) -> Tensor:
    """Draw normals across an edge: add a Gaussian of sigma 0.5 to each and keep it towards the camera."""
    moved = normals + 0.5 * torch.randn(normals.shape, generator=generator, device=normals.device)
    moved = torch.cat((moved[:, :2], moved[:, 2:].abs().clamp(min=0.05)), dim=1)
    return torch.nn.functional.normalize(moved, dim=1)


def draw_scene(pixels: int, config: PixelGeneratorConfig, generator: torch.Generator) -> PixelScene:
    """Draw random pixels. Half of the mixed pixels lie on an edge, with a second normal; half blend two materials.

    Pixel p belongs to capture p % G, see CaptureConfig. The pixels of a capture share their materials, see
    draw_shared_materials, and how many of them have walls: the usual share times U(-0.7, 2.3), none where that is
    negative, as on convex objects.
    """
    normals = draw_visible_normals(pixels, generator)
    if config.capture_pixels == 1:
        material = draw_material(pixels, generator)
        hollow: float | Tensor = 1.0
        ambient_share = config.ambient_share
    else:
        ambient_share = 0.0  # photograph_scene adds what the pixels of a capture share
        captures = config.captures(pixels)
        material = draw_shared_materials(pixels, captures, generator)
        hollow = draw_uniform(generator, captures, 1, low=-0.7, high=2.3).clamp(min=0)
        hollow = hollow.repeat(pixels // captures, 1)
    walls = tuple(
        draw_wall(
            normals, hollow * share, generator, shadows=config.cast_shadows, interreflections=config.interreflections
        )
        for share in (config.wall_share, config.second_wall_share)
        if share > 0 and (config.cast_shadows or config.interreflections)
    )
    ambient = draw_ambient(pixels, ambient_share, generator)
    count = round(config.mixed_share * pixels)
    if not count:
        return PixelScene(normals, material, walls, ambient)
    # Every second mixed pixel is an edge, with one material on two normals. The others have two materials.
    edge = (torch.arange(count, device=normals.device) % 2 == 0)[:, None]
    second = choose(edge, material.take(slice(count)), draw_material(count, generator))
    second_normals = torch.where(edge, draw_neighbour_normals(normals[:count], generator), normals[:count])
    mixed = PixelScene(second_normals, second, (), ambient[:count])
    weight = torch.rand(count, 1, generator=generator, device=normals.device) * torch.where(edge, 0.4, 0.7)
    return PixelScene(normals, material, walls, ambient, mixed, weight)


_MOST_MATERIALS = 8


def draw_shared_materials(pixels: int, captures: int, generator: torch.Generator) -> PrincipledMaterial:
    """Draw the materials of some pixels; pixel p belongs to capture p % captures.

    60 % of the captures have one material, the others 2 to 8. In half, these differ in their base alone, as on a
    painted or printed object of one gloss.
    """
    drawn = draw_material(captures * _MOST_MATERIALS, generator)
    count = 2 + ((_MOST_MATERIALS - 1) * draw_uniform(generator, captures)).long()
    count[draw_uniform(generator, captures) < 0.6] = 1
    size = pixels // captures
    first = _MOST_MATERIALS * torch.arange(captures, device=count.device).repeat(size)
    chosen = first + (count.repeat(size) * draw_uniform(generator, pixels)).long()
    one_gloss = (draw_uniform(generator, captures, 1) < 0.5).repeat(size, 1)
    material = drawn.take(chosen)
    return choose(one_gloss, replace(drawn.take(first), base=material.base), material)


@dataclass(eq=False)
class PixelGenerator:
    """Draws batches of pixels on the device of `generator`, reproducible from its seed."""

    config: PixelGeneratorConfig
    generator: torch.Generator

    def draw(self, pixels: int) -> PixelBatch:
        """Draw a batch of P pixels, a rig for each capture. F is the largest number of lights."""
        config, generator = self.config, self.generator
        captures = config.captures(pixels)
        size = pixels // captures
        scene = draw_scene(pixels, config, generator)
        counts = draw_light_counts(captures, config.min_lights, config.max_lights, config.usual_lights, generator)
        directions = draw_light_directions(captures, int(counts.max()), generator).repeat(size, 1, 1)
        valid = torch.arange(directions.shape[1], device=counts.device) < counts.repeat(size)[:, None]
        return photograph_captures(scene, scene.radiance(directions), directions, valid, config, generator)
