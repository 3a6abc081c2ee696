"""Colours and intensities of lamps that are estimated from images, against scenes where they are
known.
"""

import re

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from scenes import (
    codes,
    parametrize,
    shade,
    sphere,
    sphere_cap,
    spiral_lights,
    tilted,
    vectors,
    write_capture,
)
from splinecli.capture.arrays import open_arrays
from splinecli.capture.near_lamps import NearLamps
from splinecli.capture.reader import CaptureOptions, open_capture
from splinecli.images.lamps import estimate_light_intensities, turn_by_intensities_deg
from splinecli.lights.draws import draw_lights
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import fit_scaled_normals
from splinecli.recipe import RecipeOptions, prepare_capture
from splinecli.results.map_values import albedo_map

LIGHTS = spiral_lights(10, 50, 15)
SOFT = np.tile(vectors("1.5 0.8 0.7; 0.7 1.5 0.8; 0.8 0.7 1.5; 1 1 1; 1.3 1.3 0.4"), (2, 1))
PURE = np.tile(vectors("1 0 0; 0 1 0; 0 0 1; 1 1 1; 1 1 0"), (2, 1))


def striped(colours):
    """Return 16-bit images (F, H, W, 3) of a ball with stripes, its normals (H, W,
    3) and its mask.
    """
    normals, mask = sphere(48, 0.9)
    stripes = vectors("0.9 0.2 0.2; 0.2 0.8 0.3; 0.2 0.3 0.9; 0.7 0.7 0.7")[np.arange(48) // 4 % 4]
    shaded = np.where(mask[..., None], shade(normals, LIGHTS), 0)
    images = np.einsum("hwf,wc,fc->fhwc", shaded, stripes, colours)
    noise = default_rng(0).normal(0, 0.002, images.shape)
    return (
        np.uint16(np.rint((images / images.max() + noise).clip(0, 1) * 60_000)),
        normals,
        mask,
    )


def error_deg(observations, normals, mask):
    lit = observations.min(axis=1) > 0.02
    fitted = unit(fit_scaled_normals(observations[lit], np.ones_like(observations[lit]), LIGHTS))
    return float(angle_between_deg(fitted, normals[mask][lit]).mean())


def test_colours_are_divided_out(tmp_path):
    images, normals, mask = striped(SOFT)
    folder = write_capture(tmp_path, images, LIGHTS, mask=mask, intensities=np.ones((10, 3)))
    source = open_capture(folder)
    capture = prepare_capture(source)
    for untouched in (
        prepare_capture(source, options=RecipeOptions(as_stored=True)),
        prepare_capture(open_capture(folder, CaptureOptions(intensities="equal"))),
    ):
        assert untouched.estimated_colours is None
        assert "estimated_colours" not in codes(untouched)
    assert "estimated_colours" in codes(capture)
    ratios = capture.estimated_colours / SOFT
    assert_allclose(ratios / ratios.mean(axis=0), np.ones((10, 3)), atol=0.1)
    plain = np.float32(images[:, mask].mean(axis=2).T)
    assert (
        error_deg(capture.observations, normals, mask)
        < 2
        < 5
        < error_deg(plain / plain.max(), normals, mask)
    )
    # Lamps of any colour give the same object the same colours.
    normal_map = np.float32(np.where(mask[..., None], normals, 0))
    albedo = albedo_map(source, capture, normal_map)[mask]
    red = albedo / albedo.sum(axis=1, keepdims=True)
    stripe = np.nonzero(mask)[1] // 4 % 4 == 0
    assert np.std(red[stripe][:, 0]) < 0.03
    from_arrays = prepare_capture(open_arrays(images, LIGHTS, mask, light_intensities=np.ones(10)))
    assert_allclose(from_arrays.observations, capture.observations, rtol=1e-4, atol=1e-5)


def test_pure_colours_are_named():
    images, _, mask = striped(PURE)
    codes = {
        warning.code: warning
        for warning in prepare_capture(open_arrays(images, LIGHTS, mask)).warnings
    }
    assert "light_colours" in codes and codes["light_colours"].error_deg


def test_a_gray_object_needs_no_colours():
    normals, mask = sphere(48, 0.9)
    shaded = np.where(mask[..., None], shade(normals, LIGHTS), 0)
    images = np.uint16(np.rint(np.einsum("hwf,fc->fhwc", shaded, PURE) * 40_000))
    capture = prepare_capture(open_arrays(images, LIGHTS, mask, light_intensities=np.ones(10)))
    assert not {"light_colours", "estimated_colours"} & set(codes(capture))


@parametrize("change", [0.0, 0.03])
def test_white_lamps_are_left_alone(change):
    colours = 1 + change * default_rng(1).normal(size=(10, 3))
    images, _, mask = striped(colours)
    assert prepare_capture(open_arrays(images, LIGHTS, mask)).estimated_colours is None


INTENSITIES = np.array([0.5, 1.0, 1.6, 0.8, 1.2, 0.7, 1.4, 0.9])


def lights(count):
    return spiral_lights(count, 50, 18)


def textured_sphere(directions, *, shine=0.0):
    """Observations (P, F) of a sphere with attached shadows, random albedo, noise, and highlights
    if any.
    """
    rng = default_rng(5)
    normals, inside = sphere(50, 0.95)
    matte = shade(normals[inside], directions)
    highlights = shade(normals[inside], directions, gloss=shine, exponent=40) - matte
    seen = matte * rng.uniform(0.2, 1, (len(matte), 1)) + highlights
    return seen * rng.normal(1, 0.01, seen.shape).clip(0.9, 1.1)


@parametrize("n_lights, shine", [(6, 0.0), (8, 0.0), (8, 0.5)])
def test_unequal_lights_are_estimated(n_lights, shine):
    directions, intensities = lights(n_lights), INTENSITIES[:n_lights]
    observations = np.float32(textured_sphere(directions, shine=shine) * intensities)
    found = estimate_light_intensities(observations, None, directions)
    assert found.mean() == approx(1)
    assert_allclose(found, intensities / intensities.mean(), rtol=0.02)
    assert turn_by_intensities_deg(observations, found, directions) < 1


@parametrize("shine", [0.0, 0.5, 3.0])
def test_equal_lights_are_left_alone(shine):
    directions = lights(8)
    assert (
        estimate_light_intensities(
            np.float32(textured_sphere(directions, shine=shine)), None, directions
        )
        is None
    )


def test_scenes_that_do_not_determine_intensities():
    eight = textured_sphere(lights(8)) * INTENSITIES
    never = eight * (np.arange(8) != 3)  # a lamp that did not flash
    for observations in (
        textured_sphere(lights(4)) * INTENSITIES[:4],
        eight[:40],
        np.zeros((500, 8)),
        never,
    ):
        directions = lights(observations.shape[1])
        assert estimate_light_intensities(np.float32(observations), None, directions) is None


@parametrize("widths", [None, 3.0])
@parametrize("tilt", [0.0, 0.05])
def test_flat_objects(widths, tilt):
    """A relief whose slopes are around one tenth: with estimated intensities, normals are right but
    for the tilt.
    """
    rng, size, directions = default_rng(1), 40, lights(8)
    y, x = np.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    slopes = (0.1 * np.cos(7 * x + 2 * y) + tilt, 0.1 * np.sin(6 * y))
    normals = tilted(*slopes).reshape(-1, 3)
    vectors = np.broadcast_to(directions, (size**2, 8, 3))
    if widths is not None:
        lamps = NearLamps.of(directions * widths * size, 1.0, (size, size), equal=True)
        towards, attenuation = lamps.light_at(
            lamps.plane_points(*np.divmod(np.arange(size**2), size))
        )
        vectors = towards * attenuation[..., None]
    shaded = np.einsum("pfc,pc->pf", vectors, normals) * rng.uniform(0.3, 1, (size**2, 1))
    observations = np.float32(shaded * INTENSITIES * rng.normal(1, 0.005, shaded.shape))
    found = estimate_light_intensities(observations, None, lambda rows: vectors[rows])

    def error_deg(intensities):
        fit = fit_scaled_normals(observations / intensities, np.ones_like(observations), vectors)
        return angle_between_deg(fit, normals).mean()

    # The images leave the tilt open, which 0.05 makes 3 degrees.
    assert error_deg(found) < 3 + 60 * tilt < 0.5 * error_deg(np.ones(8))
    assert turn_by_intensities_deg(observations, found, lambda rows: vectors[rows]) > 1
    assert estimate_light_intensities(np.float32(shaded), None, lambda rows: vectors[rows]) is None


def test_saturated_observations_do_not_count():
    directions = lights(8)
    truth = textured_sphere(directions) * INTENSITIES
    stored = np.float32(np.minimum(truth, 0.6))
    found = estimate_light_intensities(stored, truth >= 0.6, directions)
    assert_allclose(found, INTENSITIES / INTENSITIES.mean(), rtol=0.05)


def test_a_capture_without_a_file_of_intensities(tmp_path):
    directions = lights(8)
    shaded = np.moveaxis(shade(sphere_cap(40, 0.6), directions) * INTENSITIES, 2, 0)
    write_capture(tmp_path, np.uint16(np.rint(30_000 * shaded)), directions)
    source = open_capture(tmp_path)
    plain, restored = (
        prepare_capture(source, options=RecipeOptions(as_stored=True)),
        prepare_capture(source),
    )
    assert plain.estimated_intensities is None
    low, high = INTENSITIES.min() / INTENSITIES.mean(), INTENSITIES.max() / INTENSITIES.mean()
    (warning,) = (
        warning for warning in restored.warnings if warning.code == "estimated_intensities"
    )
    stated = [float(number) for number in re.findall(r"\d\.\d\d", str(warning))]
    assert stated == approx([low, high], abs=0.02)
    assert_allclose(restored.estimated_intensities, INTENSITIES / INTENSITIES.mean(), rtol=0.02)
    assert_allclose(
        restored.observations, plain.observations / restored.estimated_intensities, rtol=1e-5
    )
    some = restored.choose_lights([6, 0, 2])
    assert_array_equal(some.estimated_intensities, restored.estimated_intensities[[6, 0, 2]])
    # Given intensities replace estimates.
    np.savetxt(tmp_path / "light_intensities.txt", np.ones((8, 3)))
    assert prepare_capture(open_capture(tmp_path)).estimated_intensities is None
    for word in ("equal", "estimate"):
        found = prepare_capture(open_capture(tmp_path, CaptureOptions(intensities=word)))
        assert (found.estimated_intensities is None) == (word == "equal")


@parametrize("name", "ballPNG catPNG")
def test_real_objects_whose_lights_were_measured(shared_data, name):
    """Ten of DiLiGenT's lights, of which the strongest is four to six times the weakest."""
    source = open_capture(shared_data / "DiLiGenT/pmsData" / name)
    capture = prepare_capture(source)
    measured = source.light_intensities.mean(axis=1)
    for chosen in draw_lights(capture.light_directions, 10, trials=3, seed=0):
        order, directions = list(chosen), capture.light_directions[list(chosen)]
        observations = np.float32(capture.observations[:, order] * measured[order])
        found = estimate_light_intensities(observations, None, directions)
        ratio = np.log(found / measured[order])
        # Taken for equal, they would be off by 0.4 to 0.5.
        assert np.std(ratio) < 0.06
