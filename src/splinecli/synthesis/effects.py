"""Effects of the scene on a pixel: walls and ambient light. Each function states the distribution that it draws from.

They depend on the light direction, so they also shape the dense map. The faults of a capture are in faults.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from splinecli.maths.observation_map import dot, rotate_about_view_axis
from splinecli.synthesis.principled import PrincipledMaterial
from splinecli.synthesis.random_numbers import draw_uniform


@dataclass(frozen=True)
class Wall:
    """A surface beside each pixel that hides a sector of low lights and reflects the others.

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
    has_pixel_material: Tensor  # (P, 1) bool, whether the wall has the pixel's material; otherwise it is matte

    def visibility(self, directions: Tensor) -> Tensor:
        """Return the share of each light that passes the wall (P, D): a cast shadow over one sector of the map.

        A direction is hidden where its elevation is under the wall's, l_z < tan(height) l_along, and it falls
        within the wall's width, |l_across| < tan(half width) l_along; the edge is `softness` wide in l_z.
        """
        along = dot(self.azimuth, directions)
        quarter_turn = torch.stack((-self.azimuth[:, 1], self.azimuth[:, 0], self.azimuth[:, 2]), dim=-1)
        across = dot(quarter_turn, directions).abs()
        depth = torch.minimum(self.tan_height * along - directions[..., 2], self.tan_half_width * along - across)
        return 1 - (depth / self.softness).clamp(0, 1)

    def reflected(self, normals: Tensor, material: PrincipledMaterial, directions: Tensor) -> Tensor:
        """Return the radiance (P, D) that light from the wall adds to pixels of these normals (P, 3) and material.

        The reflected light comes from one direction, `towards`. On a metal it makes a highlight. Real walls and
        reflections are wide, so neither may reflect more than three times what matte white would.
        """
        returned = directions.new_zeros(len(normals), directions.shape[-2])
        facing_cosine = -dot(self.facing, self.towards[:, None])
        for same in (False, True):
            pixels = ((self.reflectance[:, 0] > 0) & (self.has_pixel_material[:, 0] == same)).nonzero()[:, 0]
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
            returned[pixels] = leaving.clamp(max=3) * (response.clamp(max=3) * self.reflectance[pixels])
        return returned

    def rotate(self, cosine: Tensor, sine: Tensor) -> Wall:
        """Turn the wall about the view axis."""
        vectors = {"azimuth": self.azimuth, "facing": self.facing, "towards": self.towards}
        return replace(self, **{name: rotate_about_view_axis(each, cosine, sine) for name, each in vectors.items()})


def draw_wall(
    normals: Tensor,
    share: float | Tensor,
    generator: torch.Generator,
    *,
    shadows: bool = True,
    interreflections: bool = True,
) -> Wall:
    """Draw walls for a share of the pixels with these normals (P, 3); a tensor (P, 1) has a share for each.

    azimuth: within N(0, 50 degrees) of the normal's for 60 %, because a surface in a hollow faces a wall; else uniform.
    height: U(8, 75) degrees. half-width: tan U(15, 88) degrees. softness: U(0.01, 0.06).
    facing: the wall leans back by U(0, 60) degrees from upright.
    towards: at U(0.2, 0.9) of the height, where the wall faces the pixel.
    reflectance: (1 - cos(height)) U(0, 1) U(0.5, 2). Half of the walls have the pixel's material. The others are
    matte, with an albedo of U(0.05, 0.9).
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
        # Without shadows the wall lies below every light but still reflects.
        tan_height=height.tan() if shadows else torch.zeros_like(height),
        tan_half_width=half_width.tan(),
        softness=uniform(low=0.01, high=0.06),
        facing=-toward * lean.cos() + up * lean.sin(),
        reflectance=reflectance if interreflections else torch.zeros_like(reflectance),
        towards=toward * elevation.cos() + up * elevation.sin(),
        has_pixel_material=same,
    )


def draw_ambient(pixels: int, share: float, generator: torch.Generator) -> Tensor:
    """Draw ambient light (P, 1), to be scaled by the albedo: 10^U(-3.5, -1.3) for a share of the pixels, else 0."""
    present = draw_uniform(generator, pixels, 1) < share
    return 10 ** draw_uniform(generator, pixels, 1, low=-3.5, high=-1.3) * present
