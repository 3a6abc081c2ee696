"""Integration of normals, against analytic surfaces and a dense solver."""

import re

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from scipy.ndimage import gaussian_filter, label

from scenes import parametrize, pinhole, read_image, refuses, tilted
from splinecli.errors import UsageError
from splinecli.maths.normals import unit
from splinecli.surface import integration
from splinecli.surface.integration import integrate_normals, relief_of_normals

CAMERA = pinhole(210, 63, 41, 200)
# Maps of more pixels than this start from coarser ones.
COARSE_FROM = {"own scale": 10**9, "coarse to fine": 300}


@pytest.fixture
def no_movement(monkeypatch):
    monkeypatch.setattr(integration, "STILL", 0.0)
    monkeypatch.setattr(integration, "LEAST_FORCE", 1e-9)
    monkeypatch.setattr(integration, "SOLVES_OF_COARSEST", 400)


@pytest.fixture(params=COARSE_FROM)
def scale(request, monkeypatch):
    monkeypatch.setattr(integration, "COARSEST", COARSE_FROM[request.param])


until_nothing_moves = pytest.mark.usefixtures("no_movement")
any_scale = pytest.mark.usefixtures("scale")


def grid(height, width):
    """Return x (right) and y (up) of the pixels (H, W), from the centre."""
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    return columns - (width - 1) / 2, (height - 1) / 2 - rows


def sphere(height, width, radius, reach):
    """Return normals, mask and heights of the cap within `reach` of the radius, not centred on a
    pixel.
    """
    x, y = grid(height, width)
    x, y = x + 0.3, y - 0.2
    mask = x**2 + y**2 < (reach * radius) ** 2
    z = np.sqrt(np.where(mask, radius**2 - x**2 - y**2, 1))
    return np.stack((x, y, z), axis=-1) / radius * mask[..., None], mask, z


def bumps(height, width, seed=0, *, usable=False):
    """Return normals that no surface has: smooth with noise, some nearly grazing, some facing away
    unless `usable`.
    """
    rng = default_rng(seed)
    x, y = grid(height, width)
    normals = tilted(-np.sin(x / 3) - y / height, -np.cos(y / 2))
    normals = unit(normals + rng.normal(scale=0.2, size=normals.shape))
    normals[rng.uniform(size=(height, width)) < 0.03] = unit(np.array([0.6, 0.2, -0.3]))
    if usable:
        normals[normals[..., 2] < 0.1] = (0, 0, 1)
    return normals


def holes(height, width, seed=1):
    """Return a ragged mask of several parts, with strips one pixel wide and single pixels."""
    mask = default_rng(seed).uniform(size=(height, width)) < 0.7
    mask[:, width // 2] = False
    mask[1, :] = True
    mask[2, :] = mask[4, :] = False
    mask[3, :] = np.arange(width) % 2 == 0
    return mask


def error_share(found, truth, mask):
    """Return the mean error without the offset, as a share of the range of the truth."""
    error = (found - truth)[mask]
    return float(np.abs(error - np.median(error)).mean() / np.ptp(truth[mask]))


@any_scale
@parametrize("discontinuity", [0, 2])
@parametrize("reach, limit", [(0.6, 1e-4), (0.9, 2e-4), (1.0, 1e-3)])
def test_sphere(reach, limit, discontinuity):
    # Up to the rim, where normals are grazing, the last pixel is off by more.
    normals, mask, truth = sphere(130, 150, 60, reach)
    found = integrate_normals(normals, mask, discontinuity=discontinuity)
    assert error_share(found, truth, mask) < limit
    assert np.isnan(found[~mask]).all()
    assert found[mask].mean() == approx(0, abs=1e-9)


def levels(rows, columns, height, slope, joined):
    """Return normals and heights of two flat levels, and the mask of the wall between them.

    In the first `joined` rows, a ramp connects the levels. The wall is one pixel thick and faces
    the lower level, nearly at a right angle to the view.
    """
    x, _ = grid(rows, columns)
    x = np.ceil(x)
    ramp = np.arange(rows)[:, None] < joined
    truth = np.where(ramp, np.clip(slope * x + height, 0, height), height * (x >= 0))
    normals = tilted(np.where(ramp & (truth > 0) & (truth < height), -slope, 0.0), 0 * x)
    wall = ~ramp & (x == 0)
    normals[wall] = unit(np.array([-1, 0, 0.01]))
    side = (np.arange(rows)[:, None] == joined) & (x < 0) & (slope * x > -height)
    normals[side] = unit(np.array([0, -1, 0.01]))
    return normals, truth, wall | side


@parametrize("joined", [30, 70])
@parametrize("coarse_from", [10**9, 3000])
def test_levels_apart(monkeypatch, coarse_from, joined):
    monkeypatch.setattr(integration, "COARSEST", coarse_from)
    normals, truth, wall = levels(100, 120, 30, 2, joined)
    everywhere = np.ones(wall.shape, bool)
    least_squares = integrate_normals(normals, everywhere, discontinuity=0)
    done = []
    torn = integrate_normals(normals, everywhere, progress=done.append)
    assert error_share(least_squares, truth, ~wall) > 0.1
    assert error_share(torn, truth, ~wall) < 1e-2
    assert 0 < sum(done) <= 1 + 1e-9
    # The wall itself may have any height.
    assert np.isfinite(torn).all()


@parametrize("slopes", [(-3.0, 1.0), (12.0, 8.0)])
@parametrize("shape", [(30, 50), (1, 40), (2, 2)])
def test_plane_is_exact(shape, slopes):
    x, y = grid(*shape)
    mask = np.ones(shape, bool)
    normals = tilted(0 * x - slopes[0], 0 * x - slopes[1])
    # As float32 slopes of s have errors of s^2 * 1e-7, over 90 pixels.
    for dtype, atol in ((np.float32, 3e-3), (np.float64, 1e-4)):
        found = integrate_normals(normals.astype(dtype), mask)
        assert_allclose(found, slopes[0] * x + slopes[1] * y, atol=atol, rtol=0)


def seen(camera, height, width):
    """Return the points (H, W, 3) at depth 1 that the pixels show, by hand, for a camera without
    skew.
    """
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    x, down = (columns - camera[0, 2]) / camera[0, 0], (rows - camera[1, 2]) / camera[1, 1]
    return np.stack((x, -down, -np.ones_like(x)), axis=-1)


@any_scale
def test_perspective_plane():
    rays, mask = seen(CAMERA, 90, 120), np.ones((90, 120), bool)
    normal = unit(np.array([0.3, -0.4, 0.8]))
    depth = -1 / (rays @ normal)
    depth /= np.exp(np.log(depth).mean())
    normals = np.broadcast_to(normal, rays.shape)
    found = integrate_normals(normals, mask, camera_matrix=CAMERA)
    # A step of log(depth) is not quite linear in its slope.
    assert error_share(found, depth, mask) < 5e-4
    assert_allclose(found, depth, rtol=1e-3)
    # A prior gives depths their scale.
    assert_allclose(
        integrate_normals(normals, mask, CAMERA, prior=500 * depth), 500 * depth, rtol=1e-3
    )


@any_scale
def test_perspective_sphere():
    rays = seen(CAMERA, 90, 120)
    centre, radius = np.array([0.1, -0.05, -6.0]), 1.1
    # |t r - c| = R, the nearer of the two.
    along, square = rays @ centre, (rays**2).sum(axis=-1)
    discriminant = along**2 - square * (centre @ centre - radius**2)
    mask = discriminant > 0
    depth = (along - np.sqrt(np.where(mask, discriminant, 0))) / square
    normals = np.where(mask[..., None], (depth[..., None] * rays - centre) / radius, 0)
    found = integrate_normals(normals, mask, camera_matrix=CAMERA)
    scale = np.exp(np.log(depth[mask]).mean())
    assert (found[mask] > 0).all()
    assert np.exp(np.log(found[mask]).mean()) == approx(1, rel=1e-9)
    assert error_share(found * scale, depth, mask) < 5e-3


def equations(normals, mask):
    """Return matrices (P, P) and constants (P,) of facing * (h' - h) + slant to the right, left,
    bottom and top.

    Equations without a neighbour, and those of normals at 87 degrees and more, are zero.
    """
    number = {(int(r), int(c)): i for i, (r, c) in enumerate(np.argwhere(mask))}
    matrices, constants = [], []
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        matrix, constant = np.zeros((len(number), len(number))), np.zeros(len(number))
        for (r, c), i in number.items():
            j = number.get((r + down, c + right))
            nx, ny, nz = normals[r, c]
            if j is not None and nz > 0.05:
                matrix[i, j] += nz
                matrix[i, i] -= nz
                constant[i] = right * nx - down * ny
        matrices.append(matrix)
        constants.append(constant)
    return matrices, constants


def dense(normals, mask, discontinuity, iterations):
    """Return the heights (P,) by the pseudo-inverse, which have mean 0 in every part."""
    matrices, constants = equations(normals, mask)
    heights = np.zeros(np.count_nonzero(mask))
    for iteration in range(iterations):
        weights = []
        for forth, back in ((0, 1), (1, 0), (2, 3), (3, 2)):
            gaps = (matrices[back] @ heights) ** 2 - (matrices[forth] @ heights) ** 2
            weights.append(1 / (1 + np.exp(-discontinuity * (iteration > 0) * gaps)))
        root = np.sqrt(np.concatenate(weights))
        heights = np.linalg.lstsq(
            root[:, None] * np.concatenate(matrices), -root * np.concatenate(constants)
        )[0]
    return heights


def test_a_prior_is_the_dense_solution():
    normals, mask = bumps(14, 19, usable=True), holes(14, 19)
    prior = default_rng(2).normal(size=mask.shape)
    prior[:, 12:] = np.nan  # parts there have mean height 0, in relation to the mean of the prior
    found = integrate_normals(normals, mask, discontinuity=0, prior=prior, prior_detail=8)[mask]
    matrices, constants = equations(normals, mask)
    known = np.isfinite(prior[mask])
    pulls = 2 * np.pi / 8 * np.eye(len(known))[known]
    rows = np.concatenate((*(np.sqrt(0.5) * matrix for matrix in matrices), pulls))
    values = np.concatenate(
        (-np.sqrt(0.5) * np.concatenate(constants), 2 * np.pi / 8 * prior[mask][known])
    )
    expected = np.linalg.lstsq(rows, values)[0]
    parts = label(mask)[0][mask]
    reached = np.isin(parts, parts[known])
    assert_allclose(found[reached], expected[reached], atol=1e-4)
    means = [found[parts == part].mean() for part in np.unique(parts[~reached])]
    assert_allclose(means, prior[mask][known].mean(), atol=1e-9)


def drifting(seed=0):
    """Return normals with smooth errors of 4 degrees and noise of 2, heights, and a coarse, noisy
    scan of these.
    """
    rng = default_rng(seed)
    x, y = grid(200, 200)
    heights = 40 * np.exp(-(x**2 + y**2) / 60**2) + 2 * np.sin(x / 5) * np.cos(y / 4)
    down, right = np.gradient(heights)
    normals = tilted(-right, down)
    errors = np.stack([gaussian_filter(rng.normal(size=x.shape), 40) for _ in range(2)], axis=-1)
    normals[..., :2] += errors * np.tan(np.radians(4)) / errors.std() + rng.normal(
        scale=0.035, size=errors.shape
    )
    scan = gaussian_filter(heights, 6) + rng.normal(scale=0.7, size=x.shape)
    return unit(normals), heights, scan


@parametrize("discontinuity", [0.0, 2.0])
@any_scale
def test_a_prior_is_better_than_normals_and_scan_alone(discontinuity):
    normals, heights, scan = drifting()
    scan[80:95, 60:120] = np.nan

    def error(found):
        return float(np.nanstd(found - heights))

    both = integrate_normals(normals, discontinuity=discontinuity, prior=scan)
    assert (
        1.5 * error(both)
        < error(scan)
        < error(integrate_normals(normals, discontinuity=discontinuity))
    )
    assert abs(np.mean(both - heights)) < 0.1


def test_a_prior_in_another_direction_or_unit():
    normals, heights, _ = drifting()
    for factor in (-1.0, 20.0, 0.01):
        with refuses("the prior is") as raised:
            integrate_normals(normals, prior=factor * heights)
        stated = re.search(r"is (\S+) times", str(raised.value))
        assert stated and float(stated[1]) == approx(factor, rel=0.2)


@until_nothing_moves
def test_bilateral_is_the_dense_solution():
    normals, mask = bumps(12, 17, usable=True), holes(12, 17)
    found = integrate_normals(normals, mask)[mask]
    least_squares = dense(normals, mask, 0, 1)
    assert_allclose(
        integrate_normals(normals, mask, discontinuity=0)[mask], least_squares, atol=1e-4
    )
    expected = dense(normals, mask, 2, 200)
    assert np.abs(expected - least_squares).max() > 0.5
    assert_allclose(found, expected, atol=5e-3)


@any_scale
@parametrize("camera", [None, CAMERA])
def test_single_pixels_and_normals_that_are_not_usable(camera):
    normals, mask = bumps(12, 17), holes(12, 17)
    middle = 0.0 if camera is None else 1.0
    for some in (
        normals,
        np.broadcast_to((1.0, 0, 0), normals.shape),
        np.broadcast_to((0, 0.6, -0.8), normals.shape),
    ):
        found = integrate_normals(some, mask, camera_matrix=camera)
        assert np.isfinite(found[mask]).all()
        assert found[3, 4] == approx(middle, abs=1e-9)
    assert_allclose(found[mask], middle, atol=1e-9)


@any_scale
def test_backward_normals_are_bridged():
    normals, mask, truth = sphere(60, 80, 40, 0.8)
    wrong = default_rng(3).uniform(size=mask.shape) < 0.05
    normals[wrong & mask] = unit(np.array([0.7, 0.1, -0.7]))
    assert error_share(integrate_normals(normals, mask), truth, mask) < 5e-3


def test_without_a_mask_all_normals_count_and_progress_is_reported():
    normals, mask, _ = sphere(40, 50, 30, 0.9)
    kept, calls = normals.copy(), []
    expected = integrate_normals(normals, mask, discontinuity=0, progress=calls.append)
    assert np.array_equal(normals, kept) and calls == [1.0]
    for background in (0.0, np.nan):
        found = integrate_normals(np.where(mask[..., None], normals, background), discontinuity=0)
        assert_array_equal(found, expected)


NORMALS = np.tile((0.0, 0.0, 1.0), (3, 4, 1))
MASK = np.ones((3, 4), bool)
ZERO_AT_1_2 = NORMALS * ~((np.arange(3)[:, None, None] == 1) & (np.arange(4)[:, None] == 2))


@parametrize(
    "arguments, message",
    [
        ((NORMALS * 0,), "the normal map has no normal"),
        ((NORMALS, ~MASK), "the mask is empty"),
        (
            (ZERO_AT_1_2, MASK),
            "1 of 12 normals in the mask are not unit vectors, the first in row 1",
        ),
        ((NORMALS * np.nan, MASK), "12 of 12 normals in the mask are not unit vectors"),
        ((NORMALS, MASK, np.diag([9.0, 0, 1])), "is not a camera matrix"),
        ((NORMALS, MASK, CAMERA + 1e308), "is not a camera matrix"),
        ((NORMALS, MASK, CAMERA.T), "is not a camera matrix"),
    ],
)
def test_bad_input(arguments, message):
    with refuses(message):
        integrate_normals(*arguments)


@parametrize(
    "arguments, message",
    [
        ((NORMALS[..., 0],), "(3, 4), expected (H, W, 3)"),
        ((NORMALS[..., :2], MASK), "(3, 4, 2), expected (3, 4, 3) for this mask"),
        ((NORMALS, np.uint8(MASK)), "the mask is uint8 (3, 4), expected bool (H, W)"),
        ((NORMALS, MASK, np.eye(4)), "the camera matrix has shape (4, 4), expected (3, 3)"),
    ],
)
def test_bad_arguments(arguments, message):
    with refuses(re.escape(message), UsageError):
        integrate_normals(*arguments)
    with refuses("the discontinuity is -1, expected", UsageError):
        integrate_normals(NORMALS, discontinuity=-1)


@parametrize("name, published_mm", [("bear", 0.334), ("cat", 0.074), ("reading", 0.257)])
def test_measured_objects_are_as_exact_as_published(shared_data, name, published_mm):
    """Exact solves would let the heads and paws of these drift: 0.45, 0.10 and 0.28 mm."""
    folder = shared_data / "depth" / name
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    colours = read_image(folder / "normal_map.png")
    normals = unit(colours[..., ::-1] / 65535 * 2 - 1)
    with np.load(folder / "depth_gt.npz") as file:
        truth = next(iter(file.values()))[mask]
    depth = integrate_normals(normals, mask, np.loadtxt(folder / "K.txt"))[mask]
    known = truth > 0
    depth, truth = depth[known], truth[known]
    assert np.abs(depth * np.median(truth / depth) - truth).mean() < 1.1 * published_mm


@parametrize("wave, kept", [(16, 1 / (1 + (16 / 64) ** 2)), (64, 0.5), (256, 1 / (1 + 4**2))])
def test_of_a_wave_the_stated_share_is_kept(wave, kept):
    x = np.broadcast_to(np.arange(512), (96, 512))
    k = 2 * np.pi / wave
    normals = tilted(0.5 * k * np.sin(k * x), 0.0 * x).astype(np.float32)
    relief = relief_of_normals(normals, np.ones(x.shape, bool))
    middle = (slice(None), slice(128, 384))
    assert_allclose(relief[middle], 0.5 * kept * np.cos(k * x)[middle], atol=0.01)
