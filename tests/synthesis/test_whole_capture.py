"""Backgrounds: the object stays as it is, its shadow falls away from the light, and masks show more than the object."""

import math

import pytest
import torch

from scenes import spiral_lights
from splinecli.synthesis.engraved import draw_engraved
from splinecli.synthesis.whole_capture import _shadows, add_background

LIGHTS = torch.tensor(spiral_lights(6, 60), dtype=torch.float32)


def disc(size: int = 40) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (rows - 20).square() + (columns - 20).square() < 12**2


@pytest.mark.parametrize("seed", range(3))
def test_the_object_stays(seed: int) -> None:
    mask = disc()
    maps = torch.rand(9, 40, 40, generator=torch.Generator().manual_seed(9)) + 0.2
    found, shown = add_background(maps, mask, LIGHTS, torch.Generator().manual_seed(seed))
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


def test_shadows_fall_away_from_the_light() -> None:
    """A light at the right, 45 degrees up, moves the shadow left by the distance; one above moves it down."""
    mask, side = disc(), math.sqrt(0.5)
    right, above = _shadows(mask, torch.tensor([[side, 0, side], [0, side, side]]), 7)
    assert torch.equal(right[:, :-7], mask[:, 7:])
    assert torch.equal(above[7:], mask[:-7])


SIZE = 48


@pytest.mark.parametrize("seed", range(3))
def test_a_piece(seed: int) -> None:
    normals, radiance, mask = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))
    assert mask.shape == (SIZE, SIZE)
    pixels = int(mask.sum())
    assert normals.shape == (pixels, 3) and radiance.shape == (pixels, 6)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(pixels))
    assert (normals[:, 2] > 0).all()
    assert torch.isfinite(radiance).all() and (radiance >= 0).all()
    assert (radiance[normals @ LIGHTS.T <= 0] == 0).all()
    again = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))
    assert torch.equal(again[0], normals) and torch.equal(again[1], radiance)


def test_round_pieces_turn_away_at_their_rim() -> None:
    """On average, the normals point away from the middle, and more so further out."""
    for seed in range(6):
        normals, _, mask = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed), round_share=1.0)
        assert 0.25 < mask.float().mean() < 0.8 and not mask[0].any()
        rows, columns = mask.nonzero().float().T
        outwards = torch.stack((columns - columns.mean(), rows.mean() - rows), dim=1)
        radius = outwards.norm(dim=1)
        along = (normals[:, :2] * torch.nn.functional.normalize(outwards, dim=1)).sum(1)
        inner, outer = along[radius < radius.median()].mean(), along[radius >= radius.median()].mean()
        assert 0 < inner < outer
