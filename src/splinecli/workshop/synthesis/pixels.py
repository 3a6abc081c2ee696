"""The online pixel generator, which creates batches of training pixels on the device of its
generator.

Each pixel has its own normal and walls, and either its own material or one shared by its capture.
Its radiance can be computed under any light: a random rig gives the sparse observations, and the
directions of all cells give the complete dense map. PX-Net (Logothetis et al., ICCV 2021) trains a
per-pixel network in this way, without rendered objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from splinecli.maths.observation_map import MAP_SIZE, cell_directions, dot, rotate_about_view_axis
from splinecli.records.base import Share
from splinecli.workshop.synthesis import draw_uniform
from splinecli.workshop.synthesis.batches import CaptureConfig, DenseMap, PixelBatch
from splinecli.workshop.synthesis.draw_materials import choose, draw_material
from splinecli.workshop.synthesis.lights import draw_light_directions
from splinecli.workshop.synthesis.principled import PrincipledMaterial
from splinecli.workshop.synthesis.whole_capture import photograph_captures


@dataclass(frozen=True)
class Wall:
    """A surface next to each pixel that blocks a sector of low lights and reflects the others.

    A pixel without a wall has tan_height = reflectance = 0.
    """

    azimuth: Tensor  # (P, 3), unit vector in the image plane towards the wall
    # tan_height, tan_half_width: (P, 1), tangents of the wall's elevation and of half its width
    tan_height: Tensor
    tan_half_width: Tensor
    softness: Tensor  # (P, 1), width of the shadow's edge in l_z
    facing: Tensor  # (P, 3), the wall's normal
    reflectance: Tensor  # (P, 1), share of the light on the wall that reaches the pixel
    towards: Tensor  # (P, 3), unit vector to the part of the wall that reflects
    # (P, 1) bool, whether the wall has the pixel's material; otherwise it is matte
    has_pixel_material: Tensor

    def visibility(self, directions: Tensor) -> Tensor:
        """Return the share of each light that passes the wall (P, D), a cast shadow over a sector
        of the map.

        A direction is blocked if its elevation is below the top of the wall, l_z < tan(height)
        l_along, and if it is within the width of the wall, |l_across| < tan(half width) l_along.
        The edge of the shadow is `softness` wide in l_z.
        """
        along = dot(self.azimuth, directions)
        quarter_turn = torch.stack(
            (-self.azimuth[:, 1], self.azimuth[:, 0], self.azimuth[:, 2]), dim=-1
        )
        across = dot(quarter_turn, directions).abs()
        depth = torch.minimum(
            self.tan_height * along - directions[..., 2], self.tan_half_width * along - across
        )
        return 1 - (depth / self.softness).clamp(0, 1)

    def reflected(
        self, normals: Tensor, material: PrincipledMaterial, directions: Tensor
    ) -> Tensor:
        """Return the radiance (P, D) that the wall adds to pixels with these normals (P, 3) and
        material.

        The reflected light comes from one direction, `towards`, and causes a highlight on metal.
        Since real walls and reflections are extended, it is limited to three times the reflection
        of a matte white surface.
        """
        returned = directions.new_zeros(len(normals), directions.shape[-2])
        facing_cosine = -dot(self.facing, self.towards[:, None])
        for same in (False, True):
            pixels = (
                (self.reflectance[:, 0] > 0) & (self.has_pixel_material[:, 0] == same)
            ).nonzero()[:, 0]
            if not len(pixels):
                continue
            lights = directions if directions.ndim == 2 else directions[pixels]
            facing, towards = self.facing[pixels], self.towards[pixels]
            incident = dot(facing, lights)
            own = material.take(pixels)
            if same:
                leaving = own.shade(incident, facing_cosine[pixels], -dot(towards, lights))
            else:
                leaving = incident.clamp(min=0)
            seen = normals[pixels]
            response = own.shade(dot(seen, towards[:, None]), seen[:, 2:], towards[:, 2:])
            returned[pixels] = leaving.clamp(max=3) * (
                response.clamp(max=3) * self.reflectance[pixels]
            )
        return returned

    def rotate(self, cosine: Tensor, sine: Tensor) -> Wall:
        """Rotate the wall about the view axis."""
        vectors = {"azimuth": self.azimuth, "facing": self.facing, "towards": self.towards}
        return replace(
            self,
            **{name: rotate_about_view_axis(each, cosine, sine) for name, each in vectors.items()},
        )


def draw_wall(
    normals: Tensor,
    share: float | Tensor,
    generator: torch.Generator,
    *,
    shadows: bool = True,
    interreflections: bool = True,
) -> Wall:
    """Draw walls for a share of the pixels with these normals (P, 3); a tensor (P, 1) gives a share
    per pixel.

    azimuth: N(0, 50 degrees) from the normal's for 60 %, because a surface in a hollow faces a
    wall; else uniform. height: U(8, 75) degrees. half-width: tan U(15, 88) degrees. softness:
    U(0.01, 0.06). facing: the wall leans back by U(0, 60) degrees from upright.
    towards: at U(0.2, 0.9) of the height, on the side that faces the pixel.
    reflectance: (1 - cos(height)) U(0, 1) U(0.5, 2). Half of the walls have the pixel's material.
    The others are matte, with an albedo of U(0.05, 0.9).
    """
    pixels = len(normals)
    uniform = partial(draw_uniform, generator, pixels, 1)
    spread = torch.randn(pixels, 1, generator=generator, device=generator.device) * math.radians(50)
    facing_it = uniform() < 0.6
    own = torch.atan2(normals[:, 1:2], normals[:, 0:1])
    azimuth = torch.where(facing_it, own + spread, uniform(high=2 * math.pi))
    present = uniform() < share
    height = uniform(low=math.radians(8), high=math.radians(75)) * present
    half_width = uniform(low=math.radians(15), high=math.radians(88))
    lean = uniform(high=math.radians(60))
    toward = torch.cat((azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)), dim=1)
    up = torch.tensor((0.0, 0.0, 1.0), device=normals.device)
    same = uniform() < 0.5
    reflectance = (1 - height.cos()) * uniform(low=0.5, high=2.0) * uniform()
    reflectance = torch.where(same, reflectance, reflectance * uniform(low=0.05, high=0.9))
    elevation = torch.minimum(height * uniform(low=0.2, high=0.9), math.radians(85) - lean)
    return Wall(
        azimuth=toward,
        # Without shadows the wall is lower than every light but still reflects.
        tan_height=height.tan() if shadows else torch.zeros_like(height),
        tan_half_width=half_width.tan(),
        softness=uniform(low=0.01, high=0.06),
        facing=-toward * lean.cos() + up * lean.sin(),
        reflectance=reflectance if interreflections else torch.zeros_like(reflectance),
        towards=toward * elevation.cos() + up * elevation.sin(),
        has_pixel_material=same,
    )


def draw_ambient(pixels: int, share: float, generator: torch.Generator) -> Tensor:
    """Draw ambient light (P, 1), to be scaled by the albedo.

    It is 10^U(-3.5, -1.3) for a share of the pixels, and 0 for the others.
    """
    present = draw_uniform(generator, pixels, 1) < share
    return 10 ** draw_uniform(generator, pixels, 1, low=-3.5, high=-1.3) * present


@dataclass(frozen=True)
class PixelGeneratorConfig(CaptureConfig):
    """Switches and shares of the pixel generator and its captures.
    A share of 0 disables an effect.
    """

    cast_shadows: bool = True
    interreflections: bool = True
    wall_share: Share = 0.45
    second_wall_share: Share = 0.2
    mixed_share: Share = 0.2
    translucent_share: Share = 0.15
    flat_share: Share = 0.25  # captures of a nearly flat surface, such as a coin or a painting


@dataclass(frozen=True)
class PixelScene:
    """P pixels viewed from +z. `mixed` is a second surface in the first M pixels: an edge, or a
    second material.
    """

    normals: Tensor
    material: PrincipledMaterial
    walls: tuple[Wall, ...]
    ambient: Tensor
    # (P, 1), how far light that scatters below the surface reaches beyond the terminator, in n.l;
    # 0 for opaque materials
    wrap: Tensor
    mixed: PixelScene | None = None
    mixed_weight: Tensor | None = None

    def radiance(self, directions: Tensor) -> Tensor:
        """Return the radiance (P, D) under unit lights (D, 3) or (P, D, 3). Matte white facing the
        light gives 1.

        Scattered light changes the cosine n.l of a matte surface to (n.l + wrap) / (1 + wrap), and
        a share `wrap` of the change also reaches pixels behind walls.
        """
        visible = torch.ones((), device=self.normals.device)
        returned = self.material.albedo() * self.ambient
        for wall in self.walls:
            visible = visible * wall.visibility(directions)
            returned = returned + wall.reflected(self.normals, self.material, directions)
        normal_z = self.normals[:, 2:]
        cosine = dot(self.normals, directions)
        direct = self.material.shade(cosine, normal_z, directions[..., 2])
        wrapped = ((cosine + self.wrap) / (1 + self.wrap)).clamp(min=0) - cosine.clamp(min=0)
        scattered = self.material.base * (1 - self.material.metallic) * wrapped
        reached = self.wrap + (1 - self.wrap) * visible
        total = direct * visible + scattered * reached + returned
        if self.mixed is not None and self.mixed_weight is not None:
            count = len(self.mixed_weight)
            of_mixed = directions if directions.ndim == 2 else directions[:count]
            second = self.mixed.radiance(of_mixed)
            blended = torch.lerp(total[:count], second, self.mixed_weight)
            total = torch.cat((blended, total[count:]))
        return total

    def rotate(self, cosine: Tensor, sine: Tensor) -> PixelScene:
        """Rotate each pixel about the view axis by its own angle, given as cosine and sine (P,)."""
        mixed = self.mixed
        if mixed is not None:
            mixed = mixed.rotate(cosine[: len(mixed.normals)], sine[: len(mixed.normals)])
        walls = tuple(wall.rotate(cosine, sine) for wall in self.walls)
        return replace(
            self,
            normals=rotate_about_view_axis(self.normals, cosine, sine),
            walls=walls,
            mixed=mixed,
        )

    def dense_truth(self, size: int = MAP_SIZE) -> DenseMap:
        """Return the complete maps: radiance at the cell centres, known in the whole disc."""
        directions, inside = (part.to(self.normals.device) for part in cell_directions(size))
        dense = self.normals.new_zeros(len(self.normals), 1, size, size)
        dense[:, 0, inside] = self.radiance(directions[inside])
        known = inside.to(self.normals).expand_as(dense)
        return DenseMap(dense, known, known)


def draw_visible_normals(pixels: int, generator: torch.Generator) -> Tensor:
    """Draw unit normals (P, 3) towards the camera, uniform by projected area, as for the pixels of
    a sphere.
    """
    radius = 0.997 * torch.sqrt(torch.rand(pixels, generator=generator, device=generator.device))
    azimuth = 2 * torch.pi * torch.rand(pixels, generator=generator, device=generator.device)
    return torch.stack(
        (radius * azimuth.cos(), radius * azimuth.sin(), (1 - radius**2).sqrt()), dim=-1
    )


def draw_flat_normals(pixels: int, captures: int, generator: torch.Generator) -> Tensor:
    """Draw the unit normals (P, 3) of a nearly flat surface for each capture; pixel p belongs to
    capture p % captures.

    Each surface is tilted by a slope of 0.7 U(0, 1)^(1/2) in a random direction. The slopes of its
    detail are Gaussian, with a sigma of 10^U(-1.7, -0.4).
    """
    uniform = partial(draw_uniform, generator, captures, 1)
    azimuth, slope = uniform(high=2 * math.pi), 0.7 * uniform().sqrt()
    tilt = torch.cat((azimuth.cos(), azimuth.sin()), dim=1) * slope
    sigma = 10 ** uniform(low=-1.7, high=-0.4)
    detail = torch.randn(pixels, 2, generator=generator, device=generator.device)
    own = torch.cat((tilt, sigma), dim=1).repeat(pixels // captures, 1)
    slopes = own[:, :2] + own[:, 2:] * detail
    upright = torch.nn.functional.pad(slopes, (0, 1), value=1.0)
    return torch.nn.functional.normalize(upright, dim=1)


def draw_scene(pixels: int, config: PixelGeneratorConfig, generator: torch.Generator) -> PixelScene:
    """Draw random pixels. Half of the mixed pixels are on an edge, with a second normal; half blend
    two materials.

    Pixel p belongs to capture p % G (CaptureConfig). All pixels of a capture share their materials
    (draw_shared_materials) and the probability of a wall: the usual share times U(-0.7, 2.3), or
    zero if that is negative, as on convex objects. `translucent_share` of the captures scatter
    light as wax or marble, with a wrap of U(0, 1)^2. `flat_share` of the captures are of a nearly
    flat surface (draw_flat_normals).
    """
    normals = draw_visible_normals(pixels, generator)
    captures = config.captures(pixels)
    if config.capture_pixels == 1:
        material = draw_material(pixels, generator)
        hollow: float | Tensor = 1.0
        ambient_share = config.ambient_share
    else:
        # photograph_scene adds the ambient light that all pixels of a capture share
        ambient_share = 0.0
        material = draw_shared_materials(pixels, captures, generator)
        hollow = draw_uniform(generator, captures, 1, low=-0.7, high=2.3).clamp(min=0)
        hollow = hollow.repeat(pixels // captures, 1)
        flat = draw_uniform(generator, captures, 1) < config.flat_share
        normals = torch.where(
            flat.repeat(pixels // captures, 1),
            draw_flat_normals(pixels, captures, generator),
            normals,
        )
    walls = tuple(
        draw_wall(
            normals,
            hollow * share,
            generator,
            shadows=config.cast_shadows,
            interreflections=config.interreflections,
        )
        for share in (config.wall_share, config.second_wall_share)
        if share > 0 and (config.cast_shadows or config.interreflections)
    )
    ambient = draw_ambient(pixels, ambient_share, generator)
    wrap = draw_uniform(generator, captures, 1) ** 2
    translucent = draw_uniform(generator, captures, 1) < config.translucent_share
    wrap = (wrap * translucent).repeat(pixels // captures, 1)
    count = round(config.mixed_share * pixels)
    if not count:
        return PixelScene(normals, material, walls, ambient, wrap)
    # Every second mixed pixel is an edge, with one material on two normals. The others have two
    # materials.
    edge = (torch.arange(count, device=normals.device) % 2 == 0)[:, None]
    second = choose(edge, material.take(slice(count)), draw_material(count, generator))
    # Across an edge, a Gaussian of sigma 0.5 is added to the normal, which stays towards the
    # camera.
    moved = normals[:count] + 0.5 * torch.randn(
        (count, 3), generator=generator, device=normals.device
    )
    moved = torch.cat((moved[:, :2], moved[:, 2:].abs().clamp(min=0.05)), dim=1)
    second_normals = torch.where(edge, torch.nn.functional.normalize(moved, dim=1), normals[:count])
    mixed = PixelScene(second_normals, second, (), ambient[:count], wrap[:count])
    weight = torch.rand(count, 1, generator=generator, device=normals.device) * torch.where(
        edge, 0.4, 0.7
    )
    return PixelScene(normals, material, walls, ambient, wrap, mixed, weight)


def draw_shared_materials(
    pixels: int, captures: int, generator: torch.Generator
) -> PrincipledMaterial:
    """Draw the materials of some pixels; pixel p belongs to capture p % captures.

    60 % of the captures have one material, the others 2 to 8. In half of the captures, the
    materials differ only in their base colour, as on a painted or printed object of uniform gloss.
    """
    drawn = draw_material(captures * 8, generator)
    count = 2 + (7 * draw_uniform(generator, captures)).long()
    count[draw_uniform(generator, captures) < 0.6] = 1
    size = pixels // captures
    first = 8 * torch.arange(captures, device=count.device).repeat(size)
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
        counts = config.light_counts(captures, generator)
        directions = draw_light_directions(captures, int(counts.max()), generator).repeat(
            size, 1, 1
        )
        valid = (
            torch.arange(directions.shape[1], device=counts.device) < counts.repeat(size)[:, None]
        )
        return photograph_captures(
            scene, scene.radiance(directions), directions, valid, config, generator
        )
