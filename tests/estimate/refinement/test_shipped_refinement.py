"""The shipped refinement net invents nothing: analytic scenes whose normals are known
everywhere.
"""

import numpy as np
from numpy.random import default_rng
from pytest import approx

from scenes import as_capture, directions_at, halfway, parametrize, tilted
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import MethodOptions, make_estimator
from splinecli.estimate.refinement.refiner import MARGIN, TILE, NetworkRefiner
from splinecli.lights.lighting import PixelLighting
from splinecli.maths.normals import angle_between_deg, unit

SIZE = 48
SEAMS = 3 * MARGIN  # the side of a map whose tiles at the corners see a part of it
AZIMUTH = np.arange(10) * np.radians(36)
ZENITH = np.radians(np.where(np.arange(10) % 2, 25, 50))
LIGHTS = directions_at(AZIMUTH, ZENITH)
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
PLATE = np.tile(unit(np.array((0.2, 0.1, 1.0))), (SIZE, SIZE, 1))


def scene(normals, albedo, *, noise, gloss=0.0, unmeasured=1.0):
    """Return a scene of Lambert's cosine and a Phong highlight, with noise of a share of full
    scale.

    The lamps are `unmeasured` times as strong as the capture says.
    """
    rng = default_rng(0)
    flat = normals.reshape(-1, 3)
    observations = np.broadcast_to(albedo, normals.shape[:2]).reshape(-1, 1) * (
        flat @ LIGHTS.T
    ).clip(0)
    observations = unmeasured * (observations + gloss * (flat @ halfway(LIGHTS).T).clip(0) ** 60)
    observations += noise * observations.max() * rng.normal(size=observations.shape)
    mask = np.ones(normals.shape[:2], np.bool_)
    return as_capture(observations.clip(0), LIGHTS, mask, ground_truth=np.float32(normals))


def refined_and_not(*surface, **faults):
    """Estimate a scene without refinement and with it: as it is, and at half the resolution, as the
    largest captures. See `scene`.
    """
    capture = scene(*surface, **faults)
    refined = []
    for halved in (False, True):
        estimator = make_estimator("spline-net")
        estimator.refiner.most_pixels = capture.n_pixels - halved
        refined.append(estimate_normals(capture, estimator))
    return refined, estimate_normals(capture, make_estimator("spline-net-pixelwise"))


@parametrize("noise", [0.01, 0.03])
def test_a_noisy_plate_stays_as_flat_as_it_is(noise):
    both, pixelwise = refined_and_not(PLATE, 0.5, noise=noise)

    def tilt_deg(estimate):
        mean = unit(estimate.normal_map.mean(axis=(0, 1)))
        return float(angle_between_deg(mean, PLATE[0, 0]))

    for refined in both:
        assert refined.errors.mean < 1.05 * pixelwise.errors.mean
        assert tilt_deg(refined) < tilt_deg(pixelwise) + 0.25


@parametrize("gloss", [0.0, 0.5])
def test_a_checker_of_albedo_leaves_no_more_trace_than_before(gloss):
    bright = (ROWS // 8 + COLUMNS // 8) % 2 == 1

    def step_deg(estimate):
        """The angle between the mean normals of the dark and of the bright squares."""
        dark_mean, bright_mean = (
            unit(estimate.normal_map[part].mean(axis=0)) for part in (~bright, bright)
        )
        return float(angle_between_deg(dark_mean, bright_mean))

    both, pixelwise = refined_and_not(PLATE, np.where(bright, 0.8, 0.2), noise=0.005, gloss=gloss)
    assert max(map(step_deg, both)) < step_deg(pixelwise) + 0.1


def grooves(width):
    """Normals of grooves `width` pixels to either side, and their slopes of 17 degrees."""
    slope = np.where((COLUMNS // width) % 2 == 1, 0.3, -0.3)
    return tilted(-slope, 0 * slope), slope


def depth(estimate, slope):
    """The mean slope along the grooves' own, of which 1 is true."""
    found = -estimate.normal_map[..., 0] / estimate.normal_map[..., 2]
    return float(((found - found.mean()) / slope).mean())


@parametrize("width, gloss", [(1, 0.0), (1, 0.5), (4, 0.5)])
def test_grooves_keep_their_depth(width, gloss):
    normals, slope = grooves(width)
    both, pixelwise = refined_and_not(normals, 0.5, noise=0.002, gloss=gloss)
    for refined in both:
        assert depth(refined, slope) == approx(depth(pixelwise, slope), rel=0.1)


@parametrize("width, noise", [(1, 0.02), (2, 0.002)])
def test_wrong_light_intensities_do_not_blur_grooves(width, noise):
    """They turn normals by many degrees, which says nothing about detail. The net alone takes most
    of it for noise.
    """
    normals, slope = grooves(width)
    stronger = 1 + 0.5 * (LIGHTS[:, 0] > 0)
    both, pixelwise = refined_and_not(normals, 0.5, noise=noise, unmeasured=stronger)
    assert pixelwise.errors.mean > 8
    for refined in both:
        assert depth(refined, slope) == approx(depth(pixelwise, slope), rel=0.15)


@parametrize("behind", [0.002, 0.3])
def test_a_background_changes_nothing_on_the_object(behind):
    """A sphere before a dark or a bright wall, without a mask. A mask would end at the rim of the
    sphere.
    """
    # halved, the two pixels at the rim of a smaller sphere would be too large a share
    size = 2 * SIZE
    rows, columns = np.mgrid[:size, :size]
    x, y = (columns - size / 2 + 0.5) / 36, (size / 2 - 0.5 - rows) / 36
    height = np.sqrt((1 - x**2 - y**2).clip(0))
    sphere = height > 0.2
    normals = np.where(sphere[..., None], np.stack((x, y, height), axis=-1), PLATE[0, 0])
    both, pixelwise = refined_and_not(normals, np.where(sphere, 0.5, behind), noise=0.002)
    as_it_is, halved, without = (
        angle_between_deg(estimate.normal_map[sphere], normals[sphere]).mean()
        for estimate in (*both, pixelwise)
    )
    assert max(as_it_is, halved) < without + 0.3


def test_seams_of_tiles_do_not_show():
    """The margin of a tile is smaller than what the nets can see. Its share of a normal is far
    below its error.
    """
    rows, columns = np.mgrid[:SEAMS, :SEAMS]
    slopes = np.stack((np.sin(columns / 9), np.cos((rows + columns) / 13)), axis=-1)
    normals = unit(np.dstack((slopes, np.ones_like(slopes[..., :1]))))
    capture = scene(normals, np.where(columns % 40 < 20, 0.8, 0.2), noise=0.01, gloss=0.5)
    noise = default_rng(1).normal(scale=0.05, size=(capture.n_pixels, 3))
    before = unit(normals.reshape(-1, 3) + noise).astype(np.float32)
    errors_before = np.tile(np.array((np.log(0.05), 1), np.float32), (capture.n_pixels, 1))
    network = make_estimator("spline-net", MethodOptions(precision="float32")).refiner.network
    found = []

    def lighting_at(chosen):
        return PixelLighting(capture.observations[chosen], LIGHTS)

    for tile in (TILE, MARGIN):
        refiner = NetworkRefiner(network, "float32", turns=1, tile=tile)
        normals, errors = before.copy(), errors_before.copy()
        refiner.refine(capture.mask, capture.observations, lighting_at, normals, errors)
        found.append((normals, errors))
    assert angle_between_deg(found[0][0], before).mean() > 0.2
    assert angle_between_deg(found[0][0], found[1][0]).max() < 0.006  # 1e-4 radians
    assert np.abs(found[0][1] - found[1][1]).max() < 0.006
