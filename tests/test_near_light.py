"""Near lamps and near cameras: analytic surfaces under points of light, by the inverse square of
the distance.
"""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

import splinecli
from scenes import as_capture, parametrize, pinhole, refuses, spiral_lights, square_grid, tilted
from splinecli.capture.near_lamps import NearLamps
from splinecli.errors import InputError, UsageError
from splinecli.estimate import inference
from splinecli.estimate.inference import estimate_normals, find_surface
from splinecli.estimate.methods import make_estimator
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import Blocks, pixel_rays

SIDE = 40
LIGHTS = spiral_lights(10, 50, 20)
MATRIX = pinhole(60, 20.5, 18)


def surface(kind, side=SIDE):
    """Return points (P, 3) with a mean height of 0 in a frame that is 2 wide, normals (P, 3) and
    the mask.
    """
    x, y = square_grid(side, 1 - 1 / side)
    mask = np.hypot(x, y) < {"dome": 0.95}.get(kind, 2)
    z = {
        "plane": 0 * x,
        "tilted": 0.3 * x - 0.1 * y,
        "dome": np.sqrt(np.maximum(1.1 - x**2 - y**2, 0)),
    }[kind]
    normals = unit(np.dstack((x, y, z)))
    if kind != "dome":
        down, right = np.gradient(z, 2 / side)
        normals = tilted(-right, down)
    points = np.dstack((x, y, z))[mask]
    points[:, 2] -= points[:, 2].mean()
    return points, normals[mask], mask


def capture_of(shape, positions, strengths=1.0):
    points, normals, mask = shape
    towards = positions - points[:, None]
    distance = np.linalg.norm(towards, axis=2)
    shading = np.clip(np.einsum("pfc,pc->pf", towards / distance[..., None], normals), 0, None)
    truth = np.zeros((*mask.shape, 3), np.float32)
    truth[mask] = normals
    observations = 0.6 * shading * strengths / distance**2
    return as_capture(observations, unit(positions), mask, ground_truth=truth)


def near(kind, distance, side=SIDE):
    positions = LIGHTS * distance
    capture = capture_of(surface(kind, side), positions)
    return replace(capture, lamps=NearLamps.of(positions, 2 / side, capture.mask.shape, equal=True))


def error_deg(capture):
    return estimate_normals(capture, make_estimator("iw12")).errors.mean


@parametrize("kind, limit_deg", [("plane", 0.001), ("tilted", 0.02), ("dome", 0.2)])
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
    at_origin = capture.observations * np.float32(distances**2)
    measured = NearLamps.of(positions, 2 / SIDE, (SIDE, SIDE), equal=False)
    assert error_deg(replace(capture, observations=at_origin, lamps=measured)) < 0.2


@parametrize("equal", [True, False])
def test_lamps_that_shine_in_lobes(equal, rng):
    """LEDs that miss the middle of the object by up to 30 degrees, of equal power or measured at
    the origin.
    """
    points, normals, mask = surface("dome")
    positions = LIGHTS * np.linspace(3, 6, 10)[:, None]
    axes = unit(0.4 * rng.normal(size=(10, 3)) - LIGHTS)
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
    capture = capture_of((points - middle, np.tile(normal, (len(points), 1)), mask), positions)
    lamps = NearLamps.of(positions, pixel_size, mask.shape, equal=True, camera_matrix=MATRIX)
    # Depth is known up to its geometric mean, which is not exactly the depth of the middle.
    assert error_deg(replace(capture, lamps=lamps)) < 0.3
    assert error_deg(replace(capture, lamps=replace(lamps, camera_matrix=None))) > 1


def glossy_sphere(half_angle_deg, *, gloss=1.0, side=32):
    """A sphere that fills the picture of a pinhole camera, under distant lights: Lambert's law and
    Blinn-Phong's.
    """
    focal, middle = side / 2 / np.tan(np.radians(half_angle_deg)), (side - 1) / 2
    matrix = pinhole(focal, middle, middle)
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
    seen = 0.5 * (cosine + gloss * highlight)
    return as_capture(seen, LIGHTS, mask, ground_truth=truth, camera_matrix=matrix)


def test_the_shipped_network_sees_gloss_from_a_near_camera():
    """Refined, too: without the camera, the highlights are where an orthographic one would not see
    them.
    """
    capture, estimator = glossy_sphere(20, side=20), make_estimator("spline-net")
    found = estimate_normals(capture, estimator)
    without = estimate_normals(replace(capture, camera_matrix=None), estimator)
    assert found.errors.mean < 1
    assert found.errors.mean < 0.6 * without.errors.mean


@parametrize(
    "half_angle_deg, method, atol", [(20, "ls", 1e-4), (0.001, "spline-net-pixelwise", 2e-3)]
)
def test_where_the_camera_makes_no_difference(half_angle_deg, method, atol):
    """For least squares; and far away, at a focal length where rays differ by 0.002 degrees."""
    capture = glossy_sphere(half_angle_deg, side=20)
    maps = [
        estimate_normals(each, make_estimator(method)).normal_map
        for each in (capture, replace(capture, camera_matrix=None))
    ]
    assert_allclose(*maps, atol=atol)


def test_a_matte_sphere_before_a_near_camera():
    matte = estimate_normals(glossy_sphere(20, gloss=0), make_estimator("iw12"))
    assert matte.errors.median < 0.1  # shadows at the rim


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
    without = splinecli.estimate_normals(*arguments, method="st14").normal_map
    assert np.abs(without - expected).max() > 0.01
    for matrix, error in ((np.eye(2), UsageError), (-np.eye(3), InputError)):
        with refuses("camera matrix", error):
            splinecli.estimate_normals(*arguments, camera_matrix=matrix, method="ls")


def test_large_captures_are_found_at_a_reduced_size(monkeypatch):
    capture = near("dome", 4.0, side=101)
    whole = find_surface(capture).lamps
    monkeypatch.setattr(inference, "PIXELS_ON_THE_WAY", 900)
    assert Blocks.over(capture.mask, 900).step == 3
    assert np.abs(find_surface(capture).lamps.points - whole.points).mean() < 0.01
    assert error_deg(capture) < 0.2


def test_the_python_door_takes_positions():
    capture = near("dome", 4.0)
    arguments = images_of(capture), LIGHTS * 4.0, capture.mask
    estimate = splinecli.estimate_normals(*arguments, pixel_size=2 / SIDE, method="iw12")
    expected = estimate_normals(capture, make_estimator("iw12"))
    assert_allclose(estimate.normal_map, expected.normal_map, atol=1e-5)
