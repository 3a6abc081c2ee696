"""Measured materials: networks evaluated against explicit vectors, files that are refused, and the MERL facts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splinecli.errors import InputError, ModelError
from splinecli.observation_map import cell_directions
from splinecli.synthesis.material import Material
from splinecli.synthesis.measured import MeasuredLibrary
from splinecli.synthesis.measured_files import read_measured
from splinecli.synthesis.mixed_material import MixedMaterial, choose
from splinecli.synthesis.pixels import (
    PixelGenerator,
    PixelGeneratorConfig,
    draw_scene,
    draw_visible_normals,
)
from splinecli.synthesis.principled import PrincipledMaterial, draw_material

Arrays = dict[str, NDArray[Any]]
NAMES = ("first", "second", "third")


def small_networks(count: int = 3, hidden: tuple[int, int] = (5, 4)) -> Arrays:
    """Smooth random networks, of little asymmetry in d_x, so that they pass for reciprocal."""
    random = np.random.default_rng(0)
    first, second = hidden
    arrays: Arrays = {
        "names": np.array(NAMES[:count]),
        "W1": random.normal(0, 0.3, (count, 6, first)),
        "b1": random.normal(0.5, 0.1, (count, first)),
        "W2": random.normal(0, 0.3, (count, first, second)),
        "b2": random.normal(0.5, 0.1, (count, second)),
        "W3": random.uniform(0.02, 0.1, (count, second, 3)),
        "b3": random.uniform(0.02, 0.05, (count, 3)),
    }
    arrays["W1"][:, 3] *= 0.1
    return {key: a if key == "names" else a.astype(np.float32) for key, a in arrays.items()}


def write(folder: Path, arrays: Arrays) -> Path:
    path = folder / "materials.npz"
    np.savez(path, **arrays)
    return path


@pytest.fixture
def library(tmp_path: Path) -> MeasuredLibrary:
    return read_measured(write(tmp_path, small_networks()))


@pytest.fixture(scope="module")
def merl(shared_data: Path) -> MeasuredLibrary:
    return read_measured(shared_data / "merl_nbrdf" / "merl_nbrdf.npz")


def brdf_of_vectors(arrays: Arrays, material: int, n: Any, light: Any, view: Any) -> NDArray[np.float64]:
    """The BRDF in RGB by Rusinkiewicz's definition, with rotations of explicit vectors, in float64."""
    # In float64 they are unit vectors only to float32's precision.
    n, light, view = (vector / np.linalg.norm(vector) for vector in (n, light, view))
    if light @ n < view @ n:
        light, view = view, light
    # Into a frame with the normal along z and the half vector at azimuth zero.
    half = (light + view) / np.linalg.norm(light + view)
    tangent = half - (half @ n) * n
    tangent /= np.linalg.norm(tangent)
    frame = np.stack((tangent, np.cross(n, tangent), n))
    half, light = frame @ half, frame @ light
    tilt = math.acos(half[2])
    turn = np.array(
        [[math.cos(tilt), 0, -math.sin(tilt)], [0, 1, 0], [math.sin(tilt), 0, math.cos(tilt)]], np.float64
    )
    np.testing.assert_allclose(turn @ half, (0, 0, 1), atol=1e-12)
    difference = turn @ light
    # Left and right are the same to an isotropic material.
    difference[1] = abs(difference[1])
    value = np.concatenate((half, difference))
    for layer in (1, 2):
        value = np.maximum(value @ arrays[f"W{layer}"][material] + arrays[f"b{layer}"][material], 0)
    return np.maximum(np.exp(value @ arrays["W3"][material] + arrays["b3"][material]) - 1, 0)


def random_configurations(pixels: int, lights: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Normals (P, 3) and light directions (D, 3), both towards the camera."""
    generator = torch.Generator().manual_seed(3)
    return draw_visible_normals(pixels, generator), draw_visible_normals(lights, generator)


def shade(material: Material, normals: torch.Tensor, lights: torch.Tensor) -> torch.Tensor:
    return material.shade(normals @ lights.T, normals[:, 2:], lights[:, 2])


def test_values_are_those_of_explicit_vectors(library: MeasuredLibrary) -> None:
    arrays = small_networks()
    normals, lights = random_configurations(6, 20)
    names = ["third", "first", "first", "second", "third", "second"]
    shaded = shade(library.as_measured(names), normals, lights)
    view = np.array((0.0, 0.0, 1.0))
    for pixel, name in enumerate(names):
        n = normals[pixel].double().numpy()
        for column, light in enumerate(lights.double().numpy()):
            brdf = brdf_of_vectors(arrays, NAMES.index(name), n, light, view).mean()
            expected = math.pi * brdf * max(n @ light, 0)
            # In float32, the angles are known to some 1e-4 where half vector and normal all but meet.
            assert shaded[pixel, column].item() == pytest.approx(expected, rel=1e-3, abs=1e-5)


def test_channels_are_weighted(library: MeasuredLibrary) -> None:
    normals, lights = random_configurations(3, 10)
    gray = library.as_measured(NAMES)
    channels = [replace(gray, weights=torch.eye(3)[channel].expand(3, 3)) for channel in range(3)]
    mean = torch.stack([shade(channel, normals, lights) for channel in channels]).mean(dim=0)
    torch.testing.assert_close(shade(gray, normals, lights), mean)
    torch.testing.assert_close(
        gray.albedo(), torch.stack([channel.albedo() for channel in channels]).mean(dim=0)
    )


def test_exchanging_light_and_view_leaves_the_brdf(library: MeasuredLibrary) -> None:
    generator = torch.Generator().manual_seed(0)
    material = library.draw(4, generator)
    n_dot_l = torch.rand(4, 50, generator=generator) * 0.9 + 0.1
    n_dot_v = torch.rand(4, 1, generator=generator) * 0.9 + 0.1
    sines = ((1 - n_dot_l**2) * (1 - n_dot_v**2)).sqrt()
    l_dot_v = n_dot_l * n_dot_v + sines * torch.linspace(-1, 1, 50)
    forth = material.shade(n_dot_l, n_dot_v, l_dot_v) / n_dot_l
    for column in range(50):
        light = n_dot_l[:, column : column + 1]
        back = material.shade(n_dot_v, light, l_dot_v[:, column : column + 1]) / n_dot_v
        torch.testing.assert_close(back, forth[:, column : column + 1])


def test_attached_shadow_is_black_and_all_else_finite(library: MeasuredLibrary) -> None:
    material = library.as_measured(["first"])
    n_dot_l = torch.tensor([[-1.0, -0.3, 0.0, 1e-7, 0.5, 1.0]])
    for n_dot_v in (1e-3, 0.5, 1.0):
        for l_dot_v in (-1.0, -0.99, 0.0, 1.0):
            shaded = material.shade(n_dot_l, torch.tensor([[n_dot_v]]), torch.full((6,), l_dot_v))
            assert torch.isfinite(shaded).all()
            assert not shaded[0, :3].any()
            assert (shaded[0, 4:] > 0).all()


def test_take_and_chunks(library: MeasuredLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    normals, lights = random_configurations(40, 30)
    material = library.draw(40, torch.Generator().manual_seed(0))
    whole = shade(material, normals, lights)
    index = torch.tensor([7, 7, 0, 39])
    torch.testing.assert_close(shade(material.take(index), normals[index], lights), whole[index])
    assert torch.equal(material.take(slice(5)).albedo(), material.albedo()[:5])
    own = material.shade(normals @ lights.T, normals[:, 2:], lights[:, 2].expand(40, -1))
    assert torch.equal(own, whole)
    monkeypatch.setattr("splinecli.synthesis.measured._AT_ONCE_CPU", 100)
    torch.testing.assert_close(shade(material, normals, lights), whole)


def test_albedo_of_a_lambertian_material(tmp_path: Path) -> None:
    arrays = small_networks(1)
    arrays["W3"][:] = 0
    arrays["b3"][:] = np.log(1 + np.array((0.2, 0.5, 0.8)) / math.pi)
    lambertian = read_measured(write(tmp_path, arrays))
    # The quadrature over half vectors is good for a percent.
    np.testing.assert_allclose(lambertian.albedos[0], (0.2, 0.5, 0.8), rtol=0.01)
    np.testing.assert_allclose(lambertian.brightest[0], (0.2, 0.5, 0.8), rtol=0.05)
    material = lambertian.as_measured(["first"])
    cosines = torch.linspace(0.1, 1, 7)[None]
    torch.testing.assert_close(material.shade(cosines, torch.ones(1, 1), cosines[0]), 0.5 * cosines)


def test_variations_stay_plausible_and_follow_from_the_seed(library: MeasuredLibrary) -> None:
    material, again = (library.draw(3000, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(material.weights, again.weights)
    assert torch.equal(material.index, again.index)
    assert material.index.bincount().min() > 900
    assert (material.weights >= 0).all()
    # Uniform over the simplex: each weight's share has a mean of 1/3 and a variance of 1/18.
    scale = material.weights.sum(dim=1, keepdim=True)
    share = material.weights / scale
    np.testing.assert_allclose(share.mean(dim=0), 1 / 3, atol=0.015)
    np.testing.assert_allclose(share.var(dim=0), 1 / 18, rtol=0.1)
    assert 0.5 <= scale.min() < 0.52
    assert scale.max() <= 2**1.5
    brightest = (material.weights * library.brightest[material.index]).sum(dim=1)
    assert brightest.max() <= 1.0001


def test_the_scale_ends_where_all_light_is_thrown_back(tmp_path: Path) -> None:
    arrays = small_networks(1)
    arrays["W3"][:] = 0
    arrays["b3"][:] = math.log(1 + 0.9 / math.pi)
    material = read_measured(write(tmp_path, arrays)).draw(500, torch.Generator().manual_seed(0))
    assert material.weights.sum(dim=1).max() <= 1.12
    assert material.albedo().max() == pytest.approx(1, abs=0.05)


def test_mixed_material_is_its_parts(library: MeasuredLibrary) -> None:
    generator = torch.Generator().manual_seed(0)
    principled, measured = draw_material(20, generator), library.draw(30, generator)
    kind = torch.tensor([0, 1, 1, 0, 1])
    row = torch.tensor([19, 29, 0, 3, 7])
    mixed = MixedMaterial((principled, measured), kind, row)
    normals, lights = random_configurations(5, 40)
    for own_lights in (False, True):
        cosines = lights[:, 2].expand(5, -1) if own_lights else lights[:, 2]
        shaded = mixed.shade(normals @ lights.T, normals[:, 2:], cosines)
        for pixel in range(5):
            part = (principled, measured)[int(kind[pixel])].take(row[pixel : pixel + 1])
            alone = part.shade(
                normals[pixel : pixel + 1] @ lights.T, normals[pixel : pixel + 1, 2:], lights[:, 2]
            )
            torch.testing.assert_close(shaded[pixel : pixel + 1], alone)
            torch.testing.assert_close(mixed.albedo()[pixel : pixel + 1], part.albedo())
    index = torch.tensor([4, 0, 4])
    torch.testing.assert_close(
        shade(mixed.take(index), normals[index], lights), shade(mixed, normals, lights)[index]
    )
    only = MixedMaterial((principled, measured), torch.ones(3, dtype=torch.int64), row[:3] % 20)
    torch.testing.assert_close(
        shade(only, normals[:3], lights), shade(measured.take(row[:3] % 20), normals[:3], lights)
    )


def test_choose_takes_each_pixel_from_one_of_two(library: MeasuredLibrary) -> None:
    generator = torch.Generator().manual_seed(0)
    materials = draw_material(6, generator), draw_material(6, generator), library.draw(6, generator)
    condition = torch.tensor([True, False, True, True, False, False])[:, None]
    normals, lights = random_configurations(6, 20)
    for first in materials:
        for second in materials:
            expected = torch.where(condition, shade(first, normals, lights), shade(second, normals, lights))
            torch.testing.assert_close(shade(choose(condition, first, second), normals, lights), expected)
    assert isinstance(choose(condition, *materials[:2]), PrincipledMaterial)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_scenes_hold_their_share_and_turn_as_a_whole(tmp_path: Path, share: float) -> None:
    path = write(tmp_path, small_networks())
    config = replace(
        PixelGeneratorConfig(), measured_share=share, measured_materials=str(path), mixed_share=0.5
    )
    scene = draw_scene(600, config, torch.Generator().manual_seed(0))
    assert isinstance(scene.material, MixedMaterial)
    assert scene.material.kind.float().mean().item() == pytest.approx(share, abs=0.06)
    quarter = scene.rotate(torch.zeros(600), torch.ones(600))
    torch.testing.assert_close(quarter.dense_map(), scene.dense_map().rot90(1, (2, 3)), rtol=2e-3, atol=1e-4)
    # An edge is one material on two normals.
    assert scene.mixed is not None
    normals, lights = scene.normals[:300], cell_directions()[0][cell_directions()[1]][::40]
    same = shade(scene.mixed.material, normals, lights) == shade(
        scene.material.take(slice(300)), normals, lights
    )
    edge = torch.arange(300) % 2 == 0
    assert torch.equal(same.all(dim=1), edge)


def test_batches_follow_from_the_seed_and_without_a_share_nothing_changes(tmp_path: Path) -> None:
    path = write(tmp_path, small_networks())

    def observe(**settings: Any) -> torch.Tensor:
        config = replace(PixelGeneratorConfig(), **settings)
        return PixelGenerator(config, torch.Generator().manual_seed(5)).draw(60).observations

    half = {"measured_share": 0.5, "measured_materials": str(path)}
    assert torch.equal(observe(**half), observe(**half))
    plain = observe()
    assert torch.equal(observe(measured_materials=str(path)), plain)
    assert torch.equal(observe(measured_materials=str(tmp_path / "missing.npz")), plain)
    measured = observe(**half)
    assert measured.shape[0] == 60
    assert torch.isfinite(measured).all()


def test_a_share_needs_a_file(tmp_path: Path) -> None:
    config = replace(PixelGeneratorConfig(), measured_share=0.5)
    with pytest.raises(
        ModelError, match=r"'measured_share' is 0\.5, but 'measured_materials' names no file"
    ) as e:
        PixelGenerator(config, torch.Generator())
    assert e.value.hint == "Name a file of measured materials there, or set the share to 0"
    with pytest.raises(InputError, match=r"no\.npz: the file does not exist"):
        PixelGenerator(replace(config, measured_materials=str(tmp_path / "no.npz")), torch.Generator())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"W2": None}, "found no array 'W2'. docs/files-and-frames.md lists all seven"),
        ({"names": np.array(["a", "b", "a"])}, r"shape \(3,\), expected a list of distinct texts"),
        ({"names": np.arange(3)}, "names of type int64"),
        ({"names": np.array([], dtype=str)}, r"shape \(0,\), expected a list of distinct texts"),
        (
            {"W1": np.zeros((3, 5, 5))},
            r"found W1 of type float64 and shape \(3, 5, 5\), expected .* \(3, 6, 5\)",
        ),
        ({"b1": np.zeros((2, 5))}, r"found b1 .* shape \(2, 5\), expected floating-point \(3, 5\)"),
        ({"b1": np.float64(0)}, r"found W1 .* expected floating-point \(3, 6, 0\)"),
        ({"W3": np.zeros((3, 4, 1))}, r"found W3 .* expected floating-point \(3, 4, 3\)"),
        ({"b3": np.zeros((3, 3), int)}, "found b3 of type int64"),
        ({"b2": np.full((3, 4), np.nan)}, "b2 has values that are not finite"),
        ({"names": np.array(["a", None, 1], dtype=object)}, "not an .npz file of plain arrays, or damaged"),
    ],
)
def test_files_of_another_form_are_refused(tmp_path: Path, change: Arrays, message: str) -> None:
    arrays = {key: array for key, array in (small_networks() | change).items() if array is not None}
    with pytest.raises(InputError, match=message):
        read_measured(write(tmp_path, arrays))


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, small_networks())
    cut = tmp_path / "cut.npz"
    cut.write_bytes(path.read_bytes()[:900])
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "empty.npz").touch()
    for name in ("cut.npz", "array.npy", "empty.npz"):
        with pytest.raises(InputError, match=f"{name}: not an .npz file of plain arrays, or damaged"):
            read_measured(tmp_path / name)
    with pytest.raises(InputError, match=r"found a folder, expected an \.npz file"):
        read_measured(tmp_path)


def test_implausible_materials_are_dropped_with_a_reason(tmp_path: Path) -> None:
    arrays = small_networks()
    arrays["b3"][1] = 1.0  # a BRDF of over 1.7 / sr
    kept = read_measured(write(tmp_path, arrays))
    assert kept.names == ("first", "third")
    assert list(kept.dropped) == ["second"]
    assert kept.dropped["second"].startswith("too bright: it reflects")
    # The others are as they were.
    normals, lights = random_configurations(1, 9)
    torch.testing.assert_close(
        shade(kept.as_measured(["third"]), normals, lights),
        shade(read_measured(write(tmp_path, small_networks())).as_measured(["third"]), normals, lights),
    )

    arrays["b3"][0] = -1.0
    arrays["W1"][2, 3] = 20.0
    with pytest.raises(
        InputError, match="none of its 3 materials is plausible; 'first' is black under 100 %"
    ):
        read_measured(write(tmp_path, arrays))
    arrays["b3"][0] = small_networks()["b3"][0]
    assert read_measured(write(tmp_path, arrays)).dropped["third"].startswith("not reciprocal: ")

    arrays["W1"][1] = np.finfo(np.float32).max
    arrays["W2"][1] = np.finfo(np.float32).max
    assert (
        read_measured(write(tmp_path, arrays)).dropped["second"]
        == "too bright: it reflects nan % of the light"
    )


def test_merl_is_plausible_but_for_a_few(merl: MeasuredLibrary) -> None:
    # Mirrors, whose BRDF spans seven decades: off the highlight a small network knows little.
    assert set(merl.dropped) == {"black-obsidian", "brass", "chrome-steel", "grease-covered-steel", "ss440"}
    assert len(merl.names) == 95
    assert merl.albedos.min() > 0
    assert merl.albedos.max() < 0.45
    assert (merl.brightest >= merl.albedos).all()
    assert merl.brightest.max() <= 1.1
    generator = torch.Generator().manual_seed(0)
    shaded = shade(
        merl.draw(2000, generator), draw_visible_normals(2000, generator), random_configurations(1, 50)[1]
    )
    assert torch.isfinite(shaded).all()
    assert (shaded >= 0).all()


@pytest.mark.parametrize(
    "name", ["chrome", "steel", "tungsten-carbide", "aluminium", "nickel", "white-acrylic"]
)
def test_merl_s_shiny_materials_are_brightest_at_the_mirror_direction(
    merl: MeasuredLibrary, name: str
) -> None:
    view = math.radians(40)
    lights = torch.deg2rad(torch.arange(-80.0, 81.0))
    # Light and view in one plane with the normal; the mirror direction is at -40 degrees.
    shaded = merl.as_measured([name]).shade(
        lights.cos()[None], torch.tensor([[math.cos(view)]]), (lights - view).cos()
    )
    assert math.degrees(lights[shaded[0].argmax()].item()) == pytest.approx(-40, abs=1.5)
    assert shaded.max() > 20 * shaded.median()


@pytest.mark.parametrize("name", ["white-diffuse-bball", "pure-rubber", "neoprene-rubber", "violet-rubber"])
def test_merl_s_matte_materials_are_nearly_lambertian(merl: MeasuredLibrary, name: str) -> None:
    material = merl.as_measured([name])
    normals, lights = random_configurations(300, 100)
    cosine = normals @ lights.T
    steep = (cosine > 0.5) & (normals[:, 2:] > 0.5)
    ratio = shade(material.take(torch.zeros(300, dtype=torch.int64)), normals, lights)[steep] / cosine[steep]
    # A soft lobe is in all of them; the bulk is flat and, without the cosine, at the albedo's scale.
    albedo = material.albedo().item()
    assert ratio.median().item() == pytest.approx(albedo, rel=0.15)
    low, high = ratio.quantile(torch.tensor([0.1, 0.9])).tolist()
    assert high / low < 1.5
