"""Bad files cause one message that names the file, and nothing else on stderr."""

import builtins
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile

from scenes import parametrize, refuses, to_uint16, vectors, write_image
from splinecli.capture import open_capture
from splinecli.errors import InputError
from splinecli.recipe import prepare_capture, read_capture

LIGHTS = vectors("0 0 1; 0.6 0 0.8; 0 0.6 0.8; -0.6 0 0.8")


@pytest.fixture
def folder(tmp_path):
    for number in range(4):
        pixels = np.uint16(np.random.default_rng(number).integers(0, 60_000, (20, 25, 3)))
        tifffile.imwrite(tmp_path / f"{number}.tif", pixels, photometric="rgb")
    np.savetxt(tmp_path / "lights.txt", LIGHTS)
    return tmp_path


@pytest.fixture
def no_warnings(capfd):
    """Fail the test where a library warns, or writes to stderr."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    assert [str(warning.message) for warning in caught] == []
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("no_warnings")
@parametrize("light", [(0, 0, 1), (0.6, 0, 0.8)])
@parametrize("as_stored", [True, False])
def test_identical_lights(tmp_path, light, as_stored, rng):
    """On a scene whose intensities would be estimated, were the lights not identical."""
    for number in range(8):
        shading = np.linspace(0.1, 1, 900).reshape(30, 30) * rng.uniform(0.5, 1.5)
        write_image(tmp_path / f"{number}.png", to_uint16(shading * 40_000))
    np.savetxt(tmp_path / "lights.txt", [light] * 8)
    with refuses("the 8 lights are coplanar"):
        read_capture(tmp_path, as_stored=as_stored)


@parametrize(
    "name",
    "1.tif lights.txt light_intensities.txt mask.png normals_gt.npy ambient.png",
)
def test_a_file_that_may_not_be_read(folder, monkeypatch, name):
    """Even root may not."""
    write_image(folder / "mask.png", np.full((20, 25), 255, np.uint8))
    write_image(folder / "ambient.png", np.full((20, 25), 255, np.uint8))
    np.save(folder / "normals_gt.npy", np.broadcast_to([0.0, 0.0, 1.0], (20, 25, 3)))
    np.savetxt(folder / "light_intensities.txt", np.ones((4, 3)))
    for owner, original in ((Path, Path.open), (builtins, builtins.open)):

        def refuse(file, *args, original=original, **kwargs):
            if isinstance(file, str | Path) and Path(file) == folder / name:
                raise PermissionError(13, "Permission denied", str(file))
            return original(file, *args, **kwargs)

        monkeypatch.setattr(owner, "open", refuse)
    with pytest.raises(InputError) as caught:
        read_capture(folder)
    assert str(caught.value) == f"{folder / name}: the file cannot be read (Permission denied)."


def test_an_image_that_vanishes(folder):
    source = open_capture(folder)
    (folder / "3.tif").unlink()
    with refuses(r"3\.tif: the file (does not exist|cannot be read)"):
        prepare_capture(source)
