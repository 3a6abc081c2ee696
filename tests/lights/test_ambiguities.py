"""What shading leaves open: bumps and hollows, and how high the lights stand. Shadows are analytic."""

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import ring_lights, shade, sphere, square_grid
from splinecli.lights import unknown_lights
from splinecli.lights.unknown_lights import bump_log_odds, find_lights, lower_lights
from splinecli.maths.normals import angle_between_deg, unit

Array = NDArray[np.float64]

OPPOSITE = (-1, -1, 1)


def cap_on_plate(size: int, lights: Array, *, hollow: bool) -> NDArray[np.float32]:
    """Return the images (P, F) of half a sphere on a plate, or sunk into it, with attached and cast shadows."""
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
    return (shade(normals, lights, noise=0.002) * ~shadow).astype(np.float32)


@pytest.mark.parametrize("zenith_deg", [60, 70])
@pytest.mark.parametrize("hollow", [False, True])
def test_cast_shadows_tell_a_bump_from_a_hollow(hollow: bool, zenith_deg: float) -> None:
    lights, mask = ring_lights(10, zenith_deg), np.ones((64, 64), np.bool_)
    images = cap_on_plate(64, lights, hollow=hollow)
    assert bump_log_odds(images, mask, lights) > 3
    assert bump_log_odds(images, mask, lights * OPPOSITE) < -3


def test_the_outline_tells_a_bump_from_a_hollow() -> None:
    normals, inside = sphere(64)
    lights = ring_lights(8, 40)
    images = shade(normals[inside], lights, noise=0.002).astype(np.float32)
    assert bump_log_odds(images, inside, lights) > 5
    assert bump_log_odds(images, inside, lights * OPPOSITE) < -5


@pytest.mark.parametrize("hollow", [False, True])
def test_a_wrong_guess_of_the_network_is_turned_around(hollow: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    lights, mask = ring_lights(10, 60), np.ones((64, 64), np.bool_)
    guess = lights * OPPOSITE, np.full(10, 16.0), np.ones(10)
    monkeypatch.setattr(unknown_lights, "_ask_network", lambda *_: guess)
    found = find_lights(cap_on_plate(64, lights, hollow=hollow), mask, True, refuse=False)
    assert angle_between_deg(found.directions, lights).mean() < 8


def test_hypotheses_that_are_close_widen_the_expected_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A smooth cap without outline and shadows is as well a hollow."""
    normals, _ = sphere(96)
    normals, mask = normals[32:64, 32:64].reshape(-1, 3), np.ones((32, 32), np.bool_)
    lights = ring_lights(10, 30)
    images = shade(normals, lights, noise=0.002).astype(np.float32)
    errors = {}
    for expected in (4.0, 20.0):
        guess = lights, np.full(10, expected), np.ones(10)
        monkeypatch.setattr(unknown_lights, "_ask_network", lambda *_, guess=guess: guess)
        errors[expected] = find_lights(images, mask, True, refuse=False).errors_deg.mean()
    # Opposite lights are wrong by 60 degrees; the network alone would state 13.
    assert errors[4.0] < 6 and errors[20.0] > 17


@pytest.mark.parametrize("raised", [1.0, 1.6])
def test_low_lights_are_lowered_until_the_albedo_is_even(raised: float) -> None:
    normals, inside = sphere(64)
    lights = ring_lights(8, 65)
    images = shade(normals[inside], lights, noise=0.002).astype(np.float32)
    given = unit(lights * (1, 1, raised))
    before, after = (angle_between_deg(found, lights).mean() for found in (given, lower_lights(images, given, 10.0)))
    assert after <= max(0.5 * before, 0.5)


def test_high_lights_are_not_lowered() -> None:
    normals, inside = sphere(64)
    lights = ring_lights(8, 30)
    images = shade(normals[inside], lights).astype(np.float32)
    np.testing.assert_array_equal(lower_lights(images, lights, 10.0), lights)
