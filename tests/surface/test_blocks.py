"""Blocks of pixels: their number, and values at pixels between them."""

import numpy as np
import pytest

from splinecli.surface.pixel_grid import Blocks

RNG = np.random.default_rng(0)
MASK = np.hypot(*np.mgrid[-20:20, -25:25]) < 18


@pytest.mark.parametrize("share", [1.0, 0.01])
def test_the_number_of_blocks_is_bounded_for_scattered_pixels(share: float) -> None:
    mask = RNG.random((300, 400)) < share
    blocks = Blocks.over(mask, 100)
    assert 50 <= np.count_nonzero(blocks.mask) <= 200


@pytest.mark.parametrize("step", [1, 3, 7])
def test_samples_are_those_of_scipy(step: int) -> None:
    blocks = Blocks.of_step(MASK, step)
    values = RNG.random((np.count_nonzero(blocks.mask), 2)).astype(np.float32)
    found = blocks.sample(blocks.spread(values), *np.nonzero(MASK))
    for column, of_blocks in zip(found.T, values.T, strict=True):
        depth = np.full(blocks.mask.shape, np.nan)
        depth[blocks.mask] = of_blocks
        np.testing.assert_allclose(column, blocks.interpolate(depth, MASK), atol=1e-6)
