"""Small pixel sets for tests."""

import numpy as np
import pytest

from splinecli.maths.normals import unit
from splinecli.workshop.pixel_sets.store import Pixels, PixelSetWriter

THREE_SCENES = (("a", "one", 40, 30), ("b", "two", 30, 25), ("c", "three", 20, 12))


def matte_pixels(pixels, lights, *, seed=0, dtype=np.float32):
    """Matte pixels of random albedo under random lights: albedo max(0, n . l)."""
    random = np.random.default_rng(seed)

    def upward(count):
        vectors = random.standard_normal((count, 3))
        vectors[:, 2] = np.abs(vectors[:, 2]) + 0.1
        return np.float32(unit(vectors))

    normals, directions = upward(pixels), upward(lights)
    albedo = random.uniform(0.2, 1.0, (pixels, 1))
    mask = np.zeros((pixels, 2), bool)
    mask[:, 0] = True
    return Pixels(
        (albedo * (normals @ directions.T).clip(0)).astype(dtype), normals, directions, mask
    )


@pytest.fixture
def make_set(tmp_path):
    """Write a finished set of matte pixels: entries as (name, scene, pixels, lights)."""

    def make(
        name="set",
        entries=THREE_SCENES,
        dtype=np.float32,
    ):
        writer = PixelSetWriter(tmp_path / name)
        for index, (entry, scene, pixels, lights) in enumerate(entries):
            writer.add(
                entry,
                scene,
                "a test",
                {"by": "hand"},
                matte_pixels(pixels, lights, seed=index, dtype=dtype),
            )
        return writer.finish()

    return make
