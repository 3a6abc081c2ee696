"""The whole network between observations and normals: shapes, limits, symmetries, and the error
that it tells.
"""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.nn.functional import normalize
from torch.testing import assert_close

from distributions import seeded
from scenes import parametrize
from splinecli.estimate.fits.least_squares import fit_lambertian
from splinecli.estimate.methods import MethodOptions, make_estimator
from splinecli.estimate.networks.config import STARTING_FITS, NetworkConfig, fit_normals
from splinecli.estimate.networks.li_ne_net import probability_within
from splinecli.estimate.networks.spline_net import Rotation, SplineNet, to_capture_frame
from splinecli.maths.observation_map import map_scale, rotate_about_view_axis
from splinecli.workshop.synthesis.pixels import PixelGenerator, PixelGeneratorConfig
from splinecli.workshop.training.objective import error_negative_log_likelihood, to_pixel_frame
from tiny_networks import TINY, random_network

SET = {"set_width": 16, "set_layers": 2, "fits": ["ls"]}


@pytest.fixture(scope="module")
def pixels():
    """64 generated pixels under ten shared lights, in float64 so that no rounding moves a light to
    another cell.
    """
    config = PixelGeneratorConfig(min_lights=10, max_lights=10, light_direction_error_share=0.0)
    generator = seeded(5)
    lights = PixelGenerator(config, generator).draw(1).light_directions[0].double()
    scene = PixelGenerator(config, generator).draw(64).truth
    return scene.radiance(lights.float()).double(), normalize(lights, dim=1)  # type: ignore[attr-defined]


def turn(vectors, degrees):
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    return rotate_about_view_axis(vectors.double(), angle.cos(), angle.sin())


def test_an_untrained_compact_network_gives_the_robust_lambertian_normal(pixels):
    observations, lights = pixels
    network = SplineNet(NetworkConfig(**TINY)).double()
    expected = normalize(fit_lambertian(observations / map_scale(observations), lights), dim=1)
    visible = expected[:, 2] > 0.05
    assert visible.sum() > 50
    with torch.no_grad():
        normals = network(observations, lights).normals
    assert_close(normals[visible], expected[visible], atol=1e-6, rtol=0, check_dtype=False)


def test_gradients_are_finite_where_a_fit_points_at_the_camera():
    """The search for unknown lights descends along these gradients."""
    lights = torch.tensor([[3.0, 0, 4], [-3, 0, 4], [0, 3, 4], [0, -3, 4]]) / 5
    observations = torch.ones(1, 4)
    assert not fit_lambertian(observations, lights)[:, :2].any()
    normals = SplineNet(NetworkConfig(**TINY))(observations, lights.requires_grad_()).normals
    (gradient,) = torch.autograd.grad(normals[0, 0], lights)
    assert gradient.isfinite().all() and gradient.any()


@parametrize("settings", [{}, SET])
@parametrize("degrees", [90.0, 33.0, -171.5])
def test_compact_estimates_turn_with_the_lights(pixels, degrees, settings):
    observations, lights = pixels
    network = random_network(**settings).double()
    with torch.no_grad():
        here, there = (
            network(observations, seen).normals for seen in (lights, turn(lights, degrees))
        )
    assert_close(there.double(), turn(here, degrees), atol=1e-5, rtol=0)
    # The correction is not nothing: without it the fit alone would pass.
    fit = fit_lambertian(observations / map_scale(observations), lights)
    assert (here - normalize(fit, dim=1)).abs().max() > 0.01


@parametrize("settings", [{}, SET])
def test_observations_that_are_not_valid_do_not_matter(pixels, settings):
    observations, lights = pixels
    network = random_network(**settings).double()
    valid = (torch.arange(10) < 7).expand(64, 10)
    garbage = observations.where(valid, torch.tensor(9.0, dtype=torch.float64))
    with torch.no_grad():
        expected = network(observations[:, :7], lights[:7]).normals
        assert_close(network(garbage, lights, valid).normals, expected, atol=1e-5, rtol=0)


@parametrize("mirror", [False, True])
def test_frames_there_and_back(pixels, mirror):
    observations, lights = pixels
    network = random_network().double()
    views = network.build_maps(
        observations, lights, rotation=Rotation(torch.linspace(-15, 15, 64), mirror=mirror)
    )
    vectors = normalize(torch.randn(64, 3, dtype=torch.float64), dim=1)
    assert_close(to_capture_frame(to_pixel_frame(vectors, views), views), vectors)
    # In its own frame a pixel's Lambertian normal has the azimuth of the further turn, mirrored or
    # not.
    fit = fit_lambertian(observations / map_scale(observations), lights)
    tilted = fit[:, :2].norm(dim=1) > 0.01
    azimuth = torch.rad2deg(torch.atan2(*to_pixel_frame(fit, views)[:, [1, 0]].unbind(1)))
    expected = torch.linspace(-15, 15, 64) * (-1 if mirror else 1)
    assert_close(azimuth[tilted], expected[tilted].double(), atol=1e-4, rtol=0)


def test_autocast_does_not_round_the_geometry(pixels):
    observations, lights = pixels[0].float(), pixels[1].float()
    network = random_network()
    for parameter in network.ne_net.out.parameters():
        torch.nn.init.zeros_(parameter)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        coarse = network(observations, lights).normals
    with torch.no_grad():
        assert_close(coarse, network(observations, lights).normals, atol=1e-6, rtol=0)


@parametrize("median_deg, shape", [(0.5, 1.0), (4.0, 2.5), (30.0, 0.7)])
def test_a_log_logistic_distribution(median_deg, shape):
    error = torch.tensor(
        [[math.log(math.radians(median_deg)), math.log(shape)]], dtype=torch.float64
    )
    expected = stats.fisk(shape, scale=median_deg)
    for limit_deg in (0.1, 5.0, 60.0):
        assert probability_within(error, limit_deg).item() == pytest.approx(
            expected.cdf(limit_deg + 0.1)
        )
    angles_deg = np.array([0.3, 4.0, 50.0])
    # Of the angle's logarithm, a tenth of a degree added.
    found = error_negative_log_likelihood(error, torch.from_numpy(np.radians(angles_deg)))
    logistic = stats.logistic(math.log(median_deg), 1 / shape)
    np.testing.assert_allclose(found, -logistic.logpdf(np.log(angles_deg + 0.1)))


def test_it_changes_no_normal():
    plain, telling = random_network(fits=["ls"]), random_network(fits=["ls"], error_head=True)
    telling.load_state_dict(plain.state_dict(), strict=False)
    generator = seeded(1)
    lights = normalize(torch.rand(9, 3, generator=generator) + 0.1, dim=1)
    observations = torch.rand(20, 9, generator=generator)
    with torch.inference_mode():
        normals, error = telling(observations, lights)
        assert torch.equal(plain(observations, lights).normals, normals)
        assert plain(observations, lights).error is None
        assert error.shape == (20, 2)
        assert error.dtype == torch.float32
        # It is of the pixel, not of its place in the capture's frame.
        turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turned = telling(observations, lights @ turn.T).error
    assert_close(turned, error, atol=1e-4, rtol=0)


NAMES = tuple(STARTING_FITS)


def draw_pixels(count, lights):
    """Observations (P, F), the largest of each pixel 1, and lights (P, F, 3) of its own for each
    pixel.
    """
    generator = seeded(0)
    directions = torch.randn(count, lights, 3, generator=generator) + torch.tensor((0.0, 0.0, 2.0))
    directions = normalize(directions, dim=-1)
    observations = torch.rand(count, lights, generator=generator)
    return observations / observations.amax(dim=1, keepdim=True), directions


@parametrize("name", [name for name in NAMES if name != "iw12-all"])
def test_they_are_the_methods_of_these_names(name):
    observations, directions = draw_pixels(20, 12)
    shared = directions[0]
    expected = make_estimator(name, MethodOptions(device="cpu")).estimate(
        observations.numpy(), shared.double().numpy()
    )
    found = fit_normals([name], observations, shared)[:, 0]
    assert_close(found, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)


@parametrize("name", NAMES)
def test_each_pixel_has_its_own_lights_and_their_number(name):
    observations, directions = draw_pixels(9, 12)
    count = torch.tensor([12, 11, 10, 9, 8, 7, 6, 5, 4])
    valid = torch.arange(12) < count[:, None]
    found = fit_normals([name], observations, directions, valid)
    for pixel in range(9):
        own = slice(0, int(count[pixel]))
        alone = fit_normals([name], observations[pixel : pixel + 1, own], directions[pixel, own])
        assert_close(found[pixel : pixel + 1], alone, atol=1e-4, rtol=0)
