"""The layout of CyclesPS, on trees written here as they are published: what goes in comes out,
value for value.
"""

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal

from scenes import on_sphere, to_uint16, vectors, write_image
from splinecli.capture import capture_name, find_captures, open_capture
from splinecli.errors import InputError
from splinecli.recipe import read_capture

HEIGHT, WIDTH = 7, 11  # unequal, so that nothing is turned round unnoticed
LIGHTS = vectors("0.1 0.2 0.9; -0.7 0.1 0.5; 0.3 -0.6 0.4; 0 0.5 0.6; 0.5 0.5 0.3")


def normals():
    """Unit normals (HEIGHT, WIDTH, 3) that no mirror image or exchange of axes maps onto each
    other.
    """
    y, x = np.mgrid[0.5:-0.4:7j, -0.6:0.7:11j]
    return on_sphere(x, y)


def boundaries():
    """The inner mask and the one of the rim, 21 and 14 of 77 pixels; neither contains the other."""
    inner, rim = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    inner[2:5, 2:9] = 1  # any value above zero counts, whatever the largest
    inner[3, 4] = 255
    rim[1, 2:9] = 255
    rim[5, 2:9] = 3
    return inner, rim


def write_object(folder, *kinds, seed=0, n_lights=5):
    """An object as published; returns the images (F, H, W, 3) of each kind."""
    folder.mkdir(parents=True)
    np.savetxt(folder / "light.txt", LIGHTS[:n_lights], fmt="%.6f")
    encoded = to_uint16((normals() + 1) / 2 * 65535)
    tifffile.imwrite(folder / "gt_normal.tif", encoded, photometric="rgb")
    for name, boundary in zip(("inboundary.png", "onboundary.png"), boundaries(), strict=True):
        write_image(folder / name, boundary)
    rng = np.random.default_rng(seed)
    written = {}
    for kind in kinds:
        (folder / f"images_{kind}").mkdir()
        written[kind] = rng.integers(0, 65536, (n_lights, HEIGHT, WIDTH, 3), np.uint16)
        for index, image in enumerate(written[kind]):
            tifffile.imwrite(folder / f"images_{kind}/{index:05}.tif", image, photometric="rgb")
    return written


@pytest.fixture
def tree(tmp_path):
    """The root of a tree with two objects, in all three kinds."""
    root = tmp_path / "CyclesPS"
    for seed, name in enumerate(("Bunny10", "Bunny9")):
        write_object(root / "PRPS" / name, "specular", "metallic", seed=seed)
        write_object(root / "PRPS_Diffuse" / name, "diffuse", seed=10 + seed)
    return root


def message(call):
    with pytest.raises(InputError) as caught:
        call()
    return str(caught.value)


def test_every_value_is_what_was_written(tmp_path):
    written = write_object(tmp_path / "Bunny", "specular", "metallic")["metallic"]
    capture = read_capture(tmp_path / "Bunny/images_metallic")
    assert capture.name == "Bunny_metallic"
    inner, rim = boundaries()
    mask = (inner > 0) | (rim > 0)
    assert capture.n_pixels == 35
    assert_array_equal(capture.mask, mask)
    expected = np.float64(written).mean(axis=-1)[:, mask].T / 65535
    # float32 keeps 24 bits, and three channels are added.
    assert_allclose(capture.observations, expected, rtol=3e-7, atol=0)
    unit = LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True)
    assert_allclose(capture.light_directions, unit, rtol=1e-12)
    # Rounded to 16 bits: half a step of 2 / 65535 on each axis.
    assert_allclose(capture.ground_truth[mask], normals()[mask], atol=2.5e-5)
    assert not capture.ground_truth[~mask].any()


def test_an_object_with_one_kind_is_that_capture(tmp_path, monkeypatch):
    write_object(tmp_path / "Bunny", "diffuse")
    by_object, by_folder = (
        read_capture(tmp_path / "Bunny"),
        read_capture(tmp_path / "Bunny/images_diffuse"),
    )
    assert by_object.name == by_folder.name == "Bunny_diffuse"
    assert_array_equal(by_object.observations, by_folder.observations)
    monkeypatch.chdir(tmp_path / "Bunny/images_diffuse")
    for way in (".", "..", "../images_diffuse", "../../Bunny", str(tmp_path / "Bunny/")):
        assert capture_name(way) == open_capture(way).files.name == "Bunny_diffuse"


def test_find_captures(tree):
    objects = [tree / "PRPS/Bunny9", tree / "PRPS/Bunny10"]
    of_prps = [folder / f"images_{kind}" for folder in objects for kind in ("metallic", "specular")]
    of_diffuse = [tree / f"PRPS_Diffuse/{name}/images_diffuse" for name in ("Bunny9", "Bunny10")]
    assert find_captures(tree / "PRPS/Bunny9/images_specular") == [
        tree / "PRPS/Bunny9/images_specular"
    ]
    assert find_captures(tree / "PRPS/Bunny9") == of_prps[:2]
    assert find_captures(tree / "PRPS") == of_prps
    assert find_captures(tree / "PRPS_Diffuse") == of_diffuse
    assert find_captures(tree) == of_prps + of_diffuse
    assert f"Pass {tree} instead, which contains captures." in message(
        lambda: find_captures(tree.parent)
    )
    names = [capture_name(folder) for folder in find_captures(tree)]
    assert names[1:5] == [
        "Bunny9_specular",
        "Bunny10_metallic",
        "Bunny10_specular",
        "Bunny9_diffuse",
    ]


def test_missing_files_of_the_object(tmp_path):
    folder = tmp_path / "Bunny"
    write_object(folder, "specular")
    (folder / "gt_normal.tif").unlink()
    assert read_capture(folder).ground_truth is None
    lights = (folder / "light.txt").rename(tmp_path / "l.txt")
    found = message(lambda: open_capture(folder / "images_specular"))
    assert found.startswith(
        f"{folder}: found no light.txt with the light directions of images_specular. Pass --l"
    )
    assert read_capture(folder, lights=lights).n_lights == 5
    lights.rename(folder / "light.txt")
    (folder / "onboundary.png").unlink()
    found = message(lambda: open_capture(folder))
    assert (
        found.startswith(f"{folder}: found no onboundary.png, but both masks are needed")
        and "Pass --mask FILE" in found
    )
    mask = tmp_path / "mask.png"
    write_image(mask, boundaries()[1])
    # above half of the largest, as in other layouts
    assert read_capture(folder, mask=mask).n_pixels == 7


def test_masks_that_do_not_fit(tmp_path):
    folder = tmp_path / "Bunny"
    write_object(folder, "specular")
    write_image(folder / "onboundary.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert read_capture(folder).n_pixels == 21
    write_image(folder / "inboundary.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    found = message(lambda: read_capture(folder))
    assert (
        found
        == f"{folder}: the mask is empty: every pixel of inboundary.png and onboundary.png is zero."
    )
    write_image(folder / "onboundary.png", np.ones((WIDTH, HEIGHT), np.uint8))
    found = message(lambda: read_capture(folder))
    assert found.endswith(
        "onboundary.png: found a mask of 7 x 11 pixels, expected 11 x 7 as in 00000.tif."
    )
