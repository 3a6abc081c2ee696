"""ST14: a bi-polynomial reflectance fitted to the lowest intensities above the shadows.

B. Shi, P. Tan, Y. Matsushita, K. Ikeuchi, "Bi-polynomial modeling of low-frequency reflectances",
TPAMI 2014:

    I_j = rho(n.h_j, l_j.h_j) n.l_j,    rho a polynomial of order 2 in each argument,

where h_j is the bisector of the light l_j and the view v = (0, 0, 1). Highlights affect only the
high intensities; the rest of the reflectance varies slowly. For a given normal, the model is linear
in the coefficients, so the search is only over the normal (variable projection).

The lowest intensities alone do not determine nine coefficients well. Therefore, this module differs
from the paper in two ways. If few observations are kept, some coefficients are omitted. All except
the constant one have a Gaussian prior around zero, that is, around Lambert's law. The noise against
which the prior is weighed is also estimated (D. J. C. MacKay, "Bayesian interpolation", Neural
Computation 1992), so exact data are fitted exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.estimate.fits.least_squares import lit_observations, weighted_least_squares

RANGE = 0.25  # divisor of 1 - n.h and 1 - l.h, about their range on lit and visible surfaces

# Order in which coefficients are added to the model. Index 3 a + b belongs to (1 - n.h)^a (1 -
# l.h)^b. Lower degrees come first and, within a degree, larger a.
PLACE = (0, 2, 5, 1, 4, 7, 3, 6, 8)


def solve_st14(observations: Tensor, light_directions: Tensor) -> Tensor:
    """Return normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3), zero for
    black pixels.
    """
    lights = light_directions.double()
    # The normal equations square the condition number, so single precision would not be accurate
    # enough.
    problem = _select(observations.double(), lights)
    # Start from least squares. A coarse search over the hemisphere finds lower costs but worse
    # normals.
    all_alike = torch.ones_like(observations, dtype=torch.float64)
    normals = normalize(weighted_least_squares(observations.double(), lights, all_alike)[0], dim=1)
    # The initial standard deviation, relative to the brightest kept observation
    noise = torch.full_like(normals[:, 0], 1e-3**2)
    damping = torch.full_like(noise, 1e-2)
    for _ in range(5):
        fit = _fit(problem, normals, noise)
        for _ in range(4):  # Levenberg-Marquardt steps
            trial = _fit(problem, fit.step(damping), noise)
            better = trial.cost < fit.cost
            damping = torch.where(better, damping * 0.2, damping * 5).clamp(1e-7, 1e4)
            fit = fit.replaced(trial, better)
        normals, noise = fit.normals, fit.noise
    return normals.to(observations.dtype)


def kept_count(lit: Tensor) -> Tensor:
    """Return how many of `lit` observations are kept: a quarter (T_low in the paper), but at least
    8 if there are as many.
    """
    return torch.maximum((0.25 * lit).ceil().long(), lit.clamp(max=8))


class _Problem(NamedTuple):
    """The observations kept for a batch of pixels, at most K per pixel, and the prior."""

    intensities: Tensor  # (P, K), scaled to a largest value of 1 per pixel
    lights: Tensor  # (P, K, 3)
    bisectors: Tensor  # (P, K, 3)
    light_powers: Tensor  # (P, K, 3), powers of 1 - l.h
    precision: Tensor  # (9,), of the prior
    ridge: Tensor  # (P, 9), large for coefficients that are removed from the model
    facing: Tensor  # (P, F + 1, 3), the directions that the normal must face


class _Fit(NamedTuple):
    """The best reflectance for given normals, and the derivatives of its cost."""

    normals: Tensor  # (P, 3)
    cost: Tensor  # (P,)
    noise: Tensor  # (P,), the variance estimated from the residual
    tangents: Tensor  # (P, 3, 2), the directions in which the normal can move
    gradient: Tensor  # (P, 2), half the first derivative of the cost along the tangents
    curvature: Tensor  # (P, 2, 2), half the second derivative

    def step(self, damping: Tensor) -> Tensor:
        """Return normals (P, 3) after a Levenberg-Marquardt step, damped by `damping` (P,) times
        the mean curvature.
        """
        size = self.curvature.diagonal(dim1=1, dim2=2).mean(dim=1)
        damped = self.curvature + torch.diag_embed((damping * size + 1e-12)[:, None].expand(-1, 2))
        move, _ = torch.linalg.solve_ex(damped, self.gradient)
        return normalize(self.normals + (self.tangents @ move[..., None])[..., 0], dim=1)

    def replaced(self, trial: _Fit, better: Tensor) -> _Fit:
        """Return this fit with the trial's values for the pixels that it improves, `better`
        (P,).
        """
        pairs = zip(trial, self, strict=True)
        return _Fit(
            *(torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old) for new, old in pairs)
        )


def _select(observations: Tensor, lights: Tensor) -> _Problem:
    count = observations.shape[1]
    view = lights.new_tensor((0.0, 0.0, 1.0))
    ordered, index = observations.sort(dim=1)
    # The four brightest are never treated as shadows, because three are needed for the normal and
    # one for the noise.
    is_lit = lit_observations(observations, 0.4, fewest=4) & (observations > 0)
    lit = is_lit.sum(dim=1)
    kept = kept_count(lit)

    # Use as many columns as a pixel without shadows needs, so that no pixel depends on the others
    # in its batch.
    most = int(kept_count(torch.tensor(count)))
    rank = torch.arange(most, device=lights.device)
    place = (count - lit[:, None] + rank).clamp(max=count - 1)
    is_kept = rank < kept[:, None]
    intensities = ordered.gather(1, place) * is_kept
    largest = intensities.amax(dim=1, keepdim=True)
    chosen = index.gather(1, place)
    lights = lights.expand(*observations.shape, 3)
    kept_lights = lights.gather(1, chosen[..., None].expand(-1, -1, 3))
    bisectors = normalize(kept_lights + view, dim=-1)

    order = torch.arange(3, dtype=lights.dtype, device=lights.device)
    degree = (order[:, None] + order).flatten()
    # Require two observations for each of 1 to 9 coefficients and each of the two angles of the
    # normal.
    coefficients = (kept // 2 - 2).clamp(1, len(PLACE))
    left_out = torch.tensor(PLACE, device=lights.device) >= coefficients[:, None]
    return _Problem(
        intensities=intensities / torch.where(largest > 0, largest, 1),
        # A light of length zero does not contribute to any sum below.
        lights=kept_lights * is_kept[..., None],
        bisectors=bisectors,
        light_powers=_powers((kept_lights * bisectors).sum(dim=-1)),
        # The standard deviation of the prior, relative to the brightest kept observation, is halved
        # with each degree.
        precision=torch.where(degree > 0, (0.1 * 0.5 ** (degree - 1)) ** -2, 0),
        ridge=torch.where(left_out, 1e9, 1e-12),
        facing=torch.cat((lights * is_lit[..., None], view.expand(len(observations), 1, 3)), dim=1),
    )


def _fit(problem: _Problem, normals: Tensor, noise: Tensor) -> _Fit:
    """Fit the coefficients for given normals (P, 3) and noise variances (P,)."""
    shading = (problem.lights @ normals[..., None])[..., 0].clamp(min=0)
    powers = _powers((problem.bisectors @ normals[..., None])[..., 0])
    design = (
        (shading[..., None] * powers)[..., None] * problem.light_powers[..., None, :]
    ).flatten(-2)
    prior = noise[:, None] * problem.precision + problem.ridge
    factor, _ = torch.linalg.cholesky_ex(design.mT @ design + torch.diag_embed(prior))
    coefficients = torch.cholesky_solve(design.mT @ problem.intensities[..., None], factor)
    residual = problem.intensities[..., None] - design @ coefficients
    squares = residual.square().sum(dim=(1, 2))

    # The number of well-determined parameters (MacKay). The two angles of the normal are always
    # included.
    slack = (prior * torch.cholesky_inverse(factor).diagonal(dim1=1, dim2=2)).sum(dim=1)
    freedom = (problem.intensities > 0).sum(dim=1) - (2 + len(PLACE) - slack)

    # The derivative of the model with respect to the normal, without the part that the coefficients
    # absorb (Kaufman's approximation).
    by_power = problem.light_powers @ coefficients.view(-1, 3, 3).mT
    reflectance = (powers * by_power).sum(dim=-1)
    slope = (by_power[..., 1] + 2 * powers[..., 1] * by_power[..., 2]) / -RANGE
    change = (slope * shading)[..., None] * problem.bisectors
    change += (reflectance * (shading > 0))[..., None] * problem.lights
    # Two unit vectors orthogonal to each normal.
    x, _, z = normals.unbind(dim=1)
    first = normalize(torch.stack((z, torch.zeros_like(x), -x), dim=1), dim=1)
    tangents = torch.stack((first, torch.linalg.cross(normals, first)), dim=-1)
    jacobian = change @ tangents
    absorbed = torch.linalg.solve_triangular(factor, design.mT @ jacobian, upper=False)

    away = (-problem.facing @ normals[..., None]).clamp(min=0).sum(dim=(1, 2))
    return _Fit(
        normals=normals,
        # Normals that face away from the view, or from a light that reaches them, cost 10 per unit
        # of cosine.
        cost=squares + (prior * coefficients[..., 0].square()).sum(dim=1) + 10.0 * away,
        noise=squares / freedom.clamp(min=0.5),
        tangents=tangents,
        gradient=(jacobian.mT @ residual)[..., 0],
        curvature=jacobian.mT @ jacobian - absorbed.mT @ absorbed,
    )


def _powers(cosine: Tensor) -> Tensor:
    """Return the powers 0, 1, 2 (..., 3) of (1 - cosine) / RANGE, for an expansion about cosine =
    1.
    """
    base = (1 - cosine) / RANGE
    return torch.stack((torch.ones_like(base), base, base.square()), dim=-1)
