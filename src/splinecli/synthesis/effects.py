"""What real captures do to a pixel, each effect a function with its distribution stated.

Effects of the scene (walls that shade and reflect, ambient light) are functions of the light direction and so
shape the dense map too; effects of the capture (errors of the lights, the camera) touch the sparse
observations alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splinecli.observation_map import dot, rotate_about_view_axis
from splinecli.synthesis.material import Material


def _uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return torch.rand(*shape, generator=generator, device=generator.device) * (high - low) + low


@dataclass(frozen=True)
class Wall:
    """A neighbouring surface of each pixel, which hides a sector of low lights and reflects the others.

    azimuth (P, 3): unit vector in the image plane towards the wall; tan_height, tan_half_width, softness,
    strength (P, 1); facing (P, 3): the wall's normal; towards (P, 3): unit vector to the part of the wall that
    reflects; same (P, 1) bool: whether it is of the pixel's own material, else it is matte. A pixel without a wall has
    tan_height = strength = 0.
    """

    azimuth: Tensor
    tan_height: Tensor
    tan_half_width: Tensor
    softness: Tensor
    facing: Tensor
    strength: Tensor
    towards: Tensor
    same: Tensor

    def visibility(self, directions: Tensor) -> Tensor:
        """Share of each light that passes the wall (P, D): cast shadow over one connected sector of the map.

        A direction is hidden where its elevation is under the wall's, l_z < tan(height) l_along, and it falls
        within the wall's width, |l_across| < tan(half width) l_along; the edge is `softness` wide in l_z.
        """
        along = dot(self.azimuth, directions)
        quarter_turn = torch.stack((-self.azimuth[:, 1], self.azimuth[:, 0], self.azimuth[:, 2]), dim=-1)
        across = dot(quarter_turn, directions).abs()
        depth = torch.minimum(
            self.tan_height * along - directions[..., 2], self.tan_half_width * along - across
        )
        return 1 - (depth / self.softness).clamp(0, 1)

    def reflected(self, normals: Tensor, material: Material, directions: Tensor) -> Tensor:
        """Radiance (P, D) that pixels of these normals (P, 3) and material show of light thrown back by the wall.

        What the wall throws back comes from one direction, `towards`, and meets the pixel's material from there: on a
        metal it is a highlight of its own. As both are wide in truth, neither reflects more than three times what
        matte white would.
        """
        returned = directions.new_zeros(len(normals), directions.shape[-2])
        facing_cosine = -dot(self.facing, self.towards[:, None])
        for same in (False, True):
            pixels = ((self.strength[:, 0] > 0) & (self.same[:, 0] == same)).nonzero()[:, 0]
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
            returned[pixels] = leaving.clamp(max=3) * (response.clamp(max=3) * self.strength[pixels])
        return returned

    def rotate(self, cosine: Tensor, sine: Tensor) -> Wall:
        """The wall turned about the view axis."""
        return Wall(
            rotate_about_view_axis(self.azimuth, cosine, sine),
            self.tan_height,
            self.tan_half_width,
            self.softness,
            rotate_about_view_axis(self.facing, cosine, sine),
            self.strength,
            rotate_about_view_axis(self.towards, cosine, sine),
            self.same,
        )


def draw_wall(
    normals: Tensor,
    share: float,
    generator: torch.Generator,
    *,
    shadows: bool = True,
    interreflections: bool = True,
) -> Wall:
    """A wall for a `share` of the pixels with these normals (P, 3).

    Azimuth: within N(0, 50 degrees) of the normal's for 60 % (in a hollow the surface looks at the wall that
    faces it), else uniform. Height U(8, 75) degrees; half-width tan U(15, 88) degrees; edge U(0.01, 0.06).
    The wall leans back by U(0, 60) degrees from upright. It reflects from U(0.2, 0.9) of its height, but not from
    where it does not face the pixel, the share (1 - cos(height)) U(0, 1) U(0.5, 2); half of the walls are of the
    pixel's own material, the others matte with albedo U(0.05, 0.9).
    """
    pixels = len(normals)
    spread = torch.randn(pixels, 1, generator=generator, device=generator.device) * math.radians(50)
    facing_it = _uniform(generator, pixels, 1) < 0.6
    own = torch.atan2(normals[:, 1:2], normals[:, 0:1])
    azimuth = torch.where(facing_it, own + spread, _uniform(generator, pixels, 1, high=2 * math.pi))
    present = _uniform(generator, pixels, 1) < share
    height = _uniform(generator, pixels, 1, low=math.radians(8), high=math.radians(75)) * present
    half_width = _uniform(generator, pixels, 1, low=math.radians(15), high=math.radians(88))
    lean = _uniform(generator, pixels, 1, high=math.radians(60))
    toward = torch.cat((azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)), dim=1)
    up = torch.tensor((0.0, 0.0, 1.0), device=normals.device)
    same = _uniform(generator, pixels, 1) < 0.5
    strength = (1 - height.cos()) * _uniform(generator, pixels, 1, low=0.5, high=2.0)
    strength = strength * _uniform(generator, pixels, 1)
    albedo = _uniform(generator, pixels, 1, low=0.05, high=0.9)
    strength = torch.where(same, strength, strength * albedo)
    elevation = height * _uniform(generator, pixels, 1, low=0.2, high=0.9)
    elevation = torch.minimum(elevation, math.radians(85) - lean)
    return Wall(
        azimuth=toward,
        # Without shadows the wall lies below every light, but still reflects.
        tan_height=height.tan() if shadows else torch.zeros_like(height),
        tan_half_width=half_width.tan(),
        softness=_uniform(generator, pixels, 1, low=0.01, high=0.06),
        facing=-toward * lean.cos() + up * lean.sin(),
        strength=strength if interreflections else torch.zeros_like(strength),
        towards=toward * elevation.cos() + up * elevation.sin(),
        same=same,
    )


def draw_ambient(pixels: int, share: float, generator: torch.Generator) -> Tensor:
    """Light from everywhere (P, 1), to be scaled by albedo: 10^U(-3.5, -1.3) for a `share` of pixels, else 0."""
    present = _uniform(generator, pixels, 1) < share
    return 10 ** _uniform(generator, pixels, 1, low=-3.5, high=-1.3) * present


def disturb_light_directions(directions: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Directions as calibrated (P, F, 3): Gaussian errors for a `share` of the pixels.

    Their sigma on either axis is 8 U(0, 1)^3 degrees: 1 degree in the median, more than 4 for a fifth.
    """
    pixels = len(directions)
    sigma = math.radians(8.0) * _uniform(generator, pixels, 1, 1) ** 3
    sigma = sigma * (_uniform(generator, pixels, 1, 1) < share)
    moved = directions + sigma * torch.randn(directions.shape, generator=generator, device=directions.device)
    moved = torch.cat((moved[..., :2], moved[..., 2:].clamp(min=0.01)), dim=-1)
    return torch.nn.functional.normalize(moved, dim=-1)


def disturb_light_intensities(observations: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Each light's strength off by a Gaussian factor, sigma U(0, 5 %), for a `share` of the pixels (P, F)."""
    sigma = _uniform(generator, len(observations), 1, high=0.05) * (
        _uniform(generator, len(observations), 1) < share
    )
    factor = 1 + sigma * torch.randn(observations.shape, generator=generator, device=observations.device)
    return observations * factor.clamp(min=0)


def draw_exposure(radiance: Tensor, saturated_share: float, generator: torch.Generator) -> Tensor:
    """Factor (P, 1) from each pixel's radiance (P, F) to the sensor's range, of which 1 is full scale.

    The brightest observation lies at 10^U(-1.3, 0); for `saturated_share` of the pixels at U(1, 3), to be
    clipped.
    """
    pixels = len(radiance)
    level = 10 ** _uniform(generator, pixels, 1, low=-1.3, high=0.0)
    over = _uniform(generator, pixels, 1, low=1.0, high=3.0)
    level = torch.where(_uniform(generator, pixels, 1) < saturated_share, over, level)
    return level / radiance.amax(dim=1, keepdim=True).clamp(min=1e-6)


def add_sensor_noise(exposed: Tensor, generator: torch.Generator) -> Tensor:
    """Read noise 10^U(-4, -2.5) and shot noise sqrt(I) 10^U(-3.5, -2) of full scale, Gaussian."""
    pixels = len(exposed)
    read = 10 ** _uniform(generator, pixels, 1, low=-4.0, high=-2.5)
    shot = 10 ** _uniform(generator, pixels, 1, low=-3.5, high=-2.0)
    sigma = (read * read + shot * shot * exposed.clamp(min=0)).sqrt()
    noise = torch.randn(exposed.shape, generator=generator, device=exposed.device)
    return (exposed + sigma * noise).clamp(0, 1)


def quantise(exposed: Tensor, eight_bit_share: float, generator: torch.Generator) -> Tensor:
    """Round to 8 bits for a share of the pixels and to 16 bits for the others."""
    eight = _uniform(generator, len(exposed), 1) < eight_bit_share
    steps = torch.where(eight, 255.0, 65535.0).to(exposed.dtype)
    return (exposed * steps).round() / steps
