"""The lobes of a material, and the fit of its base.

The radiance of a pixel is

    base * ((1 - metallic) * diffuse + metallic * facets) + level * (1 - metallic) * facets

in the unit of the observations, where `diffuse` and `facets` are lobes of the principled BRDF
(Burley, "Physically Based Shading at Disney", SIGGRAPH 2012). If the roughness is fixed, radiance
is linear in the other parameters, except for the Fresnel effect at grazing angles. Since the camera
looks along the z axis and lights are above the horizon, this effect is at most 0.2 % of full
reflection.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

LEAST_Z = 0.05  # smallest z of a normal, because the BRDF needs a surface that faces the camera
# Reflectance at normal incidence of a dielectric whose `specular` is 1 (Burley 2012)
F0_OF_SPECULAR = 0.08
GGX = 2.0  # exponent of the facets' distribution; smaller exponents have longer tails

_DIFFUSE_ROUGHNESS = 0.25
"""Roughness of the diffuse lobe. In the BRDF, it is equal to the roughness of the facets, but this
is less accurate than a constant, both for real and for rendered surfaces."""


class Geometry(NamedTuple):
    """The cosines that the BRDF depends on, and the expected errors of the normals."""

    n_dot_l: Tensor  # (P, F), negative in attached shadow
    n_dot_v: Tensor  # (P, 1), positive
    l_dot_v: Tensor  # (F) or (P, F)
    normal_error: Tensor  # (P, 1), standard deviation of the normal along each axis, in radians

    @classmethod
    def of(cls, normals: Tensor, lights: Tensor, normal_error: Tensor) -> Geometry:
        """Return the geometry of unit normals (P, 3), unit lights (F, 3) or (P, F, 3), and errors
        (P,).

        The errors are in radians, and z points to the camera.
        """
        if lights.ndim == 2:
            n_dot_l = normals @ lights.T
        else:
            n_dot_l = torch.einsum("pfc,pc->pf", lights, normals)
        n_dot_v = normals[:, 2:].clamp(min=LEAST_Z)
        return cls(n_dot_l, n_dot_v, lights[..., 2], normal_error[:, None])


def diffuse_lobe(geometry: Geometry, minnaert: Tensor) -> Tensor:
    """Return the radiance (P, F) of a white matte surface, zero in attached shadow.

    `minnaert` is (P, 1) or (1, 1).
    """
    n_dot_l, n_dot_v, l_dot_v, _ = geometry
    lit, one = n_dot_l.clamp(min=0), torch.ones_like(n_dot_v)
    l_dot_h, n_dot_h_squared = half_vector_cosines(n_dot_l, n_dot_v, l_dot_v)
    grazing_90 = 2 * _DIFFUSE_ROUGHNESS * l_dot_h * l_dot_h - 0.5
    diffuse = (1 + grazing_90 * schlick_weight(lit)) * (1 + grazing_90 * schlick_weight(n_dot_v))
    if bool((minnaert != 1).any()):
        diffuse = diffuse * power((lit * n_dot_v).clamp(min=1e-4), minnaert * one - 1)
    grazing = facets(n_dot_h_squared, lit, n_dot_v, _DIFFUSE_ROUGHNESS * one, GGX * one)
    return (diffuse + grazing * schlick_weight(l_dot_h)) * lit


def facet_lobe(geometry: Geometry, roughness: Tensor, tail: Tensor) -> Tensor:
    """Return the radiance (P, F) of a perfect metal, zero in attached shadow.

    Roughness and tail are (P, 1) or (1, 1). The lobe is averaged over the errors of the normals and
    therefore wider, because a blurred highlight is better than one in the wrong place. The variance
    of the facets' slopes is roughness^4 / 2 (for Beckmann's distribution; it is infinite for GGX).
    """
    n_dot_l, n_dot_v, l_dot_v, normal_error = geometry
    lit = n_dot_l.clamp(min=0)
    wide = (roughness**4 + 2 * normal_error**2) ** 0.25
    _, n_dot_h_squared = half_vector_cosines(n_dot_l, n_dot_v, l_dot_v)
    return facets(n_dot_h_squared, lit, n_dot_v, wide, tail * torch.ones_like(n_dot_v)) * lit


def half_vector_cosines(n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> tuple[Tensor, Tensor]:
    """Return l.h and the square of n.h, where h is the half vector of light and view."""
    # Light from behind has no half vector, so rounding would give NaN.
    l_dot_h = ((1 + l_dot_v) / 2).clamp(min=1e-6).sqrt()
    n_dot_h = ((n_dot_l + n_dot_v) / (2 * l_dot_h)).clamp(0, 1)
    return l_dot_h, n_dot_h * n_dot_h


def facets(
    n_dot_h_squared: Tensor, lit: Tensor, n_dot_v: Tensor, roughness: Tensor, tail_exponent: Tensor
) -> Tensor:
    """Return the microfacet distribution times its shadowing, which is GGX for a tail exponent of
    2.

    As in Disney's own later code, Smith's shadowing uses the roughness directly, without the
    remapping of 2012. The lobe is never narrower than at a roughness of 0.1, which float32 still
    resolves.
    """
    alpha_squared = (roughness**4).clamp(min=1e-4)
    spread = n_dot_h_squared * (alpha_squared - 1) + 1
    if bool((tail_exponent < 2).any()):
        # Pi times the normalisation of the facets 1 / (1 + (a^2 - 1) (n.h)^2)^gamma, which is a^2
        # for gamma = 2
        narrow = alpha_squared.clamp(max=0.999)
        norm = (tail_exponent - 1) * (1 - narrow) / (narrow ** (1 - tail_exponent) - 1)
        lobe = norm * power(spread, -tail_exponent)
    else:
        lobe = alpha_squared / (spread * spread)
    return lobe * smith_ggx(n_dot_v, alpha_squared) * smith_ggx(lit, alpha_squared)


def schlick_weight(cosine: Tensor) -> Tensor:
    """Return (1 - cosine)^5, the weight of grazing reflection in Schlick's approximation of
    Fresnel.
    """
    complement = (1 - cosine).clamp(0, 1)
    square = complement * complement
    return square * square * complement


def power(base: Tensor, exponent: Tensor) -> Tensor:
    """Return base^exponent for base > 0, faster than torch.pow and accurate enough for images."""
    return (base.log() * exponent).exp()


def smith_ggx(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """Return Smith's shadowing of GGX divided by 2 n.x: 1 / (n.x + sqrt(a^2 + (1 -
    a^2)(n.x)^2)).
    """
    return 1 / (cosine + (alpha_squared + (1 - alpha_squared) * cosine * cosine).sqrt())


_RELATIVE, _DEGREES_OF_FREEDOM = 0.05, 3.0
_MOST_LOBE_ERROR = 0.6
"""Errors of observations are relative to the prediction and have Student's distribution. Errors of
the normals also change a sharp lobe, by at most the last share."""

_STEPS = 4  # steps of the robust fit of a base


class LitPixels(NamedTuple):
    """Observations with their geometry and errors."""

    observations: Tensor  # (P, F)
    geometry: Geometry
    lit: Tensor  # (P, F), 1 where the light reaches the pixel, else 0
    floor: Tensor  # (P, 1), the minimum error of an observation
    white: float  # the largest value in pictures


class Base(NamedTuple):
    """An expected base with its standard error, each (P, 1)."""

    value: Tensor
    error: Tensor


def fit_base(
    sample: LitPixels,
    slope: Tensor,
    offset: Tensor,
    of_facets: Tensor,
    lobe_error: Tensor,
    expected: Base | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the bases (P, 1) of the best fit, base * slope + offset, and the observations' weights
    (P, F).

    Args:
        slope, offset: (P, F).
        of_facets: (P, F), the facets' part of the slope.
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
        below = (weights * slope * slope).sum(1, keepdim=True) + pull
        base = (above / below.clamp(min=1e-12)).clamp(min=0)
        radiance = base * slope + offset
        variance = (
            (_RELATIVE * radiance) ** 2 + (lobe_error * (base * of_facets + offset)) ** 2 + floor**2
        )
        squared = (observed - radiance) ** 2 / variance
        weights = sample.lit / (variance * (1 + squared / _DEGREES_OF_FREEDOM))
    return base, weights


def lobe_error(geometry: Geometry, roughness: Tensor) -> Tensor:
    """Return the share (P, 1) by which errors of the normals change the radiance of facets.

    The roughness is (P, 1).
    """
    wide = (roughness**4 + 2 * geometry.normal_error**2).sqrt()
    return (geometry.normal_error / (2 * wide.clamp(min=0.01))).clamp(max=_MOST_LOBE_ERROR)


def predict_left_out(sample: LitPixels, slope: Tensor, offset: Tensor, weights: Tensor) -> Tensor:
    """Return predictions (P, F) of base * slope + offset, each fitted to the pixel's other
    observations.
    """
    above, below = weights * slope * (sample.observations - offset), weights * slope**2
    others = below.sum(1, keepdim=True) - below
    base = ((above.sum(1, keepdim=True) - above) / others.clamp(min=1e-12)).clamp(min=0)
    return (slope * base + offset).clamp(max=sample.white)
