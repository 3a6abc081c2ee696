"""The pixels of a mask, by NumPy's own indexing."""

import numpy as np
import pytest

from splinecli.capture.masks import take_pixels
from splinecli.capture.restore.saturation import in_any_channel


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_take_pixels(channels: int, share: float) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 60_000, (7, 9, channels), np.uint16)[:, :, ::-1]
    mask = rng.uniform(size=(7, 9)) < share
    np.testing.assert_array_equal(take_pixels(image, mask), image[mask])
    assert take_pixels(image, mask).dtype == np.uint16


@pytest.mark.parametrize("channels", [1, 3])
def test_in_any_channel(channels: int) -> None:
    flags = np.random.default_rng(0).uniform(size=(50, channels)) < 0.3
    np.testing.assert_array_equal(in_any_channel(flags), flags.any(axis=1))
