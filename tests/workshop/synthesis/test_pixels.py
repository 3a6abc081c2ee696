"""The pixel generator: scenes that turn as a whole, and batches that a capture could hold."""

from dataclasses import replace

import numpy as np
import torch
from pytest import approx
from scipy import stats
from torch.testing import assert_close

from distributions import FAULTLESS, seeded
from scenes import parametrize
from splinecli.maths.observation_map import cell_directions
from splinecli.workshop.synthesis.pixels import (
    PixelGenerator,
    PixelGeneratorConfig,
    draw_scene,
    draw_visible_normals,
)

PLAIN = PixelGeneratorConfig(**FAULTLESS)
SHARES = "wall_share second_wall_share ambient_share mixed_share translucent_share"
NOTHING = replace(PLAIN, **dict.fromkeys(SHARES.split(), 0.0))


def draw(pixels, config=None, seed=0):
    return PixelGenerator(config or PixelGeneratorConfig(), seeded(seed)).draw(pixels)


def test_batches_hold_what_a_capture_would():
    batch = draw(4000)
    pixels, lights = batch.observations.shape
    assert pixels == 4000
    assert batch.light_directions.shape == (pixels, lights, 3)
    assert batch.exposure.shape == (pixels, 1)
    assert batch.valid.shape == (pixels, lights)
    assert batch.valid.dtype == torch.bool
    counts = batch.valid.sum(dim=1)
    assert counts.max() == lights <= 96
    # The numbers of one draw differ by a fifth.
    assert 4 <= counts.min() >= 0.8 * lights - 1
    assert batch.light_directions.norm(dim=-1).sub(1).abs().max() < 1e-5
    assert (batch.light_directions[..., 2] > 0).all()
    assert torch.isfinite(batch.observations).all()
    assert batch.observations.min() >= 0
    assert not batch.observations[~batch.valid].any()
    # A pixel that none of its few, low lights reaches happens, but not often.
    assert (batch.observations.amax(dim=1) == 0).float().mean() < 0.02


@parametrize("config", [PixelGeneratorConfig(), PixelGeneratorConfig(mixed_share=1.0)])
def test_each_pixel_is_turned_by_its_own_angle(config):
    scene = draw_scene(100, config, seeded(0))
    angle = 2 * torch.pi * torch.rand(100, generator=seeded(1))
    turned = scene.rotate(angle.cos(), angle.sin())
    # Turning scene and lights together changes nothing.
    directions, inside = cell_directions()
    lights = directions[inside][::9].expand(100, -1, 3)
    c, s = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = lights.unbind(-1)
    turned_lights = torch.stack((c * x - s * y, s * x + c * y, z), dim=-1)
    assert_close(turned.radiance(turned_lights), scene.radiance(lights), rtol=2e-3, atol=1e-4)


@parametrize("share", SHARES)
def test_each_effect_shows_in_the_scene_and_can_be_switched_off(share):
    def dense(config):
        return draw_scene(400, config, seeded(0)).dense_truth().values

    assert (dense(replace(NOTHING, **{share: 1.0})) - dense(NOTHING)).abs().max() > 0.01
    off = draw_scene(400, replace(PixelGeneratorConfig(), **{share: 0.0}), seeded(0))
    if share == "mixed_share":
        assert off.mixed is None
    elif share == "ambient_share":
        assert not off.ambient.any()
    elif share == "translucent_share":
        assert not off.wrap.any()
    else:
        assert len(off.walls) == 1


def test_flat_captures_have_one_tilt_each():
    config = replace(NOTHING, capture_pixels=64, flat_share=1.0)
    normals = draw_scene(64 * 200, config, seeded(0)).normals.unflatten(0, (64, 200))
    slopes = normals[..., :2] / normals[..., 2:]
    # Within a capture, sigma is 10^U(-1.7, -0.4), with a median of 0.09.
    sigma = slopes.std(dim=0).median(dim=0).values
    assert sigma.sub(10**-1.05).abs().max() < 0.03
    # The tilts have slopes of 0.7 U(0, 1)^(1/2), whose mean is two thirds of 0.7.
    assert slopes.mean(dim=0).norm(dim=1).mean() == approx(0.7 * 2 / 3, abs=0.03)


def test_mixed_pixels_lie_between_their_surfaces():
    scene = draw_scene(400, replace(NOTHING, mixed_share=0.5), seeded(0))
    assert len(scene.mixed.normals) == len(scene.mixed_weight) == 200
    lights = cell_directions()[0][cell_directions()[1]]
    alone = replace(scene, mixed=None, mixed_weight=None).radiance(lights)
    second, blended = scene.mixed.radiance(lights), scene.radiance(lights)
    weight = scene.mixed_weight
    assert_close(blended[:200], (1 - weight) * alone[:200] + weight * second, rtol=1e-4, atol=1e-5)
    assert torch.equal(blended[200:], alone[200:])
    # Edges have another normal and the same material; blends the reverse.
    edge = torch.arange(200) % 2 == 0
    same_normal = (scene.mixed.normals == scene.normals[:200]).all(dim=1)
    same_base = (scene.mixed.material.base == scene.material.base[:200])[:, 0]
    assert torch.equal(same_normal, ~edge)
    assert torch.equal(same_base, edge)
    assert weight[edge].max() <= 0.4 < weight[~edge].max() <= 0.7


def test_normals_are_spread_as_on_a_sphere_s_picture():
    normals = draw_visible_normals(20_000, seeded(0)).double()
    assert normals.norm(dim=1).sub(1).abs().max() < 1e-6
    assert (normals[:, 2] > 0).all()
    # Uniform by projected area: r^2 is uniform over 0..0.997^2, and so is the azimuth over the
    # circle.
    squared = (normals[:, 0] ** 2 + normals[:, 1] ** 2).numpy()
    assert stats.kstest(squared, stats.uniform(0, 0.997**2).cdf).pvalue > 1e-3
    azimuth = torch.atan2(normals[:, 1], normals[:, 0]).numpy()
    assert stats.kstest(azimuth, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3


SHARED = replace(NOTHING, capture_pixels=16, unequal_lights_share=0.0)


def test_pixels_of_a_capture_share_its_lights_and_its_exposure():
    batch = draw(160, replace(SHARED, light_direction_error_share=1.0))
    assert batch.captures == 10
    # Pixel p belongs to capture p % 10.
    for shared in (batch.light_directions, batch.valid, batch.exposure):
        captures = shared.unflatten(0, (16, 10))
        assert torch.equal(captures, captures[:1].expand_as(captures))
    assert len(batch.exposure.unique()) == 10
    # Without noise, they show the radiance of their true lights at that exposure.
    exact = draw(160, SHARED)
    radiance = exact.truth.radiance(exact.light_directions) * exact.exposure * exact.valid
    clipped = radiance > 1
    assert_close(exact.observations[~clipped], radiance[~clipped], rtol=1e-3, atol=1e-6)
    brightest = exact.observations.unflatten(0, (16, 10)).amax(dim=(0, 2))
    assert (brightest > 0.15).all() and (brightest <= 1).all()
    assert draw(10, SHARED).captures == 1  # of fewer pixels than usual
