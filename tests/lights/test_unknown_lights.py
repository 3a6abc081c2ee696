"""Lights that are found from the images: analytic spheres, whose lights are known."""

import numpy as np
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from scipy.spatial.transform import Rotation

from scenes import (
    assert_unit,
    cap_directions,
    halfway,
    parametrize,
    refuses,
    ring_lights,
    shade,
    sphere,
    sphere_cap,
    square_grid,
)
from splinecli import estimate_normals
from splinecli.errors import UsageError
from splinecli.estimate.confidence import add_common_error
from splinecli.estimate.light_descent import best_lights
from splinecli.lights import unknown_lights
from splinecli.lights.outline import outline_share, turn_at_outline
from splinecli.lights.unknown_lights import bump_log_odds
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.records.capture_warnings import ESTIMATED_LIGHTS

SIZE = 64
NORMALS, INSIDE = sphere(SIZE)


def lights(count=10, seed=1):
    return cap_directions(count, 55, seed, even=True)


def observed(directions, **gloss):
    return np.float32(shade(NORMALS[INSIDE], directions, noise=0.002, **gloss))


def images_of(observations):
    images = np.zeros((len(observations.T), SIZE, SIZE), np.float32)
    images[:, INSIDE] = observations.T
    return images


def find_lights(observations, mask, intensities_known, **options):
    return unknown_lights.find_lights(observations, mask, intensities_known, best_lights, **options)


def mean_angle(found, true):
    return float(angle_between_deg(found, true).mean())


@parametrize("gloss", [0.0, 0.5])
@parametrize("count", [4, 10, 40])
def test_a_sphere(count, gloss):
    true = lights(count)
    found = find_lights(observed(true, gloss=gloss), INSIDE, True)
    assert found.intensities is None
    assert mean_angle(found.directions, true) < 5
    assert mean_angle(found.directions, true) < 3 * found.errors_deg.mean()
    assert_unit(found.directions)


def test_intensities_are_found_with_the_directions():
    true, intensities = lights(), default_rng(3).uniform(0.7, 1.4, 10)
    intensities /= intensities.mean()
    found = find_lights(observed(true) * np.float32(intensities), INSIDE, False)
    assert found.intensities is not None and found.intensities.mean() == approx(1)
    assert mean_angle(found.directions, true) < 6
    assert np.abs(found.intensities / intensities - 1).mean() < 0.5 * np.abs(intensities - 1).mean()


def test_the_number_of_threads_changes_nothing():
    """Rounding alone could move a light into another cell of an observation map."""
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(find_lights(observed(lights()), INSIDE, True).directions)
    finally:
        torch.set_num_threads(before)
    assert_array_equal(found[1], found[0])
    assert_array_equal(found[2], found[0])


def test_a_turned_camera_turns_the_lights():
    """All eight turns and mirror images are seen, so none is preferred."""
    images = images_of(observed(lights(), gloss=0.3))
    inside = INSIDE.copy()
    inside[: SIZE // 4] = False  # no symmetric outline
    straight = find_lights(np.ascontiguousarray(images[:, inside].T), inside, True)
    turned, turned_inside = np.rot90(images, axes=(1, 2)), np.rot90(inside).copy()
    found = find_lights(np.ascontiguousarray(turned[:, turned_inside].T), turned_inside, True)
    x, y, z = straight.directions.T
    # The sample of pixels that the lights are fitted to differs a little.
    assert mean_angle(found.directions, np.stack((-y, x, z), axis=1)) < 0.5


def test_what_shows_no_object_is_refused():
    n_pixels, rng = int(INSIDE.sum()), default_rng(0)
    normals, disc = sphere(400)
    ring = disc & ~sphere(400, 0.96)[1]
    for observations, mask, message in (
        (
            np.repeat(observed(lights(1)), 6, axis=1) * np.linspace(0.5, 1, 6),
            INSIDE,
            "all images look the same",
        ),
        (np.zeros((n_pixels, 8)), INSIDE, "all images look the same"),
        (rng.uniform(size=(n_pixels, 8)), INSIDE, "do not show one surface"),
        (shade(normals[ring], lights()), ring, "the mask is too thin"),
    ):
        with refuses(message):
            find_lights(np.float32(observations), mask, True)


def test_a_ball_of_light_and_highlight_is_not_returned_as_a_hollow():
    """Its brightness is constant but for a wide highlight, as no trained material's is."""
    true = ring_lights(8, 50)
    values = 0.05 + np.exp(20 * (NORMALS[INSIDE] @ halfway(true).T - 1))
    with refuses("bump or a hollow"):
        find_lights(values.astype(np.float32), INSIDE, False)


def test_a_first_light_from_another_side_decides_nothing():
    true = lights()
    true[0] = (0.0, 0.6, 0.8)
    with refuses(r"comes neither clearly from left.* --first-light 45"):
        find_lights(observed(true), INSIDE, True, first_light="left")
    found = find_lights(observed(true), INSIDE, True, first_light="above")
    assert mean_angle(found.directions, true) < 5


@parametrize(
    ("side", "azimuth_deg"), [("upper-right", 45), ("90", 90), ("lower-left", 225), ("-45", 315)]
)
def test_the_first_light_may_come_from_any_direction(side, azimuth_deg):
    true = lights()
    azimuth = np.radians(azimuth_deg)
    true[0] = (0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), 0.8)
    found = find_lights(observed(true), INSIDE, True, first_light=side)
    assert mean_angle(found.directions, true) < 5
    with refuses(r"expected one of right, upper-right, .* or its azimuth in degrees", UsageError):
        find_lights(observed(true), INSIDE, True, first_light=side + "x")


def test_holes_and_narrow_borders_are_no_outline():
    mask = np.ones((200, 200), np.bool_)
    mask[80:120, 80:120] = False
    assert outline_share(mask) == 0
    mask[:2] = mask[-2:] = mask[:, :2] = mask[:, -2:] = False
    assert outline_share(mask) == 0
    assert outline_share(INSIDE) > 0.9


@parametrize("hollow", [False, True])
def test_without_outline_the_first_light_decides_between_bump_and_hollow(hollow):
    """A matte hollow shows the same as a bump under opposite lights."""
    everywhere, true = np.ones((SIZE, SIZE), np.bool_), lights()
    true[0] = (-0.6, 0.0, 0.8)
    normals = sphere_cap(SIZE).reshape(-1, 3) * ((-1, -1, 1) if hollow else (1, 1, 1))
    images = np.float32(shade(normals, true, noise=0.002))
    with refuses(r"a bump or a hollow.* pass its mask with --mask .* the first image .* left"):
        find_lights(images, everywhere, True)
    found = find_lights(images, everywhere, True, first_light="left")
    assert mean_angle(found.directions, true) < 6


@parametrize("turn_deg", [(8, 0, 0), (0, -6, 0), (3, 4, 5)])
def test_the_outline_shows_a_common_turn(turn_deg):
    true = lights(20)
    turn = Rotation.from_rotvec(turn_deg, degrees=True)
    found = turn_at_outline(observed(true), INSIDE, turn.apply(true))
    assert found is not None and found.spread < 0.1
    shown = Rotation.from_rotvec(found.rotation)
    assert np.degrees((shown * turn).magnitude()) < 0.35 * np.linalg.norm(turn_deg)
    half = Rotation.from_matrix(found.share(0.5))
    assert half.magnitude() == approx(shown.magnitude() / 2)


def test_the_border_of_the_image_is_no_outline():
    everywhere = np.ones((SIZE, SIZE), np.bool_)
    values = np.float32(shade(sphere_cap(SIZE)[everywhere], lights()))
    assert turn_at_outline(values, everywhere, lights()) is None


def test_confidence_includes_the_lights():
    errors = np.array([[np.log(0.03), 1.0], [np.log(0.5), 1.0]], np.float32)
    add_common_error(errors, 3.0)
    turn = np.radians(3.0)
    assert_allclose(np.exp(errors[:, 0]), np.hypot((0.03, 0.5), turn), rtol=1e-5)


def test_python():
    true = lights()
    images = images_of(observed(true))
    estimate = estimate_normals(images, None, INSIDE, method="ls")
    capture = estimate.capture
    assert ESTIMATED_LIGHTS in [warning.kind for warning in capture.warnings]
    assert capture.light_errors_deg is not None and capture.light_errors_deg.shape == (10,)
    errors = angle_between_deg(estimate.normal_map[INSIDE], NORMALS[INSIDE])
    assert np.median(errors) < mean_angle(capture.light_directions, true) + 3
    for lights_given, options, message in (
        (None, {"pixel_size": 1.0}, "near lamps need positions"),
        (true, {"first_light": "left"}, "first_light and light_directions cannot be used together"),
        (None, {"first_light": "north"}, "found 'north' as the side"),
        (None, {"first_light": 400}, "found '400' as the side"),
    ):
        with refuses(message, UsageError):
            estimate_normals(images, lights_given, INSIDE, **options)


OPPOSITE = (-1, -1, 1)


def cap_on_plate(size, lights, *, hollow):
    """Return the images (P, F) of half a sphere on a plate, or sunk into it, with attached and cast
    shadows.
    """
    radius = 0.6
    x, y = square_grid(size)
    height = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)) * (-1 if hollow else 1)
    inside = x**2 + y**2 < radius**2
    points = np.stack((x, y, np.where(inside, height, 0)), axis=-1).reshape(-1, 3)
    normals = np.tile((0.0, 0.0, 1.0), (len(points), 1))
    normals[inside.ravel()] = points[inside.ravel()] / radius * (-1 if hollow else 1)
    normals = unit(normals * (1, 1, 1) + (0, 0, 0.2))  # no vertical walls
    along = points @ lights.T
    if hollow:  # the ray leaves through the mouth, or meets the wall
        mouth = points[:, None, :2] - (points[:, 2:] / lights[:, 2])[..., None] * lights[:, :2]
        shadow = inside.ravel()[:, None] & (np.linalg.norm(mouth, axis=2) > radius)
    else:  # the ray from the plate meets the sphere
        nearest = (points**2).sum(axis=1)[:, None] - along**2
        shadow = ~inside.ravel()[:, None] & (nearest < radius**2) & (along < 0)
    return np.float32(shade(normals, lights, noise=0.002) * ~shadow)


@parametrize("zenith_deg", [60, 70])
@parametrize("hollow", [False, True])
def test_cast_shadows_tell_a_bump_from_a_hollow(hollow, zenith_deg):
    lights, mask = ring_lights(10, zenith_deg), np.ones((64, 64), np.bool_)
    images = cap_on_plate(64, lights, hollow=hollow)
    assert bump_log_odds(images, mask, lights) > 3
    assert bump_log_odds(images, mask, lights * OPPOSITE) < -3


def test_the_outline_tells_a_bump_from_a_hollow():
    normals, inside = sphere(64)
    lights = ring_lights(8, 40)
    images = np.float32(shade(normals[inside], lights, noise=0.002))
    assert bump_log_odds(images, inside, lights) > 5
    assert bump_log_odds(images, inside, lights * OPPOSITE) < -5


@parametrize(("bump", "risk"), [(0.0, 0.5), (-0.5, 0.378), (9.0, 0.269)])
def test_without_outline_the_network_alone_is_not_certain(bump, risk):
    everywhere, true = np.ones((SIZE, SIZE), np.bool_), lights()
    images = np.float32(shade(sphere_cap(SIZE).reshape(-1, 3), true, noise=0.002))
    found = unknown_lights._bump_or_hollow(images, everywhere, true, 5.0, true, bump)
    assert found == (approx(true), approx(risk, abs=0.001))


@parametrize("hollow", [False, True])
def test_a_wrong_guess_of_the_network_is_turned_around(hollow, monkeypatch):
    lights, mask = ring_lights(10, 60), np.ones((64, 64), np.bool_)
    guess = lights * OPPOSITE, np.full(10, 16.0), np.ones(10), 1.0
    monkeypatch.setattr(unknown_lights, "_ask_network", lambda *_: guess)
    found = find_lights(cap_on_plate(64, lights, hollow=hollow), mask, True, refuse=False)
    assert angle_between_deg(found.directions, lights).mean() < 11
