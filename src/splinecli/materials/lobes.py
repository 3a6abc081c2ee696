"""The lobes of a material, and the fit of its base.

The radiance of a pixel is

    base * ((1 - metallic) * diffuse + metallic * facets) + level * (1 - metallic) * facets

in the unit of the observations, where `diffuse` and `facets` are lobes of the principled BRDF. With
the roughness fixed, radiance is linear in the other parameters, except for Fresnel's increase at
grazing angles. The camera looks along the z axis and lights are above the horizon, so this is at
most 0.2 % of full reflection.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from splinecli.materials.principled import PrincipledMaterial

LEAST_Z = 0.05  # of a normal; the BRDF has no value for a surface that faces away from the camera
# reflectance at normal incidence of a dielectric whose `specular` is 1 (Burley 2012)
F0_OF_SPECULAR = 0.08
GGX = 2.0  # the exponent of the facets' distribution; smaller ones have longer tails

_DIFFUSE_ROUGHNESS = 0.25
"""Of the diffuse lobe. In the BRDF, it follows the roughness of the facets. Real surfaces and the
renderer's deviate from that by more, so that it would only mislead the fit."""


class Geometry(NamedTuple):
    """The cosines that the BRDF depends on, and the expected errors of the normals."""

    n_dot_l: Tensor  # (P, F), negative in attached shadow
    n_dot_v: Tensor  # (P, 1), positive
    l_dot_v: Tensor  # (F) or (P, F)
    normal_error: Tensor  # (P, 1), standard deviation of the normal along each axis, in radians

    @classmethod
    def of(cls, normals: Tensor, lights: Tensor, normal_error: Tensor) -> Geometry:
        """Return the geometry of unit normals (P, 3), unit lights, (F, 3) or (P, F, 3), and errors
        (P,) in radians.

        z points to the camera.
        """
        n_dot_l = (
            normals @ lights.T if lights.ndim == 2 else torch.einsum("pfc,pc->pf", lights, normals)
        )
        return cls(
            n_dot_l, normals[:, 2:].clamp(min=LEAST_Z), lights[..., 2], normal_error[:, None]
        )


def _lobe(
    geometry: Geometry, metallic: float, roughness: Tensor, minnaert: Tensor, tail: Tensor
) -> Tensor:
    """Return the radiance (P, F) of a white material without reflection of dielectrics; the tensors
    are (P, 1).
    """
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
    """Return the radiance (P, F) of a white matte surface, zero in attached shadow. `minnaert` is
    (P, 1) or (1, 1).
    """
    one = torch.ones(1, 1)
    return _lobe(geometry, 0.0, _DIFFUSE_ROUGHNESS * one, minnaert, GGX * one)


def facet_lobe(geometry: Geometry, roughness: Tensor, tail: Tensor) -> Tensor:
    """Return the radiance (P, F) of a perfect metal, zero in attached shadow. The others are (P, 1)
    or (1, 1).

    The lobe is the mean over the errors of the normals, which is wider: a highlight in a wrong
    place is worse than a blurred one. The variance of the facets' slopes is roughness^4 / 2 (of
    Beckmann's distribution; GGX has none).
    """
    wide = (roughness**4 + 2 * geometry.normal_error**2) ** 0.25
    return _lobe(geometry, 1.0, wide, torch.ones(1, 1), tail)


_RELATIVE, _DEGREES_OF_FREEDOM = 0.05, 3.0
_MOST_LOBE_ERROR = 0.6
"""The errors of observations: a share of the prediction, with the tails of Student's distribution.
A sharp lobe also changes with the normals' errors, at most by the last share of itself."""

_STEPS = 4  # of the robust fit of a base


class Sample(NamedTuple):
    """Observations with their geometry and errors."""

    observations: Tensor  # (P, F)
    geometry: Geometry
    lit: Tensor  # (P, F), 1 where the light reaches the pixel, else 0
    floor: Tensor  # (P, 1), the error that even a dark observation has
    white: float  # pictures end at this value


class Base(NamedTuple):
    """A base that is expected, with its standard error, each (P, 1)."""

    value: Tensor
    error: Tensor


def fit_base(
    sample: Sample,
    slope: Tensor,
    offset: Tensor,
    of_facets: Tensor,
    lobe_error: Tensor,
    expected: Base | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the bases (P, 1) that fit best, base * slope + offset, and the weights (P, F) of the
    observations.

    Args:
        slope, offset: (P, F).
        of_facets: (P, F), the part of the slope that the facets have.
        lobe_error: (P, 1), from lobe_error.
        expected: determines the base where the observations do not. None for no expectation.
    """
    pull = pulled = torch.zeros(1, 1)
    if expected is not None:
        pull = 1 / expected.error.clamp(min=1e-9) ** 2
        pulled = pull * expected.value
    observed, floor = sample.observations, sample.floor
    weights = sample.lit / (2 * _RELATIVE * observed + floor) ** 2
    for _ in range(_STEPS):
        above = (weights * slope * (observed - offset)).sum(1, keepdim=True) + pulled
        base = (
            above / ((weights * slope * slope).sum(1, keepdim=True) + pull).clamp(min=1e-12)
        ).clamp(min=0)
        radiance = base * slope + offset
        variance = (
            (_RELATIVE * radiance) ** 2 + (lobe_error * (base * of_facets + offset)) ** 2 + floor**2
        )
        squared = (observed - radiance) ** 2 / variance
        weights = sample.lit / (variance * (1 + squared / _DEGREES_OF_FREEDOM))
    return base, weights


def lobe_error(geometry: Geometry, roughness: Tensor) -> Tensor:
    """Return the share (P, 1) by which errors of the normals change the radiance of facets of a
    roughness (P, 1).
    """
    wide = (roughness**4 + 2 * geometry.normal_error**2).sqrt()
    return (geometry.normal_error / (2 * wide.clamp(min=0.01))).clamp(max=_MOST_LOBE_ERROR)


def predict_left_out(sample: Sample, slope: Tensor, offset: Tensor, weights: Tensor) -> Tensor:
    """Return the predictions (P, F) of base * slope + offset, each fitted to the other observations
    of its pixel.
    """
    above, below = weights * slope * (sample.observations - offset), weights * slope**2
    others = below.sum(1, keepdim=True) - below
    base = ((above.sum(1, keepdim=True) - above) / others.clamp(min=1e-12)).clamp(min=0)
    return (slope * base + offset).clamp(max=sample.white)
