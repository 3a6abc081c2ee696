"""IA14: inverse image formation, in which n.l is a monotone polynomial of the observation and l.v.

Ikehata and Aizawa, Photometric stereo using constrained bivariate regression for general isotropic
surfaces, CVPR 2014.
"""

from math import comb

import torch
from torch import Tensor

from splinecli.estimate.fits.least_squares import lit_observations

DEGREE_OBSERVATION, DEGREE_LIGHT = 2, 4  # N1 and N2 in the paper
_RIDGE = 1e-10  # makes the normal and the polynomial of a black pixel unique


def solve_ia14(
    observations: Tensor, light_directions: Tensor, valid: Tensor | None = None
) -> Tensor:
    """Return normals (P, 3) from observations (P, F) of at most 1 under lights (F, 3) or (P, F, 3).

    See fit_ia14.
    """
    return fit_ia14(observations, light_directions, valid)[0]


def fit_ia14(
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
    *,
    prior_weight: float = 0.01,
) -> tuple[Tensor, Tensor]:
    """Return normals (P, 3) of any length, and the non-negative increments (P, N1, N2 + 1) of the
    polynomials.

    Minimises sum_j (n.l_j - g(I_j, l_j.v))^2 + prior_weight * (variance of the increments) over n
    and g, where

        g(x, y) = sum_ik c_ik B_i(x) B_k(y),   c_0k = 0,   c_ik = c_(i-1)k + d_ik / (N1 * mean I),
        d_ik >= 0,

    where B are the Bernstein polynomials of degree N1 = 2 in the observation and N2 = 4 in l.v.
    Thus, g is zero for a zero observation and does not decrease as the observation grows.

    The length of n is free, so n = 0, g = 0 would be a solution. To exclude it, the mean of g over
    the valid lights is set to 1. This condition is linear, so the problem remains convex. Since it
    does not depend on n, it does not favour any direction, whereas n_z = 1 would favour the view
    direction. It also constrains g at the observed data.

    The prior is not from the paper. Ten lights do not determine the 13 unknowns. Among all g that
    fit, the prior selects the one closest to Lambert's law, for which all increments are equal.
    With 96 lights, it hardly matters. The condition on the mean of g and the scale of the threshold
    are not from the paper either. A variance of 1 costs as much as a residual of sqrt(prior_weight)
    times the mean shading.

    The observations (P, F) are at most 1, under unit light directions (F, 3) or (P, F, 3); `valid`
    (P, F) is true by default.
    """
    intensities, lights = observations.double(), light_directions.double()
    if valid is not None:
        intensities = torch.where(valid, intensities, 0)
    used = lit_observations(intensities, 0.2, valid) & (intensities > 0)
    intensities = torch.where(used, intensities, 0)
    directions = torch.where(used[..., None], lights, 0)
    basis = _increment_basis(intensities, lights[..., 2])

    # Eliminate the normal, which for given increments is a least-squares fit, n = normal_of @ d.
    ridge = _RIDGE * torch.eye(3, dtype=lights.dtype, device=lights.device)
    normal_of = torch.linalg.solve(directions.mT @ directions + ridge, directions.mT @ basis)
    residual = basis - directions @ normal_of
    size = basis.shape[-1]
    eye = torch.eye(size, dtype=lights.dtype, device=lights.device)
    mean = basis.sum(dim=1) / used.sum(dim=1, keepdim=True).clamp(min=1)
    # Apart from the condition mean'd = 1, the sum is homogeneous of degree 2 in d. Replacing the
    # condition with a term (mean'd - 1)^2 changes the length of the optimum but not its direction.
    prior = prior_weight / size * (eye - 1 / size)
    hessian = residual.mT @ residual + prior + _RIDGE * eye + mean[:, :, None] * mean[:, None, :]
    increments = minimise_nonnegative(hessian, mean)
    normals = (normal_of @ increments[..., None])[..., 0]
    # Scale to the length for which the mean of g is 1. Zero stays zero.
    length = (mean * increments).sum(dim=1, keepdim=True)
    length = torch.where(length > 0, length, 1)
    increments = (increments / length).reshape(-1, DEGREE_OBSERVATION, DEGREE_LIGHT + 1)
    return (normals / length).to(observations.dtype), increments.to(observations.dtype)


def _increment_basis(intensities: Tensor, cosines: Tensor) -> Tensor:
    """Return the contribution (P, F, N1 * (N2 + 1)) of each increment to g, for intensities (P, F)
    that are zero where unused.

    If all increments are 1, g is the intensity divided by its mean: sum_i i B_i(x) = N1 x, and
    sum_k B_k(y) = 1.
    """
    steps = _bernstein(intensities, DEGREE_OBSERVATION)[..., 1:]
    # The increment d_ik contributes to c_ik, c_(i+1)k, ...
    steps = steps.flip(-1).cumsum(-1).flip(-1)
    mean = intensities.sum(dim=1) / (intensities > 0).sum(dim=1).clamp(min=1)
    steps = steps / (DEGREE_OBSERVATION * torch.where(mean > 0, mean, 1)[:, None, None])
    return (steps[..., None] * _bernstein(cosines.clamp(0, 1), DEGREE_LIGHT)[..., None, :]).flatten(
        2
    )


def _bernstein(values: Tensor, degree: int) -> Tensor:
    """Return comb(degree, i) x^i (1 - x)^(degree - i) for x in [0, 1], with i along a new last
    dimension.
    """
    terms = [comb(degree, i) * values**i * (1 - values) ** (degree - i) for i in range(degree + 1)]
    return torch.stack(terms, dim=-1)


def minimise_nonnegative(hessian: Tensor, linear: Tensor) -> Tensor:
    """Return the x >= 0 (P, K) that minimise x'Hx / 2 - q'x, for positive definite Hessians H
    (P, K, K) and q (P, K).

    Block principal pivoting (Júdice and Pires 1994; the backup rule as in Kim and Park 2011, SIAM
    J. Sci. Comput., algorithm 2): guess which variables are free, solve for them with the others
    fixed at zero, and exchange those that violate x >= 0 or the sign of the gradient. In exact
    arithmetic, this ends at the optimum. If a Hessian is nearly singular, rounding errors may cause
    cycles; the result is then feasible and close to the optimum.
    """
    count, size = linear.shape
    eye = torch.eye(size, dtype=hessian.dtype, device=hessian.device)
    position = torch.arange(size, device=hessian.device)
    tolerance = 100 * torch.finfo(hessian.dtype).eps
    free = torch.ones_like(linear, dtype=torch.bool)
    fewest_wrong = linear.new_full((count,), size + 1)
    patience = linear.new_full((count,), 3)
    found, left = torch.zeros_like(linear), torch.arange(count, device=hessian.device)
    for _ in range(100):
        system = torch.where(free[:, :, None] & free[:, None, :], hessian, eye)
        right_side = torch.where(free, linear, 0)[..., None]
        x = torch.cholesky_solve(right_side, torch.linalg.cholesky(system))[..., 0]
        gradient = (hessian @ x[..., None])[..., 0] - linear
        value = torch.where(free, x, gradient)
        scale = torch.where(
            free, x.abs().amax(dim=1, keepdim=True), linear.abs().amax(dim=1, keepdim=True)
        )
        wrong = value < -tolerance * scale
        found[left] = torch.where(free, x, 0)
        wrong_count = wrong.sum(dim=1)
        fewer = wrong_count < fewest_wrong
        fewest_wrong = torch.where(fewer, wrong_count, fewest_wrong)
        patience = torch.where(fewer, 3, patience - 1)
        # Exchanging all variables at once may cycle. After three exchanges without improvement,
        # exchange only the last variable, which cannot cycle.
        last = torch.where(wrong, position, -1).amax(dim=1, keepdim=True)
        free = free ^ torch.where(patience[:, None] < 0, wrong & (position == last), wrong)
        rest = torch.nonzero(wrong_count)[:, 0]  # most pixels converge in a few steps
        if not len(rest):
            break
        hessian, linear, free, fewest_wrong, patience, left = (
            values[rest] for values in (hessian, linear, free, fewest_wrong, patience, left)
        )
    return found.clamp(min=0)
