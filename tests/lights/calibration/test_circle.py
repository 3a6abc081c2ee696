"""Circles from masks and in pictures."""

import numpy as np

from scenes import parametrize, refuses
from splinecli.lights.calibration.circle import Circle, circle_from_mask, find_circles

TRUE = Circle(103.3, 88.7, 61.4)


def assert_close(found, true, pixels):
    differences = (found.x - true.x, found.y - true.y, found.radius - true.radius)
    assert max(map(abs, differences)) < pixels


@parametrize("with_stand", [False, True])
def test_circle_of_a_mask(with_stand):
    """A stand and specks do not move the circle."""
    mask = TRUE.inside((180, 210))
    if with_stand:
        mask[130:, 90:118] = mask[5:8, 5:8] = True
    found = circle_from_mask(mask)
    assert_close(found, TRUE, 0.4 if with_stand else 0.2)
    assert 0.5 < found.visible < 0.9 if with_stand else found.visible > 0.98 and found.spread < 0.5


def test_a_mask_cut_off_by_the_frame_keeps_its_circle():
    beyond = Circle(40.0, 88.7, 61.4)
    found = circle_from_mask(beyond.inside((180, 210)))
    assert_close(found, beyond, 0.4)
    assert found.reaches_beyond((180, 210))
    assert not TRUE.reaches_beyond((180, 210))


def test_masks_and_pictures_that_are_no_ball():
    for mask in (np.ones((50, 60), np.bool_), np.pad(np.ones((20, 120), np.bool_), 30)):
        with refuses("expected a ball"):
            circle_from_mask(mask)
    with refuses("found no circle"):
        find_circles(np.tile(np.linspace(0, 1, 200), (150, 1)))


@parametrize(("ball", "wall"), [(0.1, 0.9), (0.9, 0.1), (0.01, 0.02)])
@parametrize("scale", [1, 6])
def test_circle_in_a_picture(ball, wall, scale, rng):
    true = Circle(scale * TRUE.x, scale * TRUE.y, scale * TRUE.radius)
    shape = (180 * scale, 210 * scale)
    picture = np.where(true.inside(shape), ball, wall)
    picture += rng.normal(0, 0.02 * abs(ball - wall), shape)
    found = find_circles(picture.clip(0))[0]
    assert_close(found, true, 0.5 * max(1, scale / 3))
    assert found.visible > 0.9


def test_normals_of_the_ball():
    normals = Circle(10, 20, 5).normals(np.array([10.0, 13, 10, 16]), np.array([20.0, 20, 16, 20]))
    np.testing.assert_allclose(normals[:3], [(0, 0, 1), (0.6, 0, 0.8), (0, 0.8, 0.6)], atol=1e-12)
    assert np.isnan(normals[3]).any()
