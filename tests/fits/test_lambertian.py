"""The robust Lambertian fit, on pixels made by the Lambertian law."""

import numpy as np
import torch
from torch import Tensor

from scenes import cap_directions, ring_lights
from splinecli.fits.least_squares import fit_lambertian
from splinecli.maths.normals import angle_between_deg


def normals_under(limit_deg: float, count: int) -> Tensor:
    return torch.tensor(cap_directions(count, limit_deg), dtype=torch.float32)


def ring(count: int, zenith_deg: float) -> Tensor:
    return torch.tensor(ring_lights(count, zenith_deg, 0.1), dtype=torch.float32)


def error_deg(scaled_normals: Tensor, truth: Tensor) -> np.ndarray:
    return angle_between_deg(torch.nn.functional.normalize(scaled_normals, dim=1).numpy(), truth.numpy())


def to_unit_scale(observations: Tensor) -> Tensor:
    return observations / observations.amax(dim=1, keepdim=True)


def test_pixels_without_shadow_are_recovered_with_their_albedo() -> None:
    truth, lights = normals_under(30, 500), ring(10, 40)
    observations = to_unit_scale(truth @ lights.T)
    assert observations.min() > 0.05  # no light is taken for a shadow
    scaled = fit_lambertian(observations, lights)
    assert error_deg(scaled, truth).max() < 0.1
    albedo = 1 / (truth @ lights.T).amax(dim=1)
    torch.testing.assert_close(scaled.norm(dim=1), albedo, rtol=1e-3, atol=0)


def test_shadows_over_a_third_of_the_lights_are_seen_through() -> None:
    truth, lights = normals_under(25, 500), ring(12, 40)
    observations = truth @ lights.T
    # Four neighbours of the ring lie in cast shadow, elsewhere for every pixel.
    first = torch.arange(len(truth)) % 12
    shadowed = (torch.arange(12) - first[:, None]) % 12 < 4
    observations = to_unit_scale(observations.masked_fill(shadowed, 0.0))
    plain = observations @ torch.linalg.pinv(lights).T
    assert error_deg(plain, truth).mean() > 5
    assert error_deg(fit_lambertian(observations, lights), truth).max() < 0.5


def test_a_highlight_counts_less_than_in_least_squares() -> None:
    truth, lights = normals_under(20, 200), ring(12, 40)
    observations = truth @ lights.T
    observations[:, 3] *= 2
    observations = to_unit_scale(observations)
    plain = error_deg(observations @ torch.linalg.pinv(lights).T, truth)
    assert plain.mean() > 4
    assert error_deg(fit_lambertian(observations, lights), truth).mean() < 0.1 * plain.mean()
