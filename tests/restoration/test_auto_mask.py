"""The object is found by its brightness, against drawn scenes whose masks are known."""

import numpy as np
import pytest

from splinecli.capture.formats.images import decode_image, to_linear
from splinecli.capture.reader import open_capture
from splinecli.errors import InputError
from splinecli.restoration.images import find_object

SIDE = 120


def disc(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def test_the_largest_part_with_its_holes_filled():
    rng = np.random.default_rng(0)
    thing, crumb, pupil = disc(50, 60, 30), disc(105, 15, 8), disc(45, 55, 6)
    brightness = np.where(thing, 0.4, 0.004) + np.where(crumb, 0.6, 0)
    brightness[pupil] = 0.003  # black paint
    brightness[10, 60] = 5.0  # a hot pixel
    brightness *= rng.uniform(0.8, 1.2, brightness.shape)
    found = find_object(brightness.astype(np.float32))
    assert (found != thing).mean() < 0.005
    assert found[pupil].all()
    assert not found[crumb].any()


@pytest.mark.parametrize(
    ("brightness", "said"), [(np.zeros((SIDE, SIDE)), "are black"), (np.full((SIDE, SIDE), 0.5), "covers 100.0 %")]
)
def test_nothing_stands_out(brightness, said):
    with pytest.raises(InputError, match=said):
        find_object(brightness.astype(np.float32))


@pytest.mark.parametrize(
    "place", ["DiLiGenT/pmsData/ballPNG", "DiLiGenT/pmsData/catPNG", "uw/gray", "uw/horse", "synth/L17/bowl_S"]
)
def test_real_objects(shared_data, place):
    """Intersection over union with the masks that people drew."""
    source = open_capture(shared_data / place)
    images = [to_linear(decode_image(path), path).mean(axis=2) for path in source.files.images[::4]]
    mask = source.read_mask(images[0].shape)
    found = find_object(np.mean(images, axis=0))
    assert (found & mask).sum() > 0.85 * (found | mask).sum()
