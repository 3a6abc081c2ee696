"""Refined lights on made-up pixels, whose true lights are known."""

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from scenes import as_capture, parametrize, refuses
from splinecli.capture.near_lamps import NearLamps
from splinecli.errors import UsageError
from splinecli.lights.light_fit import find_factors, refine_capture, refine_lights, would_refine
from splinecli.maths.normals import angle_between_deg, unit


def rough(lights, sigma_deg, seed=0):
    """Lights with Gaussian errors across each, whose angle has this root mean square."""
    errors = default_rng(seed).normal(scale=np.radians(sigma_deg) / np.sqrt(2), size=lights.shape)
    return unit(lights + errors - (errors * lights).sum(axis=1, keepdims=True) * lights)


def aligned_error_deg(found, true):
    """The mean angle after the best common rotation, which the images leave open."""
    u, _, v = np.linalg.svd(found.T @ true)
    rotation = u @ np.diag((1, 1, np.linalg.det(u @ v))) @ v
    return float(angle_between_deg(unit(found @ rotation), true).mean())


@parametrize("sigma_deg", [4.0, 8.0])
def test_matte_pixels_determine_lights_up_to_a_rotation(sigma_deg, matte_pixels):
    _, lights, observations = matte_pixels
    given = rough(lights, sigma_deg)
    found = refine_lights(np.float32(observations), given, error_deg=sigma_deg)
    assert aligned_error_deg(given, lights) > 0.4 * sigma_deg
    assert aligned_error_deg(found.directions, lights) < 0.1
    # The common rotation is that of the mean of 12 errors.
    assert (
        angle_between_deg(found.directions, lights).mean()
        < 0.7 * angle_between_deg(given, lights).mean()
    )
    assert_allclose(found.intensities, 1, atol=1e-6)


def test_a_light_that_no_pixel_shows_stays(matte_pixels):
    _, lights, observations = matte_pixels
    given, black = rough(lights, 4.0), observations.astype(np.float32)
    black[:, 5] = 0
    found = refine_lights(black, given)
    assert found is not None and np.isfinite(found.directions).all()
    assert angle_between_deg(found.directions, given)[5] < 0.1


def test_unknown_intensities_are_refined_too(matte_pixels):
    _, lights, observations = matte_pixels
    strengths = default_rng(3).uniform(0.85, 1.15, 12)
    given = rough(lights, 4.0)
    found = refine_lights(np.float32(observations * strengths), given, intensities_known=False)
    relative = found.intensities / strengths
    # Nine common factors are open, which the prior alone holds.
    assert np.std(relative / relative.mean()) < 0.8 * np.std(strengths)
    assert (
        angle_between_deg(found.directions, lights).mean() < angle_between_deg(given, lights).mean()
    )


def test_exact_lights_stay(glossy_pixels):
    """Highlights and shadows do not move lights that are right; nothing is taken from too few
    pixels or lights.
    """
    normals, lights, observations = glossy_pixels
    found = refine_lights(np.float32(np.tile(observations, (3, 1))), lights)
    assert found is None or angle_between_deg(found.directions, lights).mean() < 1.0
    matte = (0.5 * (normals @ lights.T).clip(min=0)).astype(np.float32)
    given = rough(lights, 4.0)
    assert refine_lights(np.tile(matte, (3, 1)), given) is not None
    assert refine_lights(matte[:50], given) is None
    assert refine_lights(np.tile(matte, (3, 1))[:, :5], given[:5]) is None


@parametrize("known", [True, False])
def test_refinement_is_suggested_for_rough_lights_alone(known, glossy_pixels):
    _, lights, observations = glossy_pixels
    strengths = 1.0 if known else np.linspace(0.6, 1.4, len(lights))
    observations = np.tile(observations, (3, 1)) * strengths
    factors = find_factors(observations, intensities_known=known)
    assert would_refine(observations, factors, lights) is None
    assert would_refine(observations, factors, rough(lights, 6.0)) is not None
    assert would_refine(observations, None, rough(lights, 6.0)) is None


def test_a_capture_says_what_was_done(matte_pixels):
    _, lights, observations = matte_pixels
    given = rough(lights, 4.0)
    capture = as_capture(observations, given, np.ones((10, 20), bool))
    refined = refine_capture(capture)
    assert refined.warnings[-1].code == "refined_lights"
    assert not np.array_equal(refined.light_directions, given)
    again = refine_capture(refined)
    assert again.warnings[-1].code == "refinement_rejected"
    assert_array_equal(again.light_directions, refined.light_directions)
    with refuses("the light error is 0 degrees", UsageError):
        refine_capture(capture, error_deg=0.0)
    lamps = NearLamps.of(given, 1.0, (10, 20), equal=True)
    with refuses("near lamps", UsageError):
        refine_capture(as_capture(observations, given, capture.mask, lamps=lamps))
