"""Captures of a matte sphere, and images written by the tests.

Whatever the files of the sphere are called, the normals are those of its geometry. The oracle of
the readers is what was written.
"""

import numpy as np
import pytest

import scenes
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.maths.normals import angle_between_deg
from splinecli.recipe import RecipeOptions, prepare_capture

NORMALS, DISC = scenes.sphere(32, 0.6)
MASK = DISC.astype(np.uint8) * 255
LIGHTS = scenes.spiral_lights(12, 40)
ROWS = LIGHTS.tolist()
NAMED = [(f"{number:03}.png", row) for number, row in enumerate(ROWS)]
LINES = "\n".join(" ".join(map(str, row)) for row in ROWS)
LP = "\n".join(f"{name} {x} {y} {z}" for name, (x, y, z) in NAMED)


def xyz(row):
    return dict(zip("xyz", row, strict=True))


def pictures(lights=LIGHTS):
    """Images (F, 32, 32) of the sphere."""
    return scenes.to_uint16(np.moveaxis(scenes.shade(NORMALS, lights), -1, 0) * 50_000)


PICTURES = pictures()


@pytest.fixture
def folder(tmp_path):
    """A capture `owl` without a mask."""
    return scenes.write_capture(tmp_path / "owl", PICTURES, LIGHTS)


@pytest.fixture
def unlit(tmp_path):
    """The capture without its light file."""
    return scenes.write_capture(tmp_path / "owl", PICTURES, None)


def normals_by_ls(source):
    """The capture as it is stored, and its normals (H, W, 3) by least squares."""
    capture = prepare_capture(source, options=RecipeOptions(as_stored=True))
    return capture, estimate_normals(capture, make_estimator("ls")).normal_map


def check(source, mask=None):
    """Compare mask and normals with the geometry, and return the codes of the warnings."""
    capture, normals = normals_by_ls(source)
    assert mask is None or (capture.mask == mask).all()
    inside = capture.mask & DISC
    # 16-bit values as stored, without shadows: least squares is exact to a few thousandths of a
    # degree.
    assert angle_between_deg(normals[inside], NORMALS[inside]).max() < 0.1
    return scenes.codes(source)


@pytest.fixture
def write_image(tmp_path):
    """Writes pixels (H, W) or (H, W, 3) RGB below tmp_path, in the format of the name."""
    return lambda name, pixels: scenes.write_image(
        tmp_path / name, pixels if pixels.ndim == 2 else pixels[..., ::-1]
    )
