"""The blur of a lens, estimated and removed. The oracles are images of which the blur, or the sharp
image, is known.
"""

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from scenes import ball, parametrize, shade, sphere_cap, spiral_lights
from splinecli.capture.arrays import open_arrays
from splinecli.images.lens_blur import remove_blur, surroundings
from splinecli.recipe import RecipeOptions, prepare_capture

SIDE, FINER = 96, 4
WHOLE = np.ones((SIDE, SIDE), np.bool_)
NONE = np.zeros_like(WHOLE)


def discs():
    """Eight images (F, H, W) of bright discs in different places before gray, with the true
    coverage of each pixel.
    """
    rng = default_rng(0)
    images = np.full((8, FINER * SIDE, FINER * SIDE), 0.2, np.float32)
    for image in images:
        for _ in range(12):
            middle, radius = (
                rng.integers(20, FINER * SIDE - 20, 2).tolist(),
                int(rng.integers(20, 60)),
            )
            cv2.circle(image, middle, radius, 0.8, -1)
    return np.asarray(images.reshape(8, SIDE, FINER, SIDE, FINER).mean(axis=(2, 4)), np.float32)


def blurred(images, sigma):
    return np.stack(
        [cv2.GaussianBlur(image, (0, 0), sigma) if sigma else image for image in images]
    )


def removed(images):
    observations = np.ascontiguousarray(images.reshape(len(images), -1).T)
    sigma = remove_blur(observations, WHOLE, NONE)
    return observations.T.reshape(images.shape), sigma


@parametrize("sigma", [0.5, 0.7, 1.0])
@parametrize("noise", [0.0, 0.01])
def test_a_blur_is_found_and_removed(sigma, noise):
    sharp = discs()
    soft = blurred(sharp, sigma) + np.float32(noise) * default_rng(1).normal(size=sharp.shape)
    found, estimate = removed(np.float32(soft))
    assert estimate == approx(sigma, abs=0.2)
    before, after = (np.sqrt(np.square(images - sharp).mean()) for images in (soft, found))
    assert after < before * (0.75 if noise == 0 else 1.1)


@parametrize("noise", [0.0, 0.01])
def test_sharp_images_stay_as_they_are(noise):
    images = np.float32(discs() + noise * default_rng(1).normal(size=(8, SIDE, SIDE)))
    found, estimate = removed(images)
    assert estimate is None
    assert_array_equal(found, images)


def test_fine_texture_stays_as_it_is():
    """Each pixel has an albedo of its own."""
    rng = default_rng(2)
    images = np.float32(rng.uniform(0.2, 1, (SIDE, SIDE)) * rng.uniform(0.3, 0.8, (8, 1, 1)))
    assert removed(images)[1] is None


@parametrize("gloss", [0.0, 0.5])
def test_images_without_edges_stay_as_they_are(gloss):
    """Shading alone looks like the widest blur."""
    shading = shade(sphere_cap(SIDE), spiral_lights(8, 60), gloss=gloss)
    assert removed(np.float32(np.moveaxis(shading, 2, 0)))[1] is None
    assert removed(np.full((8, SIDE, SIDE), 0.5, np.float32))[1] is None


def test_only_the_object_and_what_surrounds_it_is_needed():
    """The observations of a disc are the same from the whole images as from a mask and the pixels
    around it.
    """
    images = blurred(discs(), 0.7)
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    mask = np.hypot(x, y) < SIDE / 3
    around = surroundings(mask)
    assert not (mask & around).any()
    part = np.concatenate((images[:, mask], images[:, around]), axis=1).T.copy()
    assert remove_blur(part, mask, around) == approx(0.7, abs=0.2)
    assert np.array_equal(part[mask.sum() :].T, images[:, around])
    far = np.where(mask | around, images, 7)  # the filter must not see these
    other = np.concatenate((far[:, mask], far[:, around]), axis=1).T.copy()
    remove_blur(other, mask, around)
    assert_array_equal(part, other)


@pytest.mark.parametrize(("sigma", "soft"), [(0.0, 0), (0.7, 0), (1.0, 0), (2.0, 1), (4.0, 1)])
def test_images_out_of_focus_are_named(sigma, soft):
    """A matte ball before black, whose outline and attached shadows are the only edges."""
    lights = spiral_lights(10, 60)
    normals, mask = ball((SIDE, SIDE), 47.5, 47.5, 38)
    images = np.moveaxis(shade(normals, lights) * mask[..., None], 2, 0)
    images = blurred(images, sigma) + 0.002 * np.random.default_rng(1).normal(size=images.shape)
    capture = prepare_capture(open_arrays(images.clip(0), lights, mask))
    assert [each.code for each in capture.warnings].count("soft_images") == soft


def test_values_outside_the_mask_may_be_no_light():
    images = blurred(discs(), 0.7)
    mask = np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE // 2)) < SIDE / 3
    lights = np.array([(np.cos(angle), np.sin(angle), 1.5) for angle in np.linspace(0, 5, 8)])
    images[3, ~mask] = np.nan
    images[4, ~mask] = -1
    capture = prepare_capture(open_arrays(images, lights, mask, light_intensities=np.ones(8)))
    assert capture.observations.shape == (mask.sum(), 8)
    assert np.isfinite(capture.observations).all() and capture.observations.min() >= 0


def test_stored_values_stay_as_they_are():
    images = blurred(discs(), 0.7)
    lights = np.array([(np.cos(angle), np.sin(angle), 1.5) for angle in np.linspace(0, 5, 8)])
    capture = prepare_capture(
        open_arrays(images, lights, light_intensities=np.ones(8)),
        options=RecipeOptions(as_stored=True),
    )
    assert capture.removed_blur is None
    assert_allclose(capture.observations, images.reshape(8, -1).T, rtol=1e-5)
    sharpened = prepare_capture(open_arrays(images, lights, light_intensities=np.ones(8)))
    assert_allclose(sharpened.observations.T.reshape(images.shape), removed(images)[0], atol=1e-4)
