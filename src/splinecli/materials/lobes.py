"""The lobes of a material, and the fit of its base.

The radiance of a pixel is

    base * ((1 - metallic) * diffuse + metallic * facets) + level * (1 - metallic) * facets

in the unit of the observations, where `diffuse` and `facets` are lobes of the principled BRDF
(Burley, "Physically Based Shading at Disney", SIGGRAPH 2012). With
the roughness fixed, radiance is linear in the other parameters, except for Fresnel's increase at
grazing angles. The camera looks along the z axis and lights are above the horizon, so this is at
most 0.2 % of full reflection.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

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
        if lights.ndim == 2:
            n_dot_l = normals @ lights.T
        else:
            n_dot_l = torch.einsum("pfc,pc->pf", lights, normals)
        n_dot_v = normals[:, 2:].clamp(min=LEAST_Z)
        return cls(n_dot_l, n_dot_v, lights[..., 2], normal_error[:, None])


def diffuse_lobe(geometry: Geometry, minnaert: Tensor) -> Tensor:
    """Return the radiance (P, F) of a white matte surface, zero in attached shadow. `minnaert` is
    (P, 1) or (1, 1).
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
    """Return the radiance (P, F) of a perfect metal, zero in attached shadow. The others are (P, 1)
    or (1, 1).

    The lobe is the mean over the errors of the normals, which is wider: a highlight in a wrong
    place is worse than a blurred one. The variance of the facets' slopes is roughness^4 / 2 (of
    Beckmann's distribution; GGX has none).
    """
    n_dot_l, n_dot_v, l_dot_v, normal_error = geometry
    lit = n_dot_l.clamp(min=0)
    wide = (roughness**4 + 2 * normal_error**2) ** 0.25
    _, n_dot_h_squared = half_vector_cosines(n_dot_l, n_dot_v, l_dot_v)
    return facets(n_dot_h_squared, lit, n_dot_v, wide, tail * torch.ones_like(n_dot_v)) * lit


def half_vector_cosines(n_dot_l: Tensor, n_dot_v: Tensor, l_dot_v: Tensor) -> tuple[Tensor, Tensor]:
    """Return l.h and the square of n.h, with h the half vector of light and view."""
    # Light from behind the surface has no half vector, and rounding would give NaN.
    l_dot_h = ((1 + l_dot_v) / 2).clamp(min=1e-6).sqrt()
    n_dot_h = ((n_dot_l + n_dot_v) / (2 * l_dot_h)).clamp(0, 1)
    return l_dot_h, n_dot_h * n_dot_h


def facets(
    n_dot_h_squared: Tensor, lit: Tensor, n_dot_v: Tensor, roughness: Tensor, tail_exponent: Tensor
) -> Tensor:
    """Return the microfacet distribution times its shadowing; this is GGX if the tail exponent is
    2.

    As in Disney's own later code, Smith's shadowing uses the roughness directly, without the
    remapping of 2012. The lobe is never narrower than at roughness 0.1, which float32 still
    resolves.
    """
    alpha_squared = (roughness**4).clamp(min=1e-4)
    spread = n_dot_h_squared * (alpha_squared - 1) + 1
    if bool((tail_exponent < 2).any()):
        # pi times the factor that normalises the facets 1 / (1 + (a^2 - 1) (n.h)^2)^gamma; a^2 at
        # gamma = 2
        narrow = alpha_squared.clamp(max=0.999)
        norm = (tail_exponent - 1) * (1 - narrow) / (narrow ** (1 - tail_exponent) - 1)
        lobe = norm * power(spread, -tail_exponent)
    else:
        lobe = alpha_squared / (spread * spread)
    return lobe * smith_ggx(n_dot_v, alpha_squared) * smith_ggx(lit, alpha_squared)


def schlick_weight(cosine: Tensor) -> Tensor:
    """Return (1 - cosine)^5, the weight of grazing reflection in Schlick's Fresnel
    approximation.
    """
    complement = (1 - cosine).clamp(0, 1)
    square = complement * complement
    return square * square * complement


def power(base: Tensor, exponent: Tensor) -> Tensor:
    """Return base^exponent for base > 0, faster than torch.pow and accurate enough for images."""
    return (base.log() * exponent).exp()


def smith_ggx(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """Return Smith's shadowing of the GGX distribution over 2 n.x: 1 / (n.x + sqrt(a^2 + (1 -
    a^2)(n.x)^2)).
    """
    return 1 / (cosine + (alpha_squared + (1 - alpha_squared) * cosine * cosine).sqrt())


_RELATIVE, _DEGREES_OF_FREEDOM = 0.05, 3.0
_MOST_LOBE_ERROR = 0.6
"""The errors of observations: a share of the prediction, with the tails of Student's distribution.
A sharp lobe also changes with the normals' errors, at most by the last share of itself."""

_STEPS = 4  # of the robust fit of a base


class LitPixels(NamedTuple):
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
    sample: LitPixels,
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
    """Return the share (P, 1) by which errors of the normals change the radiance of facets of a
    roughness (P, 1).
    """
    wide = (roughness**4 + 2 * geometry.normal_error**2).sqrt()
    return (geometry.normal_error / (2 * wide.clamp(min=0.01))).clamp(max=_MOST_LOBE_ERROR)


def predict_left_out(sample: LitPixels, slope: Tensor, offset: Tensor, weights: Tensor) -> Tensor:
    """Return the predictions (P, F) of base * slope + offset, each fitted to the other observations
    of its pixel.
    """
    above, below = weights * slope * (sample.observations - offset), weights * slope**2
    others = below.sum(1, keepdim=True) - below
    base = ((above.sum(1, keepdim=True) - above) / others.clamp(min=1e-12)).clamp(min=0)
    return (slope * base + offset).clamp(max=sample.white)
