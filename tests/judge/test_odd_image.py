"""An image that contradicts the others, or a ground truth that was moved, is found; right ones are
not doubted.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

import scenes
from scenes import parametrize, spiral_lights
from splinecli.capture.light_rows import parse_light_frame
from splinecli.capture.sample import sample_observations
from splinecli.judge.light_check import check_lights
from splinecli.judge.odd_images import check_ground_truth, find_odd_image
from splinecli.lights.light_fit import find_factors
from splinecli.maths.normals import unit

Array = NDArray[np.float64]
ODD = 4
LIGHTS = spiral_lights(10, 55, 12)


def sphere():
    """Normals (P, 3) and mask of a sphere."""
    normals, inside = scenes.sphere(64)
    return normals[inside], inside


def shade(normals, light_directions, shine=0.3):
    """Lambert's cosine with attached shadows, a highlight and one part in a hundred of noise."""
    return scenes.shade(normals, light_directions, gloss=shine, noise=0.01)


def find(observations, *, intensities_known=True):
    factors = find_factors(observations, intensities_known=intensities_known)
    return find_odd_image(factors, LIGHTS)


def tilted(direction, degrees):
    """Return a unit vector at this angle to the direction, nearer to the camera."""
    across = np.array((0.0, 0.0, 1.0)) - direction[2] * direction
    across /= np.linalg.norm(across)
    return np.asarray(
        np.cos(np.radians(degrees)) * direction + np.sin(np.radians(degrees)) * across
    )


@parametrize("shine", [0.0, 0.3, 1.0])
@parametrize("known", [True, False])
def test_right_images_are_not_odd(shine, known):
    assert find(shade(sphere()[0], LIGHTS, shine), intensities_known=known) is None


def test_a_dimmed_image_is_odd_where_intensities_are_known():
    observations = shade(sphere()[0], LIGHTS)
    observations[:, ODD] *= 0.5
    odd = find(observations)
    assert odd is not None and odd.place == ODD
    # The highlights are no part of the matte prediction, so the factor is not exact.
    assert odd.brightness == pytest.approx(0.5, abs=0.03)
    assert odd.left < 0.2
    assert find(observations, intensities_known=False) is None, "lamps may differ"


def test_the_other_images_are_judged_without_the_odd_one():
    normals, mask = sphere()
    observations = shade(normals, LIGHTS)
    observations[:, ODD] *= 0.2
    for signs, frame in (((1, 1, 1), None), ((1, -1, 1), parse_light_frame("y-down"))):
        check = check_lights(observations, mask, LIGHTS * signs)
        assert check.odd_image is not None and check.odd_image.place == ODD
        assert check.order is None
        assert (check.best and check.best.frame) == frame


@parametrize("known", [True, False])
@parametrize("fault", ["a moved light", "another object", "half in shadow"])
def test_each_fault_of_an_image_is_odd(fault, known):
    normals, lights = sphere()[0], LIGHTS.copy()
    if fault == "a moved light":
        lights[ODD] = tilted(lights[ODD], -40)
    observations = shade(normals, lights)
    if fault == "another object":
        other = unit(
            np.stack((-0.8 * normals[:, 1], 0.6 * normals[:, 0], np.ones(len(normals))), axis=1)
        )
        observations[:, ODD] = shade(other, LIGHTS)[:, ODD]
    elif fault == "half in shadow":
        observations[normals[:, 1] > 0.1, ODD] *= 0.2
    odd = find(observations, intensities_known=known)
    assert odd is not None and odd.place == ODD


@parametrize(("side", "gloss"), [(56, 0.0), (56, 0.2), (320, 0.0)])
def test_a_shifted_ground_truth(side, gloss):
    normals, mask = scenes.sphere(side)
    sample = sample_observations(
        scenes.shade(normals[mask], LIGHTS, gloss=gloss, noise=0.003), mask
    )
    truth = np.float32(np.where(mask[..., None], normals, 0))
    assert check_ground_truth(sample, LIGHTS, truth) == []
    by = sample.step * round(3 * side / 56 / sample.step)
    (warning,) = check_ground_truth(sample, LIGHTS, np.roll(truth, (-by, by), (0, 1)))
    assert warning.code == "ground_truth_shifted" and warning.error_deg is None
    assert f"a shift of {by} pixels right and {by} pixels up is undone" in warning.text


def test_tilted_lights_are_no_shift():
    """They turn the normals of a ball nearly as a shift does."""
    normals, mask = scenes.sphere(56)
    sample = sample_observations(scenes.shade(normals[mask], LIGHTS, noise=0.003), mask)
    cosine, sine = np.cos(np.radians(5)), np.sin(np.radians(5))
    tilted = LIGHTS @ np.array(((cosine, 0, -sine), (0, 1, 0), (sine, 0, cosine)))
    assert check_ground_truth(sample, tilted, np.where(mask[..., None], normals, 0)) == []
