"""Engraved pieces: unit normals towards the camera, attached shadows, and detail of a few pixels."""

import pytest
import torch

from scenes import spiral_lights
from splinecli.synthesis.engraved import draw_engraved

LIGHTS = torch.tensor(spiral_lights(9, 75), dtype=torch.float32)
SIZE = 48


@pytest.mark.parametrize("seed", range(3))
def test_a_piece(seed: int) -> None:
    normals, radiance, mask = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))
    assert mask.shape == (SIZE, SIZE)
    pixels = int(mask.sum())
    assert normals.shape == (pixels, 3) and radiance.shape == (pixels, 9)
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
