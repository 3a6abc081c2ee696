"""EXR files hold the values and the channels that renderers read, and texts about them."""

import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from scenes import parametrize, read_image


def read(path):
    """The header of an EXR file and its channels, each on its own."""
    file = pytest.importorskip("OpenEXR").File(str(path), separate_channels=True)
    return file.header(), {name: channel.pixels for name, channel in file.channels().items()}


@parametrize("convention", "opengl directx")
def test_maps_of_infer(capture, run, convention):
    pytest.importorskip("OpenEXR")
    options = f"--method ls --maps albedo --surface --convention {convention}"
    run(f"infer {capture} {options} --format exr,png,npy,tiff")
    out = Path("out/sphere")
    green = (
        f"x right, y up, z to the camera; green is y {'up' if convention == 'opengl' else 'down'}"
    )
    header, channels = read(out / "normals.exr")
    assert header["normals"] == f"(n + 1) / 2; {green}"
    picture = read_image(out / "normals.png")[..., ::-1] / 65535
    assert_allclose(np.stack([channels[name] for name in "RGB"], axis=2), picture, atol=1e-5)
    with Image.open(out / "normals.png") as image:
        assert image.info["normals"] == green
    with tifffile.TiffFile(out / "normals.tiff") as file:
        assert file.pages[0].description == "normals: x right, y up, z to the camera; green is y up"
    _, channels = read(out / "albedo.exr")
    assert_allclose(
        np.stack([channels[n] for n in "RGB"], axis=2), np.load(out / "albedo.npy"), rtol=1e-3
    )
    assert channels["R"].dtype == np.float16
    header, channels = read(out / "depth.exr")
    depth = np.load(out / "depth.npy")
    assert header["unit"] == "pixel"
    assert_array_equal(channels["Y"], np.where(np.isnan(depth), np.nanmin(depth), depth))
    assert (out / "depth.png").is_file()


@parametrize("command", ["infer sphere --method ls", "integrate missing.npy"])
def test_without_the_library_nothing_is_done(capture, run, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    words = "EXR files need the package OpenEXR, which is not installed"
    run(f"{command} --format exr", usage_error=words)
    assert not Path("out/sphere").exists()
