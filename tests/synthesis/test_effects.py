"""Each effect against the distribution that its docstring states. Seeds are fixed: nothing here is left to chance."""

import math
from dataclasses import fields, replace

import pytest
import torch

from distributions import SHARE, N, assert_uniform, generator
from splinecli.maths.observation_map import cell_directions, dot
from splinecli.synthesis.pixels import Wall, draw_ambient, draw_visible_normals, draw_wall
from splinecli.synthesis.principled import PrincipledMaterial


def test_walls_have_the_stated_shapes() -> None:
    normals = draw_visible_normals(N, generator(1))
    wall = draw_wall(normals, 0.4, generator())
    present = wall.tan_height[:, 0] > 0
    assert present.float().mean().item() == pytest.approx(0.4, abs=SHARE)
    assert_uniform(torch.rad2deg(wall.tan_height[present].atan()), 8, 75)
    assert_uniform(torch.rad2deg(wall.tan_half_width.atan()), 15, 88)
    assert_uniform(wall.softness, 0.01, 0.06)
    assert_uniform(torch.rad2deg(wall.facing[:, 2].asin()), 0, 60)
    torch.testing.assert_close(wall.facing.norm(dim=1), torch.ones(N))
    torch.testing.assert_close(wall.azimuth.norm(dim=1), torch.ones(N))
    assert not wall.azimuth[:, 2].any()
    # It faces back over the pixel.
    assert dot(wall.facing, wall.azimuth[:1])[0, 0] < 0
    assert ((wall.facing * wall.azimuth).sum(dim=1) < 0).all()
    assert not wall.reflectance[~present].any()
    assert wall.has_pixel_material.float().mean().item() == pytest.approx(0.5, abs=SHARE)
    # What reflects lies on the wall, on the side that faces the pixel.
    torch.testing.assert_close(wall.towards.norm(dim=1), torch.ones(N))
    along = (wall.towards * wall.azimuth).sum(dim=1)
    assert (wall.towards[present, 2] < wall.tan_height[present, 0] * along[present]).all()
    assert ((wall.facing * wall.towards).sum(dim=1) < 0).all()


def matte(pixels: int) -> PrincipledMaterial:
    """White, by Lambert's law: an interface without any loss keeps Burley's retro-reflection away."""
    zero = torch.zeros(pixels, 1)
    plain = {field.name: zero for field in fields(PrincipledMaterial)}
    plain |= {"base": zero + 1, "roughness": zero + 0.1, "interface_loss": zero + 1e-9, "minnaert": zero + 1}
    return PrincipledMaterial(**plain | {"tail_exponent": zero + 2, "second_roughness": zero + 1})


def mirror(pixels: int) -> PrincipledMaterial:
    return replace(matte(pixels), metallic=torch.ones(pixels, 1), roughness=torch.full((pixels, 1), 0.2))


def test_matte_walls_reflect_by_the_cosine_law_twice() -> None:
    normals = draw_visible_normals(50, generator(1))
    wall = replace(draw_wall(normals, 1.0, generator()), has_pixel_material=torch.zeros(50, 1, dtype=torch.bool))
    directions, inside = cell_directions()
    cosine = dot(wall.facing, directions[inside]).clamp(min=0)
    arriving = (normals * wall.towards).sum(dim=1, keepdim=True).clamp(min=0)
    expected = wall.reflectance * arriving * cosine
    returned = wall.reflected(normals, matte(50), directions[inside])
    # An interface of no reflectance at normal incidence still mirrors a little at grazing angles.
    steep = normals[:, 2] > 0.5
    torch.testing.assert_close(returned[steep], expected[steep], rtol=0, atol=5e-3)
    assert not wall.reflected(normals, matte(50), -wall.facing[:, None]).any()


def test_a_metal_wall_throws_its_highlight_where_the_metal_shows_it() -> None:
    """Light, wall and pixel set up as two mirrors: light comes from the side, by way of the wall, to the camera."""
    one, half = torch.ones(1, 1), math.sqrt(0.5)
    side, facing = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[-half, 0.0, half]])
    sizes = dict.fromkeys(("tan_height", "tan_half_width", "softness", "reflectance"), one)
    wall = Wall(azimuth=side, towards=side, facing=facing, has_pixel_material=one > 0, **sizes)
    # A wall at 45 degrees sends light from the zenith to the pixel, which faces camera and wall equally.
    mirrored, elsewhere = [0.0, 0.0, 1.0], [-0.6, 0.0, 0.8]
    facing, away = torch.tensor([[half, 0.0, half]]), torch.tensor([[0.2, 0.0, math.sqrt(0.96)]])
    lights = torch.tensor([mirrored, elsewhere])
    seen = wall.reflected(facing, mirror(1), lights)[0]
    assert seen[0] == pytest.approx(9)  # both highlights are limited to three times a matte white
    assert seen[1] < 0.5
    assert wall.reflected(away, mirror(1), lights).max() < 0.5


def test_a_known_wall_hides_the_lights_behind_it() -> None:
    wall = replace(
        draw_wall(draw_visible_normals(1, generator()), 1.0, generator()),
        azimuth=torch.tensor([[0.0, 1.0, 0.0]]),
        tan_height=torch.tensor([[1.0]]),
        tan_half_width=torch.tensor([[math.tan(math.radians(30))]]),
        softness=torch.tensor([[0.01]]),
    )

    def towards(azimuth_deg: float, elevation_deg: float) -> list[float]:
        a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
        return [math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)]

    # Azimuths from the wall's: 45 degrees high and 30 to either side.
    lights = torch.tensor(
        [towards(*a) for a in [(0, 40), (0, 50), (25, 20), (35, 20), (-25, 20), (-35, 20), (180, 10)]]
    )
    assert wall.visibility(lights)[0].tolist() == [0, 1, 0, 1, 0, 1, 1]


def test_ambient_light() -> None:
    ambient = draw_ambient(N, 0.3, generator())
    assert ambient.shape == (N, 1) and (ambient > 0).float().mean().item() == pytest.approx(0.3, abs=SHARE)
    assert_uniform(ambient[ambient > 0].log10(), -3.5, -1.3)
    assert not draw_ambient(N, 0.0, generator()).any()
