"""ST14: a bi-polynomial reflectance, fitted to the lowest intensities above the shadows.

B. Shi, P. Tan, Y. Matsushita, K. Ikeuchi, "Bi-polynomial modeling of low-frequency reflectances", TPAMI 2014:

    I_j = rho(n.h_j, l_j.h_j) n.l_j,    rho a polynomial of order 2 in each argument,

h_j the bisector of light l_j and view v = (0, 0, 1). Highlights live in the high intensities; what is left of a
reflectance in the low ones varies slowly. For a given normal the coefficients are linear, so only the normal is
searched (variable projection).

The lowest intensities alone do not determine nine coefficients well. This departs from the paper in two ways:
coefficients are left out where few observations are kept (coefficient_count), and all but the constant have a
Gaussian prior around zero, that is around Lambert's law. The noise it is weighed against is estimated with the fit
(D. J. C. MacKay, "Bayesian interpolation", Neural Computation 1992), so exact data are fitted exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.fits.shadows import lit_observations

VIEW = (0.0, 0.0, 1.0)

FEWEST_LIT = 4
"""The brightest observations that never count as shadows: three fix a normal, one more tells noise."""

RANGE = 0.25
"""What 1 - n.h and 1 - l.h are divided by: about their range where a surface is lit and seen."""

PLACE = (0, 2, 5, 1, 4, 7, 3, 6, 8)
"""Order in which the coefficients of (1 - n.h)^a (1 - l.h)^b, at 3 a + b, enter the model: by degree, a first."""

FIRST_NOISE = 1e-3
"""Standard deviation that the estimate of the noise starts from, relative to the brightest kept observation."""

TURNED_AWAY = 10.0
"""Cost, for each unit of cosine, of a normal that faces away from the view or from a light that reaches it."""


def solve(
    observations: Tensor,
    light_directions: Tensor,
    *,
    shadow: float = 0.4,
    share: float = 0.25,
    fewest: int = 8,
    spread: float = 0.1,
    rounds: int = 5,
    steps: int = 4,
) -> Tensor:
    """Normals (P, 3) from observations (P, F) under lights (F, 3); zero where all is dark.

    Args:
        shadow: observations below this part of the pixel's quantile UNSHADED are shadows.
        share, fewest: how many of the others are kept, see kept_count. share is the paper's T_low.
        spread: standard deviation of the prior on the two linear coefficients, relative to the brightest kept
            observation; half of it for each degree more.
        rounds, steps: estimates of the noise, and Levenberg-Marquardt steps with each.
    """
    lights = light_directions.double()
    # The normal equations square the condition number: single precision would find no exact fit.
    scene = _select(observations.double(), lights, shadow=shadow, share=share, fewest=fewest, spread=spread)
    # A coarse search of the whole hemisphere finds lower costs at worse normals; least squares starts near enough.
    normals = normalize(observations.double() @ torch.linalg.pinv(lights).mT, dim=1)
    noise = torch.full_like(normals[:, 0], FIRST_NOISE**2)
    damping = torch.full_like(noise, 1e-2)
    for _ in range(rounds):
        fit = _fit(scene, normals, noise)
        for _ in range(steps):
            trial = _fit(scene, fit.step(damping), noise)
            better = trial.cost < fit.cost
            damping = torch.where(better, damping * 0.2, damping * 5).clamp(1e-7, 1e4)
            fit = fit.replaced(trial, better)
        normals, noise = fit.normals, fit.noise
    return normals.to(observations.dtype)


def kept_count(lit: Tensor, *, share: float, fewest: int) -> Tensor:
    """How many of so many observations above the shadows are kept: the share, but `fewest` at least, or all of them."""
    return torch.maximum((share * lit).ceil().long(), lit.clamp(max=fewest))


def coefficient_count(kept: Tensor) -> Tensor:
    """How many coefficients, 1 to 9, so many observations may have: two observations for each and for each of the
    normal's two angles."""
    return (kept // 2 - 2).clamp(1, len(PLACE))


class _Scene(NamedTuple):
    """What a batch of pixels keeps, K observations or fewer each, and the prior.

    intensities (P, K), the largest of a pixel 1; lights and bisectors (P, K, 3); light_powers (P, K, 3) of 1 - l.h;
    precision (9,) of the prior; ridge (P, 9), which takes coefficients out of the model; facing (P, F + 1, 3), the
    directions that the normal has to face.
    """

    intensities: Tensor
    lights: Tensor
    bisectors: Tensor
    light_powers: Tensor
    precision: Tensor
    ridge: Tensor
    facing: Tensor


class _Fit(NamedTuple):
    """The best reflectance for given normals, and where to go from there.

    normals (P, 3); cost (P,); noise (P,), the variance estimated from the residual; tangents (P, 3, 2), the directions
    in which the normal can move; gradient (P, 2) and curvature (P, 2, 2), half the cost's along them.
    """

    normals: Tensor
    cost: Tensor
    noise: Tensor
    tangents: Tensor
    gradient: Tensor
    curvature: Tensor

    def step(self, damping: Tensor) -> Tensor:
        """Normals (P, 3) one Levenberg-Marquardt step further, damped by (P,) relative to the mean curvature."""
        size = self.curvature.diagonal(dim1=1, dim2=2).mean(dim=1)
        damped = self.curvature + torch.diag_embed((damping * size + 1e-12)[:, None].expand(-1, 2))
        move, _ = torch.linalg.solve_ex(damped, self.gradient)
        return normalize(self.normals + (self.tangents @ move[..., None])[..., 0], dim=1)

    def replaced(self, trial: _Fit, better: Tensor) -> _Fit:
        """The trial where it is better (P,)."""
        pairs = zip(trial, self, strict=True)
        return _Fit(*(torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old) for new, old in pairs))


def _select(
    observations: Tensor, lights: Tensor, *, shadow: float, share: float, fewest: int, spread: float
) -> _Scene:
    count = len(lights)
    view = lights.new_tensor(VIEW)
    ordered, index = observations.sort(dim=1)
    is_lit = lit_observations(observations, shadow, fewest=FEWEST_LIT) & (observations > 0)
    lit = is_lit.sum(dim=1)
    kept = kept_count(lit, share=share, fewest=fewest)

    # As many places as a pixel without shadows fills, so that nothing depends on the other pixels of the batch.
    most = int(kept_count(torch.tensor(count), share=share, fewest=fewest))
    rank = torch.arange(most, device=lights.device)
    place = (count - lit[:, None] + rank).clamp(max=count - 1)
    is_kept = rank < kept[:, None]
    intensities = ordered.gather(1, place) * is_kept
    largest = intensities.amax(dim=1, keepdim=True)
    bisectors = normalize(lights + view, dim=1)
    chosen = index.gather(1, place)

    order = torch.arange(3, dtype=lights.dtype, device=lights.device)
    degree = (order[:, None] + order).flatten()
    left_out = torch.tensor(PLACE, device=lights.device) >= coefficient_count(kept)[:, None]
    return _Scene(
        intensities=intensities / torch.where(largest > 0, largest, 1),
        # A light of length zero adds nothing to any sum below.
        lights=lights[chosen] * is_kept[..., None],
        bisectors=bisectors[chosen],
        light_powers=_powers((lights * bisectors).sum(dim=1))[chosen],
        precision=torch.where(degree > 0, (spread * 0.5 ** (degree - 1)) ** -2, 0),
        ridge=torch.where(left_out, 1e9, 1e-12),
        facing=torch.cat((lights * is_lit[..., None], view.expand(len(observations), 1, 3)), dim=1),
    )


def _fit(scene: _Scene, normals: Tensor, noise: Tensor) -> _Fit:
    """Fit the coefficients for normals (P, 3) under a variance of the noise (P,)."""
    shading = (scene.lights @ normals[..., None])[..., 0].clamp(min=0)
    powers = _powers((scene.bisectors @ normals[..., None])[..., 0])
    design = ((shading[..., None] * powers)[..., None] * scene.light_powers[..., None, :]).flatten(-2)
    prior = noise[:, None] * scene.precision + scene.ridge
    factor, _ = torch.linalg.cholesky_ex(design.mT @ design + torch.diag_embed(prior))
    coefficients = torch.cholesky_solve(design.mT @ scene.intensities[..., None], factor)
    residual = scene.intensities[..., None] - design @ coefficients
    squares = residual.square().sum(dim=(1, 2))

    # MacKay's number of well determined parameters; the normal's two angles always count.
    slack = (prior * torch.cholesky_inverse(factor).diagonal(dim1=1, dim2=2)).sum(dim=1)
    freedom = (scene.intensities > 0).sum(dim=1) - (2 + len(PLACE) - slack)

    # How the model changes with the normal, less what the coefficients make up for (Kaufman's approximation).
    by_power = scene.light_powers @ coefficients.view(-1, 3, 3).mT
    reflectance = (powers * by_power).sum(dim=-1)
    slope = (by_power[..., 1] + 2 * powers[..., 1] * by_power[..., 2]) / -RANGE
    change = (slope * shading)[..., None] * scene.bisectors
    change += (reflectance * (shading > 0))[..., None] * scene.lights
    tangents = _tangents(normals)
    jacobian = change @ tangents
    absorbed = torch.linalg.solve_triangular(factor, design.mT @ jacobian, upper=False)

    away = (-scene.facing @ normals[..., None]).clamp(min=0).sum(dim=(1, 2))
    return _Fit(
        normals=normals,
        cost=squares + (prior * coefficients[..., 0].square()).sum(dim=1) + TURNED_AWAY * away,
        noise=squares / freedom.clamp(min=0.5),
        tangents=tangents,
        gradient=(jacobian.mT @ residual)[..., 0],
        curvature=jacobian.mT @ jacobian - absorbed.mT @ absorbed,
    )


def _tangents(normals: Tensor) -> Tensor:
    """Two unit vectors (P, 3, 2) across each normal."""
    x, _, z = normals.unbind(dim=1)
    first = normalize(torch.stack((z, torch.zeros_like(x), -x), dim=1), dim=1)
    return torch.stack((first, torch.linalg.cross(normals, first)), dim=-1)


def _powers(cosine: Tensor) -> Tensor:
    """Powers 0, 1, 2 (..., 3) of 1 - cosine, scaled: an expansion about where normal, light and view meet."""
    base = (1 - cosine) / RANGE
    return torch.stack((torch.ones_like(base), base, base.square()), dim=-1)
