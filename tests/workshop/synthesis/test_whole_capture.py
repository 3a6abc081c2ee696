"""Backgrounds, and the camera of a capture, against what its parts do to points, ramps and
constants.
"""

import math

import cv2
import numpy as np
import torch
from pytest import approx
from torch.testing import assert_close

from distributions import seeded
from scenes import parametrize, spiral_lights
from splinecli.workshop.synthesis.whole_capture import (
    Optics,
    _shadows,
    add_background,
    disc_kernel,
    draw_engraved,
    gaussian_kernel,
    scatter,
)

LIGHTS = torch.tensor(spiral_lights(6, 60), dtype=torch.float32)


def disc(size=40):
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (rows - 20).square() + (columns - 20).square() < 12**2


@parametrize("seed", range(3))
def test_the_object_stays(seed):
    mask = disc()
    maps = torch.rand(9, 40, 40, generator=seeded(9)) + 0.2
    found, shown = add_background(maps, mask, LIGHTS, seeded(seed))
    # The object is where the maps have its values; all its pixels are shown, and others too.
    held = (found == maps[:, 20, 20, None, None]).all(dim=0).nonzero()
    assert len(held) == 1
    top, left = (held[0] - 20).tolist()
    rows, columns = mask.nonzero().T
    assert torch.equal(found[:, rows + top, columns + left], maps[:, mask])
    assert shown[rows + top, columns + left].all()
    assert int(shown.sum()) > int(mask.sum())
    assert torch.isfinite(found).all() and (found[:6] >= 0).all()
    shown[rows + top, columns + left] = False
    length = found[6:, shown].norm(dim=0)
    assert bool((length == 0).all()) or torch.allclose(length, torch.ones_like(length))


def test_shadows_fall_away_from_the_light():
    """A light at the right, 45 degrees up, moves the shadow left by the distance; one above moves
    it down.
    """
    mask, side = disc(), math.sqrt(0.5)
    right, above = _shadows(mask, torch.tensor([[side, 0, side], [0, side, side]]), 7)
    assert torch.equal(right[:, :-7], mask[:, 7:])
    assert torch.equal(above[7:], mask[:-7])


SIZE = 48


@parametrize("seed", range(3))
def test_a_piece(seed):
    normals, radiance, mask = draw_engraved(SIZE, LIGHTS, seeded(seed))
    assert mask.shape == (SIZE, SIZE)
    pixels = int(mask.sum())
    assert normals.shape == (pixels, 3) and radiance.shape == (pixels, 6)
    assert_close(normals.norm(dim=1), torch.ones(pixels))
    assert (normals[:, 2] > 0).all()
    assert torch.isfinite(radiance).all() and (radiance >= 0).all()
    assert (radiance[normals @ LIGHTS.T <= 0] == 0).all()
    again = draw_engraved(SIZE, LIGHTS, seeded(seed))
    assert torch.equal(again[0], normals) and torch.equal(again[1], radiance)


def test_round_pieces_turn_away_at_their_rim():
    """On average, the normals point away from the middle, and more so further out."""
    for seed in range(6):
        normals, _, mask = draw_engraved(SIZE, LIGHTS, seeded(seed), round_share=1.0)
        assert 0.25 < mask.float().mean() < 0.8 and not mask[0].any()
        rows, columns = mask.nonzero().float().T
        outwards = torch.stack((columns - columns.mean(), rows.mean() - rows), dim=1)
        radius = outwards.norm(dim=1)
        along = (normals[:, :2] * torch.nn.functional.normalize(outwards, dim=1)).sum(1)
        inner, outer = (
            along[radius < radius.median()].mean(),
            along[radius >= radius.median()].mean(),
        )
        assert 0 < inner < outer


SHARP = torch.ones(3, 1, 1)


def camera(kernels=SHARP, demosaic=None, sharpening=0.0, quality=None):
    return Optics(kernels, (0.25, 0.5, 0.25), demosaic, sharpening, 1.0, quality)


def spread(kernel):
    """The standard deviation of a kernel along its rows."""
    places = torch.arange(len(kernel)) - len(kernel) // 2
    return float((kernel.sum(0) * places**2).sum().sqrt())


@parametrize("sigma", [0.6, 0.9, 1.2])
def test_kernels_have_the_width_that_they_state(sigma):
    assert spread(gaussian_kernel(sigma)) == approx(sigma, rel=0.05)
    # The mean over a pixel adds the variance of its own width, a twelfth.
    assert spread(disc_kernel(sigma)) == approx(np.sqrt(sigma**2 + 1 / 12), rel=0.08)
    for kernel in (gaussian_kernel(sigma), disc_kernel(sigma)):
        assert float(kernel.sum()) == approx(1)


def test_a_lens_spreads_a_point_into_its_kernel():
    image = torch.zeros(1, 11, 11)
    image[0, 5, 5] = 1
    kernel = gaussian_kernel(0.7)
    colours = camera(kernel.expand(3, -1, -1)).through_lens(image)
    reach = len(kernel) // 2
    assert_close(colours[1, 0, 5 - reach : 6 + reach, 5 - reach : 6 + reach], kernel)
    assert float(colours[2].sum()) == approx(1)


@parametrize("code", [cv2.COLOR_BayerRGGB2RGB, cv2.COLOR_BayerRGGB2RGB_EA])
def test_a_bayer_pattern_keeps_ramps_and_blurs_points(code):
    """Linear interpolation is exact on a ramp, whichever colours the ramp has. A point spreads."""
    ramp = (0.1 + 0.05 * torch.arange(12.0)).expand(1, 12, 12)
    colours = torch.stack((0.5 * ramp, ramp, 0.8 * ramp))
    developed = camera(demosaic=code).develop(colours)
    inside = (0, slice(2, -2), slice(2, -2))
    assert_close(developed[inside], 0.825 * ramp[inside], atol=2e-4, rtol=0)
    point = torch.zeros(3, 1, 12, 12)
    point[:, 0, 6, 6] = 1  # a red cell: green and blue miss it
    seen = camera(demosaic=code).develop(point)
    assert float(seen[0, 6, 6]) == approx(0.25, abs=1e-3)
    assert float(seen[0, 6, 7]) == approx(0.125, abs=1e-3)


def test_sharpening_raises_contrast_and_jpeg_keeps_flat_areas():
    edge = torch.cat((torch.full((1, 16, 8), 0.2), torch.full((1, 16, 8), 0.6)), dim=2)
    sharp = camera(sharpening=0.8).develop(edge.expand(3, 1, 16, 16))
    assert float(sharp[0, 8, 7]) < 0.19 and float(sharp[0, 8, 8]) > 0.61
    assert_close(sharp[0, :, :3], edge[0, :, :3])
    flat = torch.full((1, 16, 16), 0.3)
    rough = torch.rand(1, 16, 16, generator=seeded(0))
    coarse, fine = (camera(quality=quality).compress(rough) for quality in (20, 98))
    assert (coarse - rough).abs().mean() > 2 * (fine - rough).abs().mean()
    assert_close(camera(quality=90).compress(flat), flat, atol=3e-3, rtol=0)


def test_light_that_scatters_stays_in_the_object():
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[4:16, 4:16] = True
    radiance = torch.rand(3, 20, 20, generator=seeded(0)) * mask
    spread_out = scatter(radiance, mask, seeded(1))
    assert not spread_out[:, ~mask].any()
    assert spread_out[:, mask].std() < 0.9 * radiance[:, mask].std()
    assert_close(scatter(mask.float()[None], mask, seeded(1))[0], mask.float())
