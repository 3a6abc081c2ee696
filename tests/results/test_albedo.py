"""Albedo maps of a coloured sphere with highlights and cast shadows, compared with its known
albedo.
"""

import numpy as np
import pytest

from scenes import (
    on_sphere,
    read_image,
    square_grid,
    to_uint16,
    vectors,
    write_capture,
    write_image,
)
from splinecli.capture import open_capture
from splinecli.lights.calibration.balls import find_ball_files
from splinecli.lights.calibration.lamps import measure_light_intensities
from splinecli.maths.normals import unit
from splinecli.recipe import RecipeOptions, prepare_capture
from splinecli.results.map_values import albedo_map

SIZE = 40
INTENSITIES = vectors("1 0.9 0.8; 0.7 0.7 0.7; 0.5 0.6 0.7; 1 1 1; 0.8 1 0.8; 1 1 0.5")
LIGHTS = unit(vectors("0 0 1; 0.5 0 0.8; -0.5 0 0.8; 0 0.5 0.8; 0 -0.5 0.8; 0.3 0.3 0.9"))


@pytest.fixture
def scene(tmp_path):
    """Folder, true normals and true albedo of a capture; some pixels have a highlight or a shadow
    under one light.
    """
    x, y = square_grid(SIZE, 1 - 1 / SIZE)
    inside = np.hypot(x, y) < 0.9
    normals = np.float32(on_sphere(x, y) * inside[..., None])
    rng = np.random.default_rng(0)
    albedo = np.where(inside[..., None], rng.uniform(0.1, 0.6, (SIZE, SIZE, 3)), 0)
    images = albedo * (normals @ LIGHTS.T).clip(0).transpose(2, 0, 1)[..., None]
    for number, image in enumerate(images):
        image[number::12] *= 0.1  # cast shadow on every twelfth row
        image[:, number::12] += 0.2  # highlights on every twelfth column
    stored = to_uint16((images * INTENSITIES[:, None, None]).clip(0, 1) * 65535)
    write_capture(tmp_path, stored, LIGHTS, mask=inside, intensities=INTENSITIES, names="{}.png")
    return tmp_path, normals, albedo


def test_a_gray_target_balances_the_colours(scene, tmp_path):
    """With the intensities that calibrate measures on a gray card under coloured lamps, what is
    gray looks gray.
    """
    folder, normals, _ = scene
    (tmp_path / "card").mkdir()
    tint = INTENSITIES * (1, 0.7, 0.4)
    for number, (light, colour) in enumerate(zip(LIGHTS, tint, strict=True)):
        card = np.broadcast_to(0.5 * light[2] * colour * 65535, (20, 20, 3))
        write_image(tmp_path / f"card/{number}.png", to_uint16(card[..., ::-1]))
        gray = 0.4 * (normals @ light).clip(0)[..., None] * colour * 65535
        write_image(folder / f"{number}.png", to_uint16(gray[..., ::-1]))
    measured = measure_light_intensities(find_ball_files(tmp_path / "card"), LIGHTS, "card")
    np.savetxt(folder / "light_intensities.txt", measured)
    source = open_capture(folder)
    found = albedo_map(source, prepare_capture(source), normals)[normals.any(axis=2)]
    seen = found[found[:, 0] > 0]
    np.testing.assert_allclose(seen / seen[:, :1], 1, atol=0.01)
    assert seen.std() / seen.mean() < 0.02


def test_restored_pixels_do_not_spoil_it(scene):
    """The stored colours of overexposed pixels are too dark, so their other observations give the
    albedo.
    """
    folder, normals, albedo = scene
    for path in folder.glob("[0-9].png"):
        picture = np.int64(read_image(path))
        write_image(path, np.uint16(np.minimum(2.5 * picture, 65_535)))
    source = open_capture(folder)
    capture = prepare_capture(source)
    stored = prepare_capture(source, options=RecipeOptions(as_stored=True)).observations
    inside = normals.any(axis=2)
    found = albedo_map(source, capture, normals)[inside] / (2.5 * albedo[inside])
    touched = (capture.observations > stored).any(axis=1)
    assert 0.2 < touched.mean() < 0.9
    # This includes highlights and shadows, as below.
    assert np.median(found[touched]) == pytest.approx(1, abs=0.02)
    assert np.quantile(found, 0.99) < 1.5


def test_albedo_in_colour(scene):
    folder, normals, albedo = scene
    source = open_capture(folder)
    steps = []
    found = albedo_map(source, prepare_capture(source), normals, progress=lambda: steps.append(1))
    assert len(steps) == 6
    assert found.dtype == np.float32
    assert found.shape == (SIZE, SIZE, 3)
    inside = normals.any(axis=2)
    assert not found[~inside].any()
    error = np.abs(found - albedo)[inside] / albedo[inside]
    # A highlight weaker than 30 % of the albedo under its light counts as matte.
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.99) < 0.12
    # The plain mean over the lights is wrong here, so the choice of observations matters.
    capture = prepare_capture(source)
    plain = (capture.observations / (normals[inside] @ capture.light_directions.T).clip(0.15)).mean(
        axis=1
    )
    assert np.quantile(np.abs(plain / albedo[inside].mean(axis=1) - 1), 0.9) > 0.2
    # Where no light reaches the surface, it is black.
    turned = albedo_map(source, prepare_capture(source), np.float32(normals * (1, 1, -1)))
    assert not turned[normals[..., 2] > 0.95].any()
