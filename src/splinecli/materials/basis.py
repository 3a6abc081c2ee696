"""The few materials of a capture, found on a sample of its pixels.

A gloss is a material without its base: objects are painted, printed or tarnished in many colours, and have few glosses.
The radiance of a pixel is

    base * ((1 - metallic) * diffuse + metallic * facets) + level * (1 - metallic) * facets

in the unit of the observations, where `diffuse` and `facets` are lobes of the principled BRDF. With the roughness
fixed, radiance is linear in the other parameters, except for Fresnel's increase at grazing angles. The camera looks
along the z axis and lights are above the horizon, so this is at most 0.2 % of full reflection.

Only the base is the pixel's own. Every gloss of a grid is fitted to every pixel of the sample. The few that together
explain the sample best form the basis. The mean over the grid, weighted by how well each gloss fits the pixels of one
of them, gives its parameters and their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from splinecli.maths import Float64Array
from splinecli.synthesis.principled import PrincipledMaterial

LEAST_Z = 0.05  # of a normal; the BRDF has no value for a surface that faces away from the camera
F0_OF_SPECULAR = 0.08  # reflectance at normal incidence of a dielectric whose `specular` is 1 (Burley 2012)
GGX = 2.0  # the exponent of the facets' distribution; smaller ones have longer tails

_DIFFUSE_ROUGHNESS = 0.25
"""Of the diffuse lobe. In the BRDF, it follows the roughness of the facets. Real surfaces and the renderer's deviate
from that by more, so that it would only mislead the fit."""


class Geometry(NamedTuple):
    """The cosines that the BRDF depends on, and the expected errors of the normals."""

    n_dot_l: Tensor  # (P, F), negative in attached shadow
    n_dot_v: Tensor  # (P, 1), positive
    l_dot_v: Tensor  # (F) or (P, F)
    normal_error: Tensor  # (P, 1), standard deviation of the normal along each axis, in radians

    @classmethod
    def of(cls, normals: Tensor, lights: Tensor, normal_error: Tensor) -> Geometry:
        """Return the geometry of unit normals (P, 3), unit lights, (F, 3) or (P, F, 3), and errors (P,) in radians.

        z points to the camera.
        """
        n_dot_l = normals @ lights.T if lights.ndim == 2 else torch.einsum("pfc,pc->pf", lights, normals)
        return cls(n_dot_l, normals[:, 2:].clamp(min=LEAST_Z), lights[..., 2], normal_error[:, None])


def _lobe(geometry: Geometry, metallic: float, roughness: Tensor, minnaert: Tensor, tail: Tensor) -> Tensor:
    """Return the radiance (P, F) of a white material without reflection of dielectrics; the tensors are (P, 1)."""
    one = torch.ones_like(geometry.n_dot_v)
    zero = 0 * one
    white = PrincipledMaterial(
        base=one,
        metallic=metallic * one,
        specular=zero,
        roughness=roughness * one,
        sheen=zero,
        clearcoat=zero,
        clearcoat_gloss=zero,
        interface_loss=zero,
        minnaert=minnaert * one,
        tail_exponent=tail * one,
        second_share=zero,
        second_roughness=one,
        retro=zero,
    )
    return white.shade(*geometry[:3])


def diffuse_lobe(geometry: Geometry, minnaert: Tensor) -> Tensor:
    """Return the radiance (P, F) of a white matte surface, zero in attached shadow. `minnaert` is (P, 1) or (1, 1)."""
    one = torch.ones(1, 1)
    return _lobe(geometry, 0.0, _DIFFUSE_ROUGHNESS * one, minnaert, GGX * one)


def facet_lobe(geometry: Geometry, roughness: Tensor, tail: Tensor) -> Tensor:
    """Return the radiance (P, F) of a perfect metal, zero in attached shadow. The others are (P, 1) or (1, 1).

    The lobe is the mean over the errors of the normals, which is wider: a highlight in a wrong place is worse than a
    blurred one. The variance of the facets' slopes is roughness^4 / 2 (of Beckmann's distribution; GGX has none).
    """
    wide = (roughness**4 + 2 * geometry.normal_error**2) ** 0.25
    return _lobe(geometry, 1.0, wide, torch.ones(1, 1), tail)


MOST_GLOSSES = 6
LONG_TAIL = 1.4  # of the metals' second lobe on the grid; measured metals have longer tails than GGX

_ROUGHNESS = (0.1, 0.15, 0.2, 0.27, 0.35, 0.43, 0.52, 0.62, 0.75, 0.9)
_MINNAERT = (0.9, 1.0, 1.15, 1.4)
_LEVELS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.3)  # relative to the bright pixels' albedo
_LEVEL_SHARES = (0.05, 0.06, 0.09, 0.16, 0.26, 0.2, 0.1, 0.06, 0.03, 0.02)  # how common each is: 4 % is usual
_METALS = 0.3  # share of metals among materials
_ROUGH, _MOST_ROUGH_LEVEL = 0.7, 0.3  # rough facets of a higher level only imitate interreflection
"""The grid, and what is known before. The shares are about as in synthesis/principled.py."""

_RELATIVE, _DEGREES_OF_FREEDOM = 0.05, 3.0
_MOST_LOBE_ERROR = 0.6
"""The errors of observations: a share of the prediction, with the tails of Student's distribution. A sharp lobe also
changes with the normals' errors, at most by the last share of itself."""

_SHADOW_COST = 3.0  # most that an observation counts that is too dark: it may be in shadow
_MOST_COST = 25.0  # most by which a gloss is worse than the best for one pixel, which may show anything
_NO_BASE, _NO_BASE_COST = 4.0, 2.0
"""A dielectric whose facets reflect more than so many times its base, as a metal does, costs so much an e-fold."""

_PRIOR_OF_SAMPLE = 0.3  # of the prior of a gloss, that each pixel counts
_LEAST_GAIN = 0.3  # of the mean cost, for a further gloss
_LEAST_SHARE = 0.02  # of the sample, for a gloss
_INDEPENDENT = 30.0  # pixels: more pixels add no information on a gloss, because their deviations are alike
_LEVEL_STEPS = (1.0, 0.75, 0.5, 0.25, 0.0)  # shares of a level that are compared
_STEPS = 4  # of the robust fit of a base


@dataclass(frozen=True)
class Gloss:
    """A material without its base, with the uncertainty of its parameters."""

    roughness: float
    roughness_error: float  # standard deviation
    metallic: float  # the probability that it is a metal
    level: float  # reflectance of the facets of a dielectric, in the unit of the observations
    minnaert: float
    tail: float
    share: float  # of the pixels

    @property
    def is_metal(self) -> bool:
        return self.metallic > 0.5


class Sample(NamedTuple):
    """Observations with their geometry and errors."""

    observations: Tensor  # (P, F)
    geometry: Geometry
    seen: Tensor  # (P, F), 1 where the light reaches the pixel, else 0
    floor: Tensor  # (P,), the error that even a dark observation has
    white: float  # pictures end at this value

    def take(self, chosen: Tensor) -> Sample:
        """Return some of the pixels."""
        cosines, z, shared, error = self.geometry
        own = Geometry(cosines[chosen], z[chosen], shared if shared.ndim == 1 else shared[chosen], error[chosen])
        return Sample(self.observations[chosen], own, self.seen[chosen], self.floor[chosen], self.white)


def noise_floor(observations: Tensor, bright: float) -> Tensor:
    """Return the errors (P,) that dark observations (P, F) have; `bright` is the albedo of bright pixels."""
    return 0.02 * observations.mean(1) + 0.004 * bright


def fit_base(
    sample: Sample,
    diffuse: Tensor,
    facets: Tensor,
    metallic: Tensor,
    level: Tensor,
    lobe_error: Tensor,
    usual: float | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the costs (P, K) of K glosses, the bases (P, K) that fit best, and the observations' weights (P, K, F).

    Args:
        diffuse, facets: lobes (P, F).
        metallic, level: (K,), or (P, K).
        lobe_error: (P, 1, 1), from lobe_error.
        usual: the base of the gloss's other pixels, which decides where a pixel does not show its own. None for none.
    """
    metallic, level = (values[..., None] if values.ndim == 2 else values[None, :, None] for values in (metallic, level))
    seen, floor, observed = sample.seen[:, None], sample.floor[:, None, None], sample.observations[:, None]
    slope = (1 - metallic) * diffuse[:, None] + metallic * facets[:, None]
    offset = level * (1 - metallic) * facets[:, None]
    pull: float | Tensor = 0.0
    if usual is not None:  # bright pixels differ from it by more
        pull = 1 / (usual + observed.mean(-1, keepdim=True) + 1e-9) ** 2
    weights = (seen / (2 * _RELATIVE * observed + floor) ** 2).expand_as(slope)
    for _ in range(_STEPS):
        above = (weights * slope * (observed - offset)).sum(-1, keepdim=True) + pull * (usual or 0.0)
        below = (weights * slope * slope).sum(-1, keepdim=True) + pull
        base = (above / below.clamp(min=1e-12)).clamp(min=0)
        expected = base * slope + offset
        from_facets = (base * metallic + level * (1 - metallic)) * facets[:, None]
        variance = (_RELATIVE * expected) ** 2 + (lobe_error * from_facets) ** 2 + floor**2
        squared = (observed - expected) ** 2 / variance
        weights = seen / (variance * (1 + squared / _DEGREES_OF_FREEDOM))
    # Relative to the error of the observation itself, so that costs have no unit.
    cost = 0.5 * (variance / (_RELATIVE * observed + floor) ** 2).log()
    cost = cost + 0.5 * (_DEGREES_OF_FREEDOM + 1) * (squared / _DEGREES_OF_FREEDOM).log1p()
    cost = torch.where(observed < expected, cost.clamp(max=_SHADOW_COST), cost)
    no_base = ((level + 1e-12) / (base + 1e-6) / _NO_BASE).log().clamp(min=0) * (1 - metallic)
    return ((seen * cost).sum(-1) + _NO_BASE_COST * no_base[..., 0]), base[..., 0], weights


def lobe_error(geometry: Geometry, roughness: float | Tensor) -> Tensor:
    """Return the share (P, 1, 1) by which errors of the normals change the radiance of facets of this roughness."""
    wide = (torch.as_tensor(roughness) ** 4 + 2 * geometry.normal_error**2).sqrt()
    return (geometry.normal_error / (2 * wide.clamp(min=0.01))).clamp(max=_MOST_LOBE_ERROR)[..., None]


def fit_gloss(sample: Sample, gloss: Gloss) -> tuple[Tensor, Tensor, Tensor]:
    """Return the costs (P,) and the bases (P,) of pixels of a gloss, and their prediction errors (P, F); see fit_base.

    Each observation is predicted from the others.
    """
    one = torch.ones(1, 1)
    diffuse = diffuse_lobe(sample.geometry, gloss.minnaert * one)
    facets = facet_lobe(sample.geometry, gloss.roughness * one, gloss.tail * one)
    metallic, level = torch.tensor([float(gloss.is_metal)]), torch.tensor([gloss.level])
    error = lobe_error(sample.geometry, gloss.roughness)
    cost, base, weights = fit_base(sample, diffuse, facets, metallic, level, error)
    slope, offset = (facets, 0 * facets) if gloss.is_metal else (diffuse, gloss.level * facets)
    predicted = predict_left_out(sample, slope, offset, weights[:, 0])
    return cost[:, 0], base[:, 0], (sample.observations.clamp(max=sample.white) - predicted) * sample.seen


def predict_left_out(sample: Sample, slope: Tensor, offset: Tensor, weights: Tensor) -> Tensor:
    """Return the predictions (P, F) of base * slope + offset, each fitted to the other observations of its pixel."""
    above, below = weights * slope * (sample.observations - offset), weights * slope**2
    others = below.sum(1, keepdim=True) - below
    base = ((above.sum(1, keepdim=True) - above) / others.clamp(min=1e-12)).clamp(min=0)
    return (slope * base + offset).clamp(max=sample.white)


class _Grid(NamedTuple):
    """G glosses. The numbers are (G,)."""

    roughness: Float64Array
    metallic: Float64Array
    level: Float64Array
    minnaert: Float64Array
    tail: Float64Array
    log_prior: Float64Array


def find_glosses(sample: Sample, bright: float) -> list[Gloss]:
    """Return the glosses of a sample, the most frequent one first. `bright` is the albedo of bright pixels."""
    costs, grid = _fit_grid(sample, bright)
    judged = costs + _PRIOR_OF_SAMPLE * torch.from_numpy(grid.log_prior.max() - grid.log_prior).float()
    judged = torch.minimum(judged, judged.amin(1, keepdim=True) + _MOST_COST)
    chosen = _choose(judged)
    owner = judged[:, chosen].argmin(1)
    counts = torch.bincount(owner, minlength=len(chosen))
    order = [int(place) for place in counts.argsort(descending=True) if counts[place] >= _LEAST_SHARE * len(owner)]
    costs = torch.minimum(costs, costs.amin(1, keepdim=True) + _MOST_COST)
    found = []
    for place in order:
        own = owner == place
        gloss = _gloss(costs[own], grid, float(counts[place] / len(owner)))
        found.append(_most_predictive(sample.take(own), gloss))
    return found


def _most_predictive(sample: Sample, gloss: Gloss) -> Gloss:
    """Return a gloss with the share of its level, or no gloss instead of a metal, that predicts observations best.

    Each observation is predicted from the others. The costs tolerate a highlight in the wrong place, and a metal that
    is fitted to a few observations in shadow. A lower level gives better pictures there.
    """
    choices = [replace(gloss, level=share * gloss.level) for share in ((1.0,) if gloss.is_metal else _LEVEL_STEPS)]
    if gloss.is_metal:
        choices.append(replace(gloss, metallic=0.0, roughness=0.5, roughness_error=0.26, tail=GGX))
    return min(choices, key=lambda choice: float(fit_gloss(sample, choice)[2].square().sum()))


def _fit_grid(sample: Sample, bright: float) -> tuple[Tensor, _Grid]:
    """Return the cost (P, G) of each gloss of the grid for each pixel."""
    costs, rows = [], []
    one = torch.ones(1, 1)
    diffuse = {kappa: diffuse_lobe(sample.geometry, kappa * one) for kappa in _MINNAERT}
    level_priors = np.log(np.array(_LEVEL_SHARES) * (1 - _METALS) / len(_MINNAERT))
    for roughness in _ROUGHNESS:
        error = lobe_error(sample.geometry, roughness)
        levels = bright * torch.tensor([v for v in _LEVELS if roughness < _ROUGH or v < _MOST_ROUGH_LEVEL])
        for tail in (GGX, LONG_TAIL):
            facets = facet_lobe(sample.geometry, roughness * one, tail * one)
            metal = fit_base(sample, diffuse[_MINNAERT[0]], facets, torch.ones(1), torch.zeros(1), error)
            costs.append(metal[0])
            rows.append((roughness, 1.0, 0.0, 1.0, tail, np.log(_METALS / 2)))
        facets = facet_lobe(sample.geometry, roughness * one, GGX * one)
        for kappa in _MINNAERT:
            costs.append(fit_base(sample, diffuse[kappa], facets, torch.zeros(len(levels)), levels, error)[0])
            pairs = zip(levels.tolist(), level_priors, strict=False)
            rows += [(roughness, 0.0, level, kappa, GGX, prior) for level, prior in pairs]
    return torch.cat(costs, 1), _Grid(*np.array(rows).T)


def _choose(costs: Tensor) -> list[int]:
    """Return the columns of costs (P, G) that together explain the pixels, chosen one after the other."""
    chosen: list[int] = []
    best = costs.amax(1)
    while len(chosen) < MOST_GLOSSES:
        totals = torch.minimum(costs, best[:, None]).mean(0)
        column = int(totals.argmin())
        if chosen and float(best.mean() - totals[column]) < _LEAST_GAIN:
            break
        chosen.append(column)
        best = torch.minimum(best, costs[:, column])
    return chosen


def _gloss(costs: Tensor, grid: _Grid, share: float) -> Gloss:
    """Return the mean gloss of the grid, weighted by how well each fits pixels with these costs (p, G)."""
    likelihood = grid.log_prior - costs.mean(0).numpy() * min(_INDEPENDENT, len(costs))
    probability = np.exp(likelihood - likelihood.max())
    probability /= probability.sum()
    metallic = float(probability[grid.metallic == 1].sum())
    roughness = float(probability @ grid.roughness)
    error = float(np.sqrt(probability @ (grid.roughness - roughness) ** 2))
    # What only one kind of material has is the mean over that kind.
    own = probability * (grid.metallic == float(metallic > 0.5))
    tail = GGX if own[grid.tail == GGX].sum() >= own.sum() / 2 else LONG_TAIL
    own = own * (grid.tail == tail)
    own /= own.sum()
    return Gloss(roughness, error, metallic, float(own @ grid.level), float(own @ grid.minnaert), tail, share)
