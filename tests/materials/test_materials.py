"""Materials of spheres shaded by an independent implementation of Lambert's law and GGX."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from cli.test_schema import check
from distributions import seeded
from glb_file import read_glb
from scenes import (
    cap_directions,
    codes,
    decode_rgb,
    halfway,
    parametrize,
    read_image,
    read_json,
    refuses,
    sphere,
    to_uint16,
    write_capture,
)
from splinecli import estimate_material
from splinecli.errors import UsageError
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.evaluation.figures import likeness
from splinecli.lights.lighting import PixelLighting
from splinecli.materials import maps
from splinecli.materials.maps import render_gray
from splinecli.materials.material_net import material_networks
from splinecli.pipeline.evaluate import evaluate_captures
from splinecli.pipeline.infer import infer_capture
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.integrate import integrate_normal_map
from splinecli.pipeline.options import EvaluateOptions, IntegrateOptions
from splinecli.recipe import read_capture
from splinecli.records.output_files import MAPS
from splinecli.results.maps import map_files
from splinecli.results.material import material_facts, material_warnings
from splinecli.workshop.synthesis.pixels import PixelGenerator, PixelGeneratorConfig

SIZE = 48
LIGHTS = cap_directions(12, 60, seed=4, even=True)
NORMAL_MAP, MASK = sphere(SIZE, 0.9)
NORMALS = NORMAL_MAP[MASK].astype(np.float32)
SURE = np.full(len(NORMALS), 0.999, np.float32)


def ggx_sphere(lights, *, diffuse, f0, roughness):
    """Radiance (P, F) times pi of a Lambertian base under GGX facets (Walter et al., EGSR 2007),
    without Fresnel.
    """
    alpha = roughness**2
    n_l, n_h = ((NORMALS @ each.T).clip(0) for each in (lights, halfway(lights)))
    n_v = NORMALS[:, 2:]
    facets = alpha**2 / (np.pi * (n_h**2 * (alpha**2 - 1) + 1) ** 2)

    def masking(cosine):
        return 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2) + 1e-12)

    specular = facets * masking(n_l) * masking(n_v) / np.maximum(4 * n_l * n_v, 1e-9)
    return np.float32(n_l * (np.asarray(diffuse).reshape(-1, 1) + np.pi * f0 * specular))


def material(observations, lights=LIGHTS, colours=None):
    return maps.estimate_material(
        MASK,
        NORMALS,
        lights,
        lambda pixels: PixelLighting(observations[pixels], lights),
        normal_confidence=SURE,
        colours=colours,
    )


@parametrize(("roughness", "diffuse"), [(0.35, 0.5), (0.5, 0.3)])
def test_a_dielectric_sphere(roughness, diffuse):
    found = material(ggx_sphere(LIGHTS, diffuse=diffuse, f0=0.04, roughness=roughness))
    assert abs(np.median(found.roughness) - roughness) < 0.08
    assert found.metalness.max() < 0.1
    # by definition of the exposure
    assert np.median(found.specular) == approx(0.5, rel=0.05)
    # With f0 = 0.04, the exposure and the base are absolute, as exact as the reflectance of the
    # facets. A broad highlight on a bright base does not determine it.
    assert found.exposure == approx(1, abs=0.3)
    assert np.median(found.base_colour) * found.exposure == approx(diffuse, rel=0.05)
    assert np.quantile(np.abs(found.base_colour / np.median(found.base_colour) - 1), 0.8) < 0.1


@parametrize("roughness", [0.35, 0.6])
def test_a_metal_sphere(roughness):
    found = material(ggx_sphere(LIGHTS, diffuse=0.0, f0=0.8, roughness=roughness))
    assert abs(np.median(found.roughness) - roughness) < 0.08
    assert (found.metalness > 0.5).mean() > 0.98
    assert found.base_colour.max() < 1.2


def test_paint_in_two_colours_has_one_gloss():
    """White highlights do not tint the base colour."""
    left = NORMALS[:, 0] < 0
    paint = np.where(left[:, None], (0.6, 0.2, 0.1), (0.1, 0.3, 0.5))
    channels = [ggx_sphere(LIGHTS, diffuse=paint[:, c], f0=0.04, roughness=0.4) for c in range(3)]
    colours = [
        np.stack([channel[:, place] for channel in channels], axis=1)
        for place in range(len(LIGHTS))
    ]
    found = material(np.mean(channels, axis=0), colours=colours)
    assert not found.is_gray
    assert np.abs(found.roughness - 0.4).mean() < 0.08
    tint = found.base_colour / found.base_colour.mean(axis=1, keepdims=True)
    assert np.quantile(np.abs(tint - paint / paint.mean(axis=1, keepdims=True)), 0.95) < 0.05


def test_units_and_order_of_lights():
    """Seven times the light is seven times the exposure, and nothing else; the order of the lights
    does not count.
    """
    observations = ggx_sphere(LIGHTS, diffuse=0.4, f0=0.05, roughness=0.4)
    plain, bright = material(observations), material(7 * observations)
    turned = material(observations[:, ::-1].copy(), LIGHTS[::-1])
    assert bright.exposure == approx(7 * plain.exposure, rel=1e-3)
    for name in ("base_colour", "roughness", "metalness", "specular", "confidence"):
        assert_allclose(getattr(bright, name), getattr(plain, name), atol=1e-3)
        assert_allclose(getattr(turned, name), getattr(plain, name), atol=1e-3)


def test_generated_pixels_that_training_did_not_use():
    """The confidence is the probability that the roughness is wrong by at most 0.1. Training used
    other seeds.

    A constant roughness is wrong by 0.24 on average, and a constant kind right for 65 %.
    """
    network, material_net = material_networks()
    drawn = PixelGenerator(PixelGeneratorConfig(capture_pixels=64), seeded(8))
    rows = []
    with torch.inference_mode():
        for _ in range(6):
            batch = drawn.draw(1024)
            pixels, context = network.encode_pixels(
                batch.observations, batch.light_directions, batch.valid, captures=batch.captures
            )
            gloss, _ = material_net(pixels, context.brightness)
            true = batch.truth.material  # type: ignore[attr-defined]
            wrong = (gloss.roughness - true.roughness[:, 0]).abs()
            is_right = (gloss.metalness > 0.5) == (true.metallic[:, 0] > 0.5)
            confidence = 1 - (-0.1 / gloss.roughness_error).exp()
            rows.append(torch.stack((wrong, is_right, wrong <= 0.1, confidence), dim=1))
    table = torch.cat(rows)
    wrong, is_right, is_near, confidence = table.mean(dim=0)
    assert wrong < 0.16
    assert is_right > 0.85
    assert abs(float(is_near - confidence)) < 0.1  # of 96 captures
    sure = table[:, 3] > 0.8
    assert 0.05 < sure.float().mean() < 0.8
    assert table[sure, 2].mean() > 0.75


@parametrize(
    "confidence, expected",
    [(0.35, ["gray_material", "roughness_undetermined"]), (0.8, ["gray_material"])],
)
def test_roughness_that_the_images_do_not_determine(confidence, expected):
    values = np.tile(np.float32((0.4, 0.4, 0.4, 0.62, 0, 0.5, confidence)), (SIZE, SIZE, 1))
    warnings = material_warnings(material_facts(values, MASK))
    assert codes(warnings) == expected
    if "roughness_undetermined" in expected:
        assert "a median of 0.62" in warnings[-1].text


def test_pictures_under_other_lights():
    """A sharp highlight under 12 lights predicts those under 5 others."""
    others = cap_directions(5, 50, seed=9, even=True)
    found = material(ggx_sphere(LIGHTS, diffuse=0.3, f0=0.06, roughness=0.4))
    truth = ggx_sphere(others, diffuse=0.3, f0=0.06, roughness=0.4)
    pictures = render_gray(found, NORMALS, others, np.ones(truth.shape, bool), SURE)
    matte = 0.3 * np.float32((NORMALS @ others.T).clip(0))
    ours, lambertian = likeness(truth, pictures), likeness(truth, matte)
    assert ours.psnr_db > lambertian.psnr_db + 6
    assert ours.error < 0.06


def test_likeness_of_known_noise():
    photographs = np.linspace(0, 1, 100_000, dtype=np.float32).reshape(-1, 10)
    noise = np.where(np.arange(10) % 2, np.float32(0.01), np.float32(-0.01))
    found = likeness(photographs, photographs + noise)
    assert found.psnr_db == approx(40, abs=0.05)  # 0.01 of white
    assert found.error == approx(0.02, rel=0.01)  # of a mean of 0.5


def test_channels_of_the_pictures():
    values = np.float32((1, 0.5, 0, 0.2, 0.8, 3, 0.4)) * MASK[..., None]
    files = dict(map_files(MAPS["material"], values, MASK, ["tiff"]))
    assert set(files) == set(MAPS["material"].files)
    middle = SIZE // 2, SIZE // 2
    for name, colour in (
        ("metallic_roughness.png", [255, 51, 204]),  # occlusion, roughness, metal
        ("base_colour.png", [255, 188, 0]),  # sRGB of 0.5 is 188
        ("specular.png", [255] * 3),  # 8 bits end at 1
    ):
        assert decode_rgb(files[name])[middle].tolist() == colour
    assert files["specular.npy"][middle] == 3  # type: ignore[index]
    assert not files["roughness.npy"][0, 0]  # type: ignore[index]
    assert not material_facts(values, MASK).gray


@pytest.fixture
def glossy(tmp_path):
    """A gray capture of a glossy sphere."""
    images = np.zeros((len(LIGHTS), SIZE, SIZE))
    images[:, MASK] = ggx_sphere(LIGHTS, diffuse=0.3, f0=0.05, roughness=0.4).T
    stored = to_uint16(images.clip(0, 1) * 65535)
    return write_capture(
        tmp_path / "ball", stored, LIGHTS, mask=MASK, normals=NORMAL_MAP * MASK[..., None]
    )


def infer_material(folder, **options):
    """The report of infer with the maps of the material, in the folder `out` beside the capture."""
    given = {"method": "ls", "maps": ("material",), "output": str(folder.parent / "out")}
    return infer_capture(folder, InferOptions(**given | options))


def test_infer_writes_the_maps_and_a_gloss_for_the_mesh(glossy, tmp_path):
    report = infer_material(glossy, surface=True)
    folder = tmp_path / "out/ball"
    assert report["material"]["gray"]
    assert "gray_material" in codes(report)
    base = np.load(folder / "base_colour.npy")
    assert base.dtype == np.float32
    assert base.shape == (SIZE, SIZE, 3)
    assert (base[..., 0] == base[..., 2]).all()
    stored = read_image(folder / "metallic_roughness.png")[..., ::-1]
    again = tmp_path / "again"
    integrate_normal_map(IntegrateOptions(normals=folder, output=again))
    for place in (folder, again):  # integrate keeps the material
        tree, arrays = read_glb((place / "mesh.glb").read_bytes())
        [shown] = tree["materials"]
        gloss = shown["pbrMetallicRoughness"]
        assert {"baseColorTexture", "metallicRoughnessTexture"} <= set(gloss)
        assert gloss.get("metallicFactor", 1) == 1
        assert gloss.get("roughnessFactor", 1) == 1
        assert_array_equal(arrays["gloss"][MASK], stored[MASK])


def test_coloured_lamps_do_not_tint_gray_images(glossy):
    np.savetxt(glossy / "light_intensities.txt", np.tile((1.2, 1, 0.8), (len(LIGHTS), 1)))
    assert "gray_material" in codes(infer_material(glossy))


def test_colours_of_another_shape_are_refused(glossy):
    estimate = estimate_normals(read_capture(glossy), make_estimator("ls"))
    colours = np.full((len(LIGHTS), SIZE, SIZE, 3), np.float32(0.5))
    for wrong in (colours[..., 0], colours[1:], colours[:, 1:], "images"):
        with refuses(r"expected numbers of shape \(12, 48, 48, 3\)", UsageError):
            estimate_material(estimate, wrong)
    colours[0, SIZE // 2, SIZE // 2] = np.nan
    with refuses("not finite"):
        estimate_material(estimate, colours)


def test_three_lights_are_refused(glossy):
    with refuses("--maps material needs at least 4 lights, found 3"):
        infer_material(glossy, light_indices=(0, 1, 2), as_stored=True)


def test_a_black_capture_has_some_material(tmp_path):
    """Without light there is nothing to know, and no NaN."""
    found = material(np.zeros((len(NORMALS), len(LIGHTS)), np.float32))
    for name in ("base_colour", "roughness", "metalness", "specular", "confidence"):
        assert np.isfinite(getattr(found, name)).all()
    assert found.confidence.max() < 0.1


def relit(folder, n_lights):
    """What evaluate finds of pictures under lights that were held out."""
    options = EvaluateOptions(
        datasets=(folder,),
        methods=("ls",),
        n_lights=(n_lights,),
        trials=1,
        relight=True,
        output=str(folder.parent / "scores"),
    )
    return evaluate_captures(options)


def test_evaluate_compares_with_photographs_that_were_held_out(glossy, tmp_path):
    [found] = relit(glossy, 8).document["relighting"]
    assert found["capture"] == "ball"
    assert found["method"] == "ls"
    assert len(found["lights"]) == 8
    assert found["held_out"] == 4
    assert found["material"]["psnr_db"] > found["lambertian"]["psnr_db"] + 1
    assert found["lambertian"]["psnr_db"] > found["nearest"]["psnr_db"]
    check(read_json(tmp_path / "scores/results.json"), "Results")


def test_relighting_needs_lights_that_are_left(glossy):
    assert relit(glossy, None).figure_problems == [
        "ball: the draw uses all lights, so none is held out. Use a smaller --n-lights."
    ]


def test_unequal_white_balance_changes_the_base_colour_alone(glossy):
    """The gains of a camera's channels are not known, so they tint the base colour."""
    estimate = estimate_normals(read_capture(glossy), make_estimator("ls"))
    images = np.zeros((len(LIGHTS), SIZE, SIZE, 3), np.float32)
    images[:, MASK] = estimate.capture.observations.T[..., None]
    gains = np.array((1.5, 1, 0.5), np.float32)
    white, tinted = estimate_material(estimate, images), estimate_material(estimate, images * gains)
    assert white.is_gray
    assert not tinted.is_gray
    assert_array_equal(tinted.roughness, white.roughness)
    assert_array_equal(tinted.metalness, white.metalness)
    ratio = np.median(tinted.base_colour / white.base_colour, axis=0)
    # white highlights are assumed to be white
    assert_allclose(ratio / ratio[1], gains, atol=0.1)
