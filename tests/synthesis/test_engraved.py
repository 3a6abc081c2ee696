"""Engraved pieces: unit normals towards the camera, attached shadows, and detail of a few pixels."""

from __future__ import annotations

import pytest
import torch

from conftest import spiral_lights
from splinecli.synthesis.engraved import draw_engraved

LIGHTS = torch.tensor(spiral_lights(9, 75), dtype=torch.float32)
SIZE = 48


@pytest.mark.parametrize("seed", range(9))
def test_a_piece(seed: int) -> None:
    normals, radiance = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))
    assert normals.shape == (SIZE**2, 3) and radiance.shape == (SIZE**2, 9)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(SIZE**2))
    assert (normals[:, 2] > 0).all()
    assert torch.isfinite(radiance).all() and (radiance >= 0).all()
    assert (radiance[normals @ LIGHTS.T <= 0] == 0).all()
    again = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))
    assert torch.equal(again[0], normals) and torch.equal(again[1], radiance)


def test_detail_has_the_size_of_pixels() -> None:
    """In most pieces, normals differ more over four pixels than the waves of the frame make them."""
    steps = []
    for seed in range(30):
        normals = draw_engraved(SIZE, LIGHTS, torch.Generator().manual_seed(seed))[0].view(SIZE, SIZE, 3)
        steps.append((normals[:, 4:] - normals[:, :-4]).norm(dim=-1).mean())
    # Waves of 0.3 frames with slopes of 0.3 change by up to 2 pi 4 / 15 x 0.3 x 0.64 = 0.3 in the mean, few by 0.1.
    assert torch.stack(steps).median() > 0.1
