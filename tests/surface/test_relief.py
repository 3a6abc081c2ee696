"""The relief of waves, whose heights are known."""

import numpy as np
import pytest

from splinecli.maths.normals import unit
from splinecli.surface.integration import relief_of_normals


@pytest.mark.parametrize(("wave", "kept"), [(16, 1 / (1 + (16 / 64) ** 2)), (64, 0.5), (256, 1 / (1 + 4**2))])
def test_of_a_wave_the_stated_share_is_kept(wave: int, kept: float) -> None:
    x = np.broadcast_to(np.arange(512), (96, 512))
    k = 2 * np.pi / wave
    slope = -0.5 * k * np.sin(k * x)
    normals = unit(np.stack((-slope, np.zeros_like(slope), np.ones_like(slope)), axis=-1)).astype(np.float32)
    relief = relief_of_normals(normals, np.ones(x.shape, bool))
    middle = (slice(None), slice(128, 384))
    np.testing.assert_allclose(relief[middle], 0.5 * kept * np.cos(k * x)[middle], atol=0.01)
