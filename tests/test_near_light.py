"""Near lamps and near cameras: analytic surfaces under points of light, by the inverse square of
the distance.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import splinecli
from scenes import spiral_lights
from splinecli.capture import Capture
from splinecli.capture.near_lamps import NearLamps
from splinecli.errors import InputError, UsageError
from splinecli.estimate import inference
from splinecli.estimate.inference import estimate_normals, find_surface
from splinecli.estimate.methods import make_estimator
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import Blocks, pixel_rays

SIDE = 40
LIGHTS = spiral_lights(10, 50, 20)
MATRIX = np.array([(60.0, 0, 20.5), (0, 60.0, 18.0), (0, 0, 1)])


def surface(kind, side=SIDE):
    """Return points (P, 3) with a mean height of 0 in a frame that is 2 wide, normals (P, 3) and
    the mask.
    """
    place = (np.arange(side) + 0.5) * 2 / side - 1
    x, y = np.meshgrid(place, -place)
    mask = np.ones(x.shape, np.bool_)
    if kind == "plane":
        z, normals = 0 * x, np.dstack((0 * x, 0 * x, 0 * x + 1))
    elif kind == "tilted":
        z, normals = 0.3 * x - 0.1 * y, np.dstack((0 * x - 0.3, 0 * x + 0.1, 0 * x + 1))
    else:
        mask = np.hypot(x, y) < 0.95
        z = np.sqrt(np.maximum(1.1 - x**2 - y**2, 0))
        normals = np.dstack((x, y, z))
    points = np.dstack((x, y, z))[mask]
    points[:, 2] -= points[:, 2].mean()
    return points, unit(normals)[mask], mask


def capture_of(shape, positions, strengths=1.0):
    points, normals, mask = shape
    towards = positions - points[:, None]
    distance = np.linalg.norm(towards, axis=2)
    shading = np.clip(np.einsum("pfc,pc->pf", towards / distance[..., None], normals), 0, None)
    truth = np.zeros((*mask.shape, 3), np.float32)
    truth[mask] = normals
    observations = (0.6 * shading * strengths / distance**2).astype(np.float32)
    return Capture(
        "scene", observations, unit(positions), tuple(range(len(positions))), mask, truth
    )


def near(kind, distance, side=SIDE):
    positions = LIGHTS * distance
    capture = capture_of(surface(kind, side), positions)
    return replace(capture, lamps=NearLamps.of(positions, 2 / side, capture.mask.shape, equal=True))


def error_deg(capture):
    return estimate_normals(capture, make_estimator("iw12")).errors.mean


@pytest.mark.parametrize("kind, limit_deg", [("plane", 0.001), ("tilted", 0.02), ("dome", 0.2)])
def test_lamps_at_two_widths(kind, limit_deg):
    """Exact data give exact normals, apart from the integration, whose error is that of a grid of
    40 x 40 pixels.
    """
    capture = near(kind, 4.0)
    assert error_deg(capture) < limit_deg
    assert error_deg(replace(capture, lamps=None)) > 10


def test_the_surface_is_found_in_the_unit_of_the_positions():
    lamps = NearLamps.of(500 * 4.0 * LIGHTS, 1000 / SIDE, (SIDE, SIDE), equal=True)
    in_millimetres = replace(near("dome", 4.0), lamps=lamps)
    lamps = find_surface(in_millimetres).lamps
    points, _, _ = surface("dome")
    # The rim of the dome is steep: half a pixel is 12 there.
    assert np.abs(lamps.points - 500 * points).mean() < 5
    assert find_surface(find_surface(in_millimetres)).lamps is not lamps


def test_intensities_hold_at_the_origin():
    """Lamps of unequal distances: as of equal lamps, or with the intensities that a gray card at
    the origin shows.
    """
    distances = np.linspace(3, 6, 10)
    positions = LIGHTS * distances[:, None]
    capture = capture_of(surface("dome"), positions)
    equal = NearLamps.of(positions, 2 / SIDE, (SIDE, SIDE), equal=True)
    assert error_deg(replace(capture, lamps=equal)) < 0.2
    at_origin = capture.observations * (distances**2).astype(np.float32)
    measured = NearLamps.of(positions, 2 / SIDE, (SIDE, SIDE), equal=False)
    assert error_deg(replace(capture, observations=at_origin, lamps=measured)) < 0.2


@pytest.mark.parametrize("equal", [True, False])
def test_lamps_that_shine_in_lobes(equal):
    """LEDs that miss the middle of the object by up to 30 degrees, of equal power or measured at
    the origin.
    """
    points, normals, mask = surface("dome")
    positions = LIGHTS * np.linspace(3, 6, 10)[:, None]
    axes = unit(0.4 * np.random.default_rng(0).normal(size=(10, 3)) - LIGHTS)
    exponents = np.linspace(0, 6, 10)

    def strengths(places):
        rays = unit(places[:, None] - positions)
        return np.einsum("pfc,fc->pf", rays, axes).clip(0) ** exponents

    shown = strengths(points)
    if not equal:
        shown = shown * np.square(np.linalg.norm(positions, axis=1)) / strengths(np.zeros((1, 3)))
    capture = capture_of((points, normals, mask), positions, shown)
    lobes = np.column_stack((axes, exponents))
    lamps = NearLamps.of(positions, 2 / SIDE, (SIDE, SIDE), equal=equal, lobes=lobes)
    assert error_deg(replace(capture, lamps=lamps)) < 0.2
    assert error_deg(replace(capture, lamps=replace(lamps, lobes=None))) > 2


def test_a_perspective_camera():
    """A tilted plane before a pinhole camera: points on the rays, and a highlight-free surface."""
    mask = np.ones((SIDE, SIDE), np.bool_)
    rays = pixel_rays(mask, MATRIX)
    normal = unit(np.array((0.2, -0.3, 1.0)))
    # The pixel size ties the depth of the mean plane: f times the width of a pixel there.
    pixel_size, depth = 0.05, 60 * 0.05
    points = rays * (depth * normal[2] / -(rays @ normal))[:, None]
    middle = np.array(((19.5 - 20.5) / 60, -(19.5 - 18.0) / 60, -1)) * depth
    positions = LIGHTS * 4.0
    normals = np.tile(normal, (len(points), 1))
    capture = capture_of((points - middle, normals, mask), positions)
    lamps = NearLamps.of(positions, pixel_size, mask.shape, equal=True, camera_matrix=MATRIX)
    # Depth is known up to its geometric mean, which is not exactly the depth of the middle.
    assert error_deg(replace(capture, lamps=lamps)) < 0.3
    assert error_deg(replace(capture, lamps=replace(lamps, camera_matrix=None))) > 1


def glossy_sphere(half_angle_deg, *, gloss=1.0, side=32):
    """A sphere that fills the picture of a pinhole camera, under distant lights: Lambert's law and
    Blinn-Phong's.
    """
    focal, middle = side / 2 / np.tan(np.radians(half_angle_deg)), (side - 1) / 2
    matrix = np.array([(focal, 0, middle), (0, focal, middle), (0, 0, 1)])
    rays = unit(pixel_rays(np.ones((side, side), np.bool_), matrix))
    distance = 1 / np.sin(np.radians(half_angle_deg))
    along = -rays[:, 2] * distance  # of a ray, to the point next to the centre
    hit = along**2 > (distance**2 - 1) * (1 + 1e-4 / distance**2)
    rays, along = rays[hit], along[hit]
    reached = along - np.sqrt(along**2 - distance**2 + 1)
    normals = unit(reached[:, None] * rays + (0, 0, distance))
    half = unit(LIGHTS - rays[:, None])
    cosine = np.clip(normals @ LIGHTS.T, 0, None)
    highlight = np.clip(np.einsum("pfc,pc->pf", half, normals), 0, None) ** 30 * (cosine > 0)
    mask, truth = hit.reshape(side, side), np.zeros((side, side, 3), np.float32)
    truth[mask] = normals
    seen = (0.5 * (cosine + gloss * highlight)).astype(np.float32)
    return Capture("sphere", seen, LIGHTS, tuple(range(10)), mask, truth, camera_matrix=matrix)


def test_the_shipped_network_sees_gloss_from_a_near_camera():
    """Refined, too: without the camera, the highlights are where an orthographic one would not see
    them.
    """
    capture, estimator = glossy_sphere(20, side=20), make_estimator("spline-net")
    found = estimate_normals(capture, estimator)
    without = estimate_normals(replace(capture, camera_matrix=None), estimator)
    assert found.errors.mean < 1
    assert found.errors.mean < 0.6 * without.errors.mean


def test_least_squares_does_not_depend_on_the_camera():
    capture, estimator = glossy_sphere(20), make_estimator("ls")
    maps = [
        estimate_normals(each, estimator).normal_map
        for each in (capture, replace(capture, camera_matrix=None))
    ]
    assert_allclose(*maps, atol=1e-4)
    matte = estimate_normals(glossy_sphere(20, gloss=0), make_estimator("iw12"))
    assert matte.errors.median < 0.1  # shadows at the rim


def test_a_camera_far_away_is_orthographic():
    """At this focal length, rays differ by 0.002 degrees."""
    capture, estimator = glossy_sphere(0.001, side=20), make_estimator("spline-net-pixelwise")
    maps = [
        estimate_normals(each, estimator).normal_map
        for each in (capture, replace(capture, camera_matrix=None))
    ]
    assert_allclose(*maps, atol=2e-3)


def images_of(capture):
    images = np.zeros((10, *capture.mask.shape), np.float32)
    images[:, capture.mask] = capture.observations.T
    return images


def test_the_python_door_takes_a_camera():
    capture = glossy_sphere(20, side=16)
    arguments = images_of(capture), LIGHTS, capture.mask
    found = splinecli.estimate_normals(
        *arguments, camera_matrix=capture.camera_matrix, method="st14"
    )
    expected = estimate_normals(capture, make_estimator("st14")).normal_map
    assert_allclose(found.normal_map, expected, atol=1e-5)
    assert (
        np.abs(splinecli.estimate_normals(*arguments, method="st14").normal_map - expected).max()
        > 0.01
    )
    for matrix, error in ((np.eye(2), UsageError), (-np.eye(3), InputError)):
        with pytest.raises(error, match="camera matrix"):
            splinecli.estimate_normals(*arguments, camera_matrix=matrix, method="ls")


def test_large_captures_are_found_at_a_reduced_size(monkeypatch):
    capture = near("dome", 4.0, side=101)
    whole = find_surface(capture).lamps
    monkeypatch.setattr(inference, "PIXELS_ON_THE_WAY", 900)
    assert Blocks.over(capture.mask, 900).step == 3
    reduced = find_surface(capture).lamps
    assert np.abs(reduced.points - whole.points).mean() < 0.01
    assert error_deg(capture) < 0.2


def test_the_python_door_takes_positions():
    capture = near("dome", 4.0)
    arguments = images_of(capture), LIGHTS * 4.0, capture.mask
    estimate = splinecli.estimate_normals(*arguments, pixel_size=2 / SIDE, method="iw12")
    expected = estimate_normals(capture, make_estimator("iw12"))
    assert_allclose(estimate.normal_map, expected.normal_map, atol=1e-5)
