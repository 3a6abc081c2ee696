"""A ground truth that was moved by a known amount is named; right ones and tilted lights are not."""

import numpy as np
import pytest

from scenes import shade, sphere, spiral_lights
from splinecli.diagnosis.odd_images import check_ground_truth
from splinecli.diagnosis.summary import sample_observations

LIGHTS = spiral_lights(10, 55, 12)


@pytest.mark.parametrize(("side", "gloss"), [(56, 0.0), (56, 0.2), (320, 0.0)])
def test_a_shifted_ground_truth(side: int, gloss: float) -> None:
    normals, mask = sphere(side)
    sample = sample_observations(shade(normals[mask], LIGHTS, gloss=gloss, noise=0.003), mask)
    truth = np.where(mask[..., None], normals, 0).astype(np.float32)
    assert check_ground_truth(sample, LIGHTS, truth) == []
    by = sample.step * round(3 * side / 56 / sample.step)
    (warning,) = check_ground_truth(sample, LIGHTS, np.roll(truth, (-by, by), (0, 1)))
    assert warning.code == "ground_truth_shifted" and warning.error_deg is None
    assert f"a shift of {by} pixels right and {by} pixels up is undone" in warning.text


def test_tilted_lights_are_no_shift() -> None:
    """They turn the normals of a ball nearly as a shift does."""
    normals, mask = sphere(56)
    sample = sample_observations(shade(normals[mask], LIGHTS, noise=0.003), mask)
    cosine, sine = np.cos(np.radians(5)), np.sin(np.radians(5))
    tilted = LIGHTS @ np.array(((cosine, 0, -sine), (0, 1, 0), (sine, 0, cosine)))
    assert check_ground_truth(sample, tilted, np.where(mask[..., None], normals, 0)) == []
