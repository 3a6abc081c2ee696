"""Each effect against the distribution that its docstring states. Seeds are fixed: nothing here is
left to chance.
"""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from pytest import approx
from scipy import stats
from torch.nn.functional import normalize
from torch.testing import assert_close

from distributions import SHARE, N, assert_uniform, seeded, share
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.observation_map import cell_directions, dot
from splinecli.maths.transfer import decode_transfer
from splinecli.workshop.synthesis.batches import (
    add_sensor_noise,
    disturb_light_directions,
    disturb_light_intensities,
    draw_exposure,
    draw_light_intensities,
    quantise,
    restore,
)
from splinecli.workshop.synthesis.lights import draw_light_counts, draw_light_directions
from splinecli.workshop.synthesis.pixels import (
    PixelScene,
    Wall,
    draw_ambient,
    draw_visible_normals,
    draw_wall,
)
from splinecli.workshop.synthesis.principled import PrincipledMaterial


def test_walls_have_the_stated_shapes():
    wall = draw_wall(draw_visible_normals(N, seeded(1)), 0.4, seeded())
    present = wall.tan_height[:, 0] > 0
    assert share(present) == approx(0.4, abs=SHARE)
    assert_uniform(torch.rad2deg(wall.tan_height[present].atan()), 8, 75)
    assert_uniform(torch.rad2deg(wall.tan_half_width.atan()), 15, 88)
    assert_uniform(wall.softness, 0.01, 0.06)
    assert_uniform(torch.rad2deg(wall.facing[:, 2].asin()), 0, 60)
    # It faces back over the pixel.
    assert ((wall.facing * wall.azimuth).sum(dim=1) < 0).all()
    assert not wall.reflectance[~present].any()
    assert share(wall.has_pixel_material) == approx(0.5, abs=SHARE)
    # What reflects lies on the wall, on the side that faces the pixel.
    along = (wall.towards * wall.azimuth).sum(dim=1)
    assert (wall.towards[present, 2] < wall.tan_height[present, 0] * along[present]).all()
    assert ((wall.facing * wall.towards).sum(dim=1) < 0).all()


def matte(pixels):
    """White, by Lambert's law: an interface without any loss keeps Burley's retro-reflection
    away.
    """
    zero = torch.zeros(pixels, 1)
    plain = {field.name: zero for field in fields(PrincipledMaterial)}
    plain |= {
        "base": zero + 1,
        "roughness": zero + 0.1,
        "interface_loss": zero + 1e-9,
        "minnaert": zero + 1,
    }
    return PrincipledMaterial(**plain | {"tail_exponent": zero + 2, "second_roughness": zero + 1})


def mirror(pixels):
    return replace(
        matte(pixels), metallic=torch.ones(pixels, 1), roughness=torch.full((pixels, 1), 0.2)
    )


def test_matte_walls_reflect_by_the_cosine_law_twice():
    normals = draw_visible_normals(50, seeded(1))
    wall = replace(
        draw_wall(normals, 1.0, seeded()), has_pixel_material=torch.zeros(50, 1, dtype=torch.bool)
    )
    directions, inside = cell_directions()
    cosine = dot(wall.facing, directions[inside]).clamp(min=0)
    arriving = (normals * wall.towards).sum(dim=1, keepdim=True).clamp(min=0)
    expected = wall.reflectance * arriving * cosine
    returned = wall.reflected(normals, matte(50), directions[inside])
    # An interface of no reflectance at normal incidence still mirrors a little at grazing angles.
    steep = normals[:, 2] > 0.5
    assert_close(returned[steep], expected[steep], rtol=0, atol=5e-3)
    assert not wall.reflected(normals, matte(50), -wall.facing[:, None]).any()


def test_a_metal_wall_throws_its_highlight_where_the_metal_shows_it():
    """Light, wall and pixel set up as two mirrors: light comes from the side, by way of the wall,
    to the camera.
    """
    one, half = torch.ones(1, 1), math.sqrt(0.5)
    side, facing = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[-half, 0.0, half]])
    sizes = dict.fromkeys(("tan_height", "tan_half_width", "softness", "reflectance"), one)
    wall = Wall(azimuth=side, towards=side, facing=facing, has_pixel_material=one > 0, **sizes)
    # A wall at 45 degrees sends light from the zenith to the pixel, which faces camera and wall
    # equally.
    mirrored, elsewhere = [0.0, 0.0, 1.0], [-0.6, 0.0, 0.8]
    facing, away = torch.tensor([[half, 0.0, half]]), torch.tensor([[0.2, 0.0, math.sqrt(0.96)]])
    lights = torch.tensor([mirrored, elsewhere])
    seen = wall.reflected(facing, mirror(1), lights)[0]
    assert seen[0] == approx(9)  # both highlights are limited to three times a matte white
    assert seen[1] < 0.5
    assert wall.reflected(away, mirror(1), lights).max() < 0.5


def test_a_known_wall_hides_the_lights_behind_it():
    wall = replace(
        draw_wall(draw_visible_normals(1, seeded()), 1.0, seeded()),
        azimuth=torch.tensor([[0.0, 1.0, 0.0]]),
        tan_height=torch.tensor([[1.0]]),
        tan_half_width=torch.tensor([[math.tan(math.radians(30))]]),
        softness=torch.tensor([[0.01]]),
    )

    def towards(azimuth_deg, elevation_deg):
        a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
        return [math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)]

    # Azimuths from the wall's: 45 degrees high and 30 to either side.
    lights = torch.tensor(
        [
            towards(*a)
            for a in [(0, 40), (0, 50), (25, 20), (35, 20), (-25, 20), (-35, 20), (180, 10)]
        ]
    )
    assert wall.visibility(lights)[0].tolist() == [0, 1, 0, 1, 0, 1, 1]


def test_scattered_light_reaches_beyond_the_terminator():
    tilted = torch.tensor([0.0, 60.0, 90.0, 110.0, 130.0]).deg2rad()
    lights = torch.stack((tilted.sin(), 0 * tilted, tilted.cos()), dim=1)
    up, none = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 1)
    scene = PixelScene(up, matte(1), (), none, none + 0.5)
    beyond = (math.cos(math.radians(110)) + 0.5) / 1.5
    assert scene.radiance(lights)[0].tolist() == approx([1, 2 / 3, 1 / 3, beyond, 0], abs=1e-4)


def test_ambient_light():
    ambient = draw_ambient(N, 0.3, seeded())
    assert ambient.shape == (N, 1) and share(ambient > 0) == approx(0.3, abs=SHARE)
    assert_uniform(ambient[ambient > 0].log10(), -3.5, -1.3)
    assert not draw_ambient(N, 0.0, seeded()).any()


def tilted_lights(pixels, lights):
    directions = torch.randn(pixels, lights, 3, generator=seeded(3))
    directions[..., 2] = directions[..., 2].abs() + 0.5
    return normalize(directions, dim=-1)


def test_errors_of_light_directions():
    directions = tilted_lights(4000, 40)
    moved = disturb_light_directions(directions, 0.6, seeded())
    assert_close(moved.norm(dim=-1), torch.ones(4000, 40))
    assert (moved[..., 2] > 0).all()
    error = angle_between_deg(moved.numpy(), directions.numpy())
    # A pixel's angles have two components of its sigma each: sigma^2 is half of their mean square.
    sigma = np.sqrt((error**2).mean(axis=1) / 2)
    disturbed = sigma > 1e-6
    assert disturbed.mean() == approx(0.6, abs=0.03)
    # Sigma itself is estimated from 80 numbers, to 8 per cent.
    assert stats.kstest(sigma[disturbed], lambda x: (x / 8).clip(0, 1) ** (1 / 3)).statistic < 0.04
    assert 6 < sigma.max() < 10
    np.testing.assert_allclose(
        disturb_light_directions(directions, 0.0, seeded()), directions, atol=1e-6
    )


def test_errors_of_light_intensities():
    observations = torch.rand(4000, 100, generator=seeded(3)) + 0.5
    factor = (disturb_light_intensities(observations, 0.6, seeded()) / observations).numpy()
    sigma = np.sqrt(((factor - 1) ** 2).mean(axis=1))
    disturbed = sigma > 1e-5
    assert disturbed.mean() == approx(0.6, abs=0.03)
    assert stats.kstest(sigma[disturbed], stats.uniform(0, 0.05).cdf).statistic < 0.04
    assert factor[disturbed].mean() == approx(1, abs=1e-3)
    assert torch.equal(disturb_light_intensities(observations, 0.0, seeded()), observations)


def test_exposure():
    radiance = torch.rand(N, 5, generator=seeded(3)) * 30
    brightest = (radiance * draw_exposure(radiance, 0.25, seeded())).amax(dim=1)
    over = brightest > 1
    assert share(over) == approx(0.25, abs=SHARE)
    assert_uniform(brightest[over], 1, 3)
    dark = brightest < 10**-1.3
    # U(-2.7, -0.7) for 40 %: seven tenths of it lie below -1.3.
    assert share(dark[~over]) == approx(0.4 * 0.7, abs=SHARE)
    assert_uniform(brightest[dark].log10(), -2.7, -1.3)
    assert brightest.min() >= 10**-2.7 * 0.999
    assert (radiance * draw_exposure(radiance, 0.0, seeded())).amax(dim=1).max() <= 1 + 1e-6
    assert torch.isfinite(draw_exposure(torch.zeros(3, 5), 0.5, seeded())).all()


def mean_square_of_power(low, high):
    """E[(10^U(low, high))^2]."""
    return (10 ** (2 * high) - 10 ** (2 * low)) / (2 * math.log(10) * (high - low))


@pytest.mark.parametrize("level", [0.5, 0.1])
def test_sensor_noise(level):
    noisy = add_sensor_noise(torch.full((N, 20), level), seeded())
    expected = mean_square_of_power(-4, -2.5) + level * mean_square_of_power(-3.5, -2)
    assert (noisy.double() - level).square().mean().item() == approx(expected, rel=0.05)
    assert noisy.double().mean().item() == approx(level, abs=1e-4)


def is_multiple(values, steps):
    """Whether all values (P, F) of a pixel are multiples of 1 / steps."""
    return ((values * steps - (values * steps).round()).abs() < 1e-6).all(dim=1)


def test_quantisation():
    exposed = torch.rand(N, 8, generator=seeded(3), dtype=torch.float64)
    quantised = quantise(exposed, 0.3, seeded())
    decoded = torch.from_numpy(
        decode_transfer(np.arange(256, dtype=np.float32) / 255, None)
    ).double()
    of_srgb = (quantised[..., None] - decoded).abs().amin(dim=2).amax(dim=1) < 1e-6
    eight = is_multiple(quantised, 255)
    assert share(of_srgb) == approx(0.15, abs=SHARE)
    assert share(eight) == approx(0.15, abs=SHARE)
    error = quantised - exposed
    # The high byte of 16 is up to a step of 255 too dark or, as 256 steps become 255, a little too
    # bright.
    cut = eight & (error.abs().amax(dim=1) > 0.5001 / 255)
    assert 0.06 < share(cut) <= 0.075 + SHARE
    assert (error[cut].mean() * 255).item() == approx(0, abs=0.02)
    assert error[eight & ~cut].abs().max().item() <= 0.5001 / 255
    for bits in (10, 12, 14, 16):
        other = is_multiple(quantised, 2**bits - 1) & ~eight & ~of_srgb
        assert share(other) == approx(0.7 / 4, abs=SHARE)
        assert error[other].abs().max().item() == approx(0.5 / (2**bits - 1), rel=0.01)
    assert (quantise(exposed, 0.0, seeded()) - exposed).abs().max() <= 0.5 / 1023 + 1e-9


def test_light_intensities():
    intensities = draw_light_intensities(N, 10, 0.4, seeded())
    assert intensities.amax(dim=1).sub(1).abs().max() == 0
    unequal = intensities.amin(dim=1) < 1
    assert share(unequal) == approx(0.4, abs=SHARE)
    # The largest of ten of 2^U(-2, 0) is 2^-0.18 on average, so all others are below the range's
    # upper end by that.
    assert intensities.min() >= 0.25
    assert not (draw_light_intensities(N, 10, 0.0, seeded()) != 1).any()


def test_restoring_half_of_the_clipped_pixels():
    lights = tilted_lights(400, 12)
    normals = normalize(torch.randn(400, 3, generator=seeded(5)) * 0.3 + torch.tensor((0, 0, 1)))
    truth = (lights * normals[:, None]).sum(dim=2).clamp(min=0)
    truth = 1.4 * truth / truth.amax(dim=1, keepdim=True)
    valid = torch.arange(12).expand(400, 12) < 10
    clipped = (truth > 1) & valid
    stored = truth.clamp(max=1) * valid
    restored = restore(stored, clipped, lights, valid, seeded())
    changed = (restored != stored).any(dim=1)
    assert share(changed) == approx(0.5, abs=0.08)
    assert not (restored != stored)[~clipped].any()


def draw_rigs(kind, pixels, lights):
    return draw_light_directions(pixels, lights, seeded(0), {kind: 1.0}).double().numpy()


def centred_rigs(kind, pixels, lights):
    points = draw_rigs(kind, pixels, lights)[..., :2]
    return points - points.mean(axis=1, keepdims=True)


def test_half_of_the_draws_have_about_the_usual_number():
    random = seeded(0)
    draws = [draw_light_counts(50, 4, 96, 10, random).numpy() for _ in range(4000)]
    largest = np.array([counts.max() for counts in draws])
    assert largest.min() >= 4
    assert largest.max() >= 90

    def log_uniform(most):
        return math.log((most + 1) / 4) / math.log(97 / 4)

    # Four standard deviations of a share of 4000 are at most 0.03.
    for most in (7, 20, 50):
        expected = 0.5 * log_uniform(most) + 0.5 * (most >= 12)
        assert (largest <= most).mean() == approx(expected, abs=0.035)
    assert all(counts.min() >= np.floor(0.8 * counts.max()) for counts in draws)


def test_rigs_are_ellipses_of_the_stated_axes():
    centred = centred_rigs("ellipse", 1500, 1000)
    # A uniform ellipse has variances of a quarter of its half-axes squared.
    axes = 2 * np.sqrt(np.linalg.eigvalsh(np.einsum("pfi,pfj->pij", centred, centred) / 1000))
    small = axes[:, 1] < math.sin(math.radians(40))  # no rig this small is cut by the rim
    assert small.sum() > 300
    # sin U(20, 88) degrees, seen through an estimate of some per cent: 20 is blurred.
    largest_deg = np.degrees(np.arcsin(axes[small, 1]))
    assert largest_deg.min() > 18.5
    assert stats.kstest(largest_deg, stats.uniform(20, 20).cdf).pvalue > 1e-3
    assert small.mean() == approx(20 / 68, abs=0.05)
    assert (
        stats.kstest(axes[small, 0] / axes[small, 1], stats.uniform(0.5, 0.5).cdf).statistic < 0.07
    )


def test_cones_are_narrow():
    centred = centred_rigs("cone", 500, 400)
    radius_deg = np.degrees(np.arcsin(np.linalg.norm(centred, axis=2).max(axis=1)))
    # The mean of 400 lights is off by some hundredths of the radius.
    assert stats.kstest(radius_deg, stats.uniform(8, 12).cdf).statistic < 0.15
    assert radius_deg.max() < 22


def test_rings_have_one_elevation():
    directions = draw_rigs("ring", 500, 200)
    polar_deg = np.degrees(np.arccos(directions[..., 2]))
    assert stats.kstest(polar_deg.mean(axis=1), stats.uniform(15, 60).cdf).statistic < 0.08
    assert np.median(polar_deg.std(axis=1)) == approx(2, abs=0.15)
    # The mean direction of a whole ring is the view axis. An arc of A has sin(A / 2) / (A / 2) of a
    # ring's radius.
    off_axis = np.linalg.norm(directions[..., :2].mean(axis=1), axis=1) / np.sin(
        np.radians(polar_deg.mean(axis=1))
    )
    assert 0.4 < (off_axis < 0.03).mean() < 0.6
    assert off_axis.max() < math.sin(math.radians(60)) / math.radians(60) + 0.05


def test_lines_lie_nearly_in_a_plane():
    centred = centred_rigs("line", 500, 400)
    across = np.sqrt(np.linalg.eigvalsh(np.einsum("pfi,pfj->pij", centred, centred) / 400)[:, 0])
    assert stats.kstest(np.degrees(np.arcsin(across)), stats.uniform(1, 9).cdf).statistic < 0.1
