"""IA14: the image formation inverted, n.l as a monotone polynomial of the observation and of l.v.

Ikehata and Aizawa, Photometric stereo using constrained bivariate regression for general isotropic surfaces, CVPR
2014.
"""

from __future__ import annotations

from math import comb

import torch
from torch import Tensor

from splinecli.fits.quadratic_programme import minimise_nonnegative
from splinecli.fits.shadows import lit_observations

__all__ = ["fit", "solve"]

DEGREE_OBSERVATION = 2  # the paper's N1
DEGREE_LIGHT = 4  # the paper's N2
_RIDGE = 1e-10  # for a pixel without light, where nothing else fixes the normal and the polynomial


def solve(observations: Tensor, light_directions: Tensor, valid: Tensor | None = None) -> Tensor:
    """Normals (P, 3) from observations (P, F), at most 1, under lights (F, 3) or (P, F, 3). See fit."""
    return fit(observations, light_directions, valid)[0]


def fit(
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    shadow_share: float = 0.2,
    prior_weight: float = 0.01,
) -> tuple[Tensor, Tensor]:
    """Normals (P, 3), of any length, and the polynomial's increments (P, N1, N2 + 1), each from zero up.

    Minimises sum_j (n.l_j - g(I_j, l_j.v))^2 + prior_weight * (variance of the increments) over n and g, where

        g(x, y) = sum_ik c_ik B_i(x) B_k(y),   c_0k = 0,   c_ik = c_(i-1)k + d_ik / (N1 * mean I),   d_ik >= 0,

    with B the Bernstein polynomials of degree N1 = 2 in the observation and N2 = 4 in l.v: g is zero without light
    and does not fall as the observation grows.

    The length of n is free, so all could be zero. That is excluded by setting the mean of g over the lights used to
    1. It is linear, so that the programme stays convex; it says nothing about n, so that no direction is preferred
    (as n_z = 1 would); and it binds g where there are data, not where a polynomial may be large at no cost.

    The prior is not the paper's. Ten lights do not determine the 13 unknowns: of all that fit, it takes the g nearest
    to Lambert's law, where all increments are equal. With 96 lights it hardly matters. The mean of g and the scale
    of the threshold are choices of this module as well.

    Args:
        observations: (P, F), the largest of a pixel at most 1.
        light_directions: (F, 3) or (P, F, 3), unit length, z to the camera.
        valid: (P, F) bool, all by default.
        shadow_share: of the pixel's quantile UNSHADED; observations below it are taken for shadows and left out, but
            never one of the three largest.
        prior_weight: a variance of 1 costs as much as a light whose residual is sqrt(prior_weight) of the mean
            shading.
    """
    intensities, lights = observations.double(), light_directions.double()
    if valid is not None:
        intensities = torch.where(valid, intensities, 0)
    used = lit_observations(intensities, shadow_share, valid) & (intensities > 0)
    intensities = torch.where(used, intensities, 0)
    directions = torch.where(used[..., None], lights, 0)
    basis = _increment_basis(intensities, lights[..., 2])

    # The normal is eliminated: for given increments it is a least squares fit, n = normal_of @ d.
    ridge = _RIDGE * torch.eye(3, dtype=lights.dtype, device=lights.device)
    normal_of = torch.linalg.solve(directions.mT @ directions + ridge, directions.mT @ basis)
    residual = basis - directions @ normal_of
    size = basis.shape[-1]
    eye = torch.eye(size, dtype=lights.dtype, device=lights.device)
    mean = basis.sum(dim=1) / used.sum(dim=1, keepdim=True).clamp(min=1)
    # All is homogeneous of degree 2 in d but for mean'd = 1. Putting (mean'd - 1)^2 in the sum instead changes the
    # length of the optimum, not its direction: on the ray through d the least value only falls with the sum's own.
    hessian = (
        residual.mT @ residual
        + prior_weight / size * (eye - 1 / size)
        + _RIDGE * eye
        + mean[:, :, None] * mean[:, None, :]
    )
    increments = minimise_nonnegative(hessian, mean)
    normals = (normal_of @ increments[..., None])[..., 0]
    # Back to the length at which the mean of g is 1; zero stays zero.
    length = (mean * increments).sum(dim=1, keepdim=True)
    length = torch.where(length > 0, length, 1)
    increments = (increments / length).reshape(-1, DEGREE_OBSERVATION, DEGREE_LIGHT + 1)
    return (normals / length).to(observations.dtype), increments.to(observations.dtype)


def _increment_basis(intensities: Tensor, cosines: Tensor) -> Tensor:
    """(P, F, N1 * (N2 + 1)): what each increment adds to g, for intensities (P, F), zero where unused.

    All increments 1 make g the intensity over its mean: sum_i i B_i(x) = N1 x, and sum_k B_k(y) = 1.
    """
    steps = _bernstein(intensities, DEGREE_OBSERVATION)[..., 1:]
    # The increment d_ik is in all of c_ik, c_(i+1)k ..
    steps = steps.flip(-1).cumsum(-1).flip(-1)
    mean = intensities.sum(dim=1) / (intensities > 0).sum(dim=1).clamp(min=1)
    steps = steps / (DEGREE_OBSERVATION * torch.where(mean > 0, mean, 1)[:, None, None])
    return (steps[..., None] * _bernstein(cosines.clamp(0, 1), DEGREE_LIGHT)[..., None, :]).flatten(2)


def _bernstein(values: Tensor, degree: int) -> Tensor:
    """The polynomials comb(degree, i) x^i (1 - x)^(degree - i) in a new last dimension, for x in [0, 1]."""
    terms = [comb(degree, i) * values**i * (1 - values) ** (degree - i) for i in range(degree + 1)]
    return torch.stack(terms, dim=-1)
