"""The network contradicts lights of a rendered ball whose elevations, or whose frame, are wrong."""

import numpy as np
import pytest

from scenes import cap_directions, shade, sphere
from splinecli.capture.arrays import open_arrays
from splinecli.estimate.light_descent import LightWitness
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.recipe.steps import begin, follow
from splinecli.recipe.work import RecipeOptions

OPTIONS = RecipeOptions(asks_network=True, mends=True)


@pytest.fixture(scope="module")
def ball():
    """Return images (F, H, W) of a glossy ball, its mask and its lights."""
    normals, mask = sphere(48)
    lights = cap_directions(12, 55, 4, even=True)
    shaded = 0.6 * shade(normals, lights, gloss=0.5, exponent=60) * mask[..., None]
    return np.moveaxis(shaded, 2, 0), mask, lights


def judged(ball, given, options=OPTIONS):
    images, mask, _ = ball
    source = open_arrays(images, given, mask, light_intensities=np.ones(12))
    return follow(begin(source, None, options), until="refinement").made


def test_right_lights_are_kept(ball):
    capture = judged(ball, ball[2])
    codes = {each.code for each in capture.warnings}
    assert not codes & {"lights_mended", "lights_uncertain"} and not capture.mended


def test_wrong_elevations_are_corrected(ball):
    given = unit(ball[2] * (1, 1, 0.45))
    capture = judged(ball, given)
    assert "lights_mended" in [each.code for each in capture.warnings]
    left = angle_between_deg(capture.light_directions, ball[2]).mean()
    assert left < 0.4 * angle_between_deg(given, ball[2]).mean()


def test_pixels_that_are_black_under_all_lights_do_not_disturb_the_descent(ball):
    images, mask, lights = ball
    observations = images[:, mask].T.copy()
    observations[::5] = 0
    given = unit(lights * (1, 1, 0.5))
    fall, moved_deg = LightWitness.of(observations, mask, given).descend(intensities_known=True)
    assert fall > 0.3 and np.isfinite(moved_deg)
