"""Estimate maps of a capture's material from its images, lights and normals, and render it under
other lights.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
import torch
from torch import Tensor

from splinecli.estimate.methods.batched import float_tensors
from splinecli.lights.lighting import LightingAt, PixelIndices, PixelLighting, parts_of_pixels
from splinecli.lights.rough_normals import cast_shadows
from splinecli.materials.gloss import blurred, estimate_gloss
from splinecli.materials.lobes import (
    F0_OF_SPECULAR,
    Base,
    Geometry,
    LitPixels,
    diffuse_lobe,
    facet_lobe,
    fit_base,
    lobe_error,
    predict_left_out,
)
from splinecli.materials.material_net import Gloss
from splinecli.maths import Bools, Float32Array, Floats
from splinecli.maths.pixel_grid import on_map
from splinecli.records.output_files import MAPS
from splinecli.surface.integration import integrate_normals

_LIT = 0.05  # smallest n.l of a light that is used, to exclude the soft edge of a shadow
_BRIGHT_QUANTILE = 0.95
_SMOOTH = 4.0  # standard deviation in pixels of the smoothing of the trust
# Mean reflectance of dielectrics at normal incidence, which determines the exposure
_DIELECTRIC = 0.04
_WHITE_QUANTILE = 0.99  # quantile of the bases that is at most white
_MOST_EXPOSURE = 10.0  # relative to the exposure at which the brightest bases are white
_SURE = 0.1  # error of the roughness that the confidence refers to
_LAPLACE = 1.41  # standard deviation of a Laplace distribution, in mean absolute errors
# Minimum errors of observations, relative to the bright pixels' albedo and the mean observation
_FLOOR, _FLAT = 0.005, 0.12
_WHITE = 0.999  # quantile of the observations
_GRAY = 1e-3  # largest tint for which all channels are considered equal
_NORMAL_ERROR = 0.04  # radians, without a confidence
_LEAST_ERROR, _MOST_ERROR = 0.015, 0.25  # radians
_CONFIDENT = np.radians(5)  # error that the confidence of a normal refers to
# Shadows of larger maps are computed for every second, third, ... row and column
_MOST_CELLS = 40_000


@dataclass(frozen=True, eq=False)
class MaterialMaps:
    """The material of the P pixels of a mask: glTF's parameters, and further values for rendering.

    Args:
        base_colour: (P, 3) linear RGB; all channels are equal for gray images. Since the exposure
            of photographs is unknown, the scale is chosen such that dielectrics reflect 4 % on
            average, but the brightest bases do not exceed white.
        roughness, metalness, specular: (P,), Burley's parameters. `specular` may exceed 1.
        confidence: (P,), the probability that the error of the roughness is at most 0.1.
        minnaert, tail: (P,), exponents of the diffuse light and of the facets' distribution, which
            glTF does not have.
        matte: (P,), the reflectance of the best-fitting matte surface, in the unit of the
            observations.
        trust: (P,), the share of the material in pictures, mixed with the matte surface. It depends
            on how well each predicts observations that were left out.
        white: the brightest observation of pictures.
        exposure: the observation of a matte white surface that faces the light.
    """

    base_colour: Float32Array
    roughness: Float32Array
    metalness: Float32Array
    specular: Float32Array
    confidence: Float32Array
    minnaert: Float32Array
    tail: Float32Array
    matte: Float32Array
    trust: Float32Array
    white: float
    exposure: float
    is_gray: bool


def estimate_material(
    mask: Bools,
    normals: Float32Array,
    lights: Floats,
    lighting_at: LightingAt,
    *,
    normal_confidence: Float32Array | None = None,
    colours: Iterable[Float32Array] | None = None,
) -> MaterialMaps:
    """Return the material of each pixel of a mask (H, W).

    Args:
        normals: (P, 3) unit, in the capture's frame.
        lights: (F, 3) unit, at the middle of the object, which determine the shadows.
        lighting_at: returns observations and light directions of pixels.
        normal_confidence: (P,), the probability that the error of a normal is at most 5 degrees.
            None if it is unknown.
        colours: for each light, the linear RGB values (P, 3), whose mean over the channels is the
            observation; None for gray images.

    Raises:
        InputError: there are too few lights.
    """
    MAPS["material"].check_lights(len(lights))
    pixels = _Pixels(
        normals,
        _normal_error(normals, normal_confidence),
        lights_that_reach(on_map(normals, mask), mask, lights),
        lighting_at,
    )
    bright, white = pixels.brightness()
    gloss = estimate_gloss(mask, lighting_at)
    columns = np.empty((len(normals), 5), np.float32)
    weights = np.empty(pixels.reached.shape, np.float32)
    for chosen in parts_of_pixels(len(normals)):
        columns[chosen], weights[chosen] = _fit(pixels.take(chosen, bright, white), gloss, chosen)
    gray, offset, matte, agreement, difference = columns.T
    trust = _smooth(agreement, mask) / np.maximum(_smooth(difference, mask), 1e-12 * bright**2)
    tint = None if colours is None else _tint(colours, weights, offset)
    is_gray = tint is None or bool(np.abs(tint - 1).max() < _GRAY)
    base = np.repeat(gray[:, None], 3, axis=1) * (1 if tint is None or is_gray else tint)
    exposure = _exposure(base, gloss)
    return MaterialMaps(
        base_colour=base / np.float32(exposure),
        roughness=gloss.roughness.numpy(),
        metalness=gloss.metalness.numpy(),
        specular=((gloss.log_level.exp() / exposure).clamp(max=1) / F0_OF_SPECULAR).numpy(),
        confidence=(1 - (-_SURE / gloss.roughness_error).exp()).numpy(),
        minnaert=gloss.minnaert.numpy(),
        tail=gloss.tail.numpy(),
        matte=matte.copy(),
        trust=trust.clip(0, 1),
        white=white,
        exposure=exposure,
        is_gray=is_gray,
    )


def render_gray(
    found: MaterialMaps,
    normals: Float32Array,
    lights: Floats,
    reached: Bools,
    normal_confidence: Float32Array | None = None,
) -> Float32Array:
    """Return the observations (P, F) of a material under distant lights (F, 3), in its own unit.

    Args:
        normals, normal_confidence: as for estimate_material.
        reached: (P, F), false in cast shadow; see lights_that_reach.
    """
    images = np.empty((len(normals), len(lights)), np.float32)
    directions = torch.from_numpy(np.asarray(lights, np.float32))
    error = _normal_error(normals, normal_confidence)
    for chosen in parts_of_pixels(len(normals)):

        def column(values: Float32Array, chosen: PixelIndices = chosen) -> Tensor:
            return float_tensors(values[chosen])[0][:, None]

        geometry = Geometry.of(
            torch.from_numpy(normals[chosen]), directions, torch.from_numpy(error[chosen])
        )
        facets = facet_lobe(geometry, column(found.roughness), column(found.tail))
        metalness, base = column(found.metalness), column(found.base_colour.mean(axis=1))
        radiance = base * torch.lerp(
            diffuse_lobe(geometry, column(found.minnaert)), facets, metalness
        )
        radiance = radiance + F0_OF_SPECULAR * column(found.specular) * (1 - metalness) * facets
        matte = column(found.matte) * geometry.n_dot_l.clamp(min=0)
        shiny = (found.exposure * radiance).clamp(max=found.white)
        images[chosen] = torch.lerp(matte, shiny, column(found.trust)).numpy() * reached[chosen]
    return images


def lights_that_reach(normal_map: Floats, mask: Bools, lights: Floats) -> Bools:
    """Return which distant lights (F, 3) reach the pixels of the mask (H, W), as a boolean array
    (P, F).

    Only cast shadows are considered, not attached shadows. The surface is integrated from the
    normals (H, W, 3) for an orthographic camera.
    """
    step = max(1, ceil(sqrt(np.count_nonzero(mask) / _MOST_CELLS)))
    coarse = mask[::step, ::step]
    if not coarse.any():
        return np.ones((np.count_nonzero(mask), len(lights)), np.bool_)
    heights = integrate_normals(normal_map[::step, ::step] * coarse[..., None], coarse)
    lit = ~cast_shadows(heights, np.asarray(lights, np.float64))
    rows, columns = np.nonzero(mask)
    return lit[rows // step, columns // step]


def _normal_error(normals: Float32Array, confidence: Float32Array | None) -> Float32Array:
    """Return the expected errors (P,) of normals along each axis, in radians.

    The errors are assumed to have a normal distribution.
    """
    if confidence is None:
        return np.full(len(normals), _NORMAL_ERROR, np.float32)
    error = _CONFIDENT / np.sqrt(-2 * np.log1p(-confidence.clip(0.01, 0.999)))
    return np.asarray(error.clip(_LEAST_ERROR, _MOST_ERROR), np.float32)


@dataclass(frozen=True)
class _Pixels:
    """The data of the pixels before the fit."""

    normals: Float32Array  # (P, 3)
    normal_error: Float32Array  # (P,)
    reached: Bools  # (P, F)
    lighting_at: LightingAt

    def take(self, chosen: PixelIndices, bright: float, white: float = np.inf) -> LitPixels:
        """Return a selection of the pixels in the form needed for the fits.

        `bright` is the albedo of bright pixels.
        """
        light: PixelLighting = self.lighting_at(chosen)
        observations, directions, normals, normal_error = float_tensors(
            light.observations,
            light.directions,
            light.in_frame_of_pixels(self.normals[chosen]),
            self.normal_error[chosen],
        )
        geometry = Geometry.of(normals, directions, normal_error)
        reached = torch.from_numpy(self.reached[chosen]) & (geometry.n_dot_l > _LIT)
        floor = _FLAT * observations.mean(1, keepdim=True) + _FLOOR * bright
        return LitPixels(observations, geometry, reached.float(), floor, white)

    def brightness(self) -> tuple[float, float]:
        """Return the albedo of bright pixels, and the value of white in a picture."""
        albedos, whites = [], []
        for chosen in parts_of_pixels(len(self.normals), step=max(1, len(self.normals) // 50_000)):
            sample = self.take(chosen, 0.0)
            cosines = sample.geometry.n_dot_l
            albedo = torch.where(
                cosines > 2 * _LIT, sample.observations / cosines.clamp(min=2 * _LIT), torch.nan
            )
            albedos.append(albedo.nanmedian(1).values.nan_to_num())
            whites.append(np.quantile(sample.observations.numpy(), _WHITE))
        return max(float(np.quantile(torch.cat(albedos).numpy(), _BRIGHT_QUANTILE)), 1e-12), float(
            np.mean(whites)
        )


def _fit(
    sample: LitPixels, gloss: Gloss, chosen: PixelIndices
) -> tuple[Float32Array, Float32Array]:
    """Return five columns (p, 5), and the weights (p, F) of the observations in the base.

    The columns are the base, the contribution of white highlights to the weighted observations,
    which is not part of the base, and the results of _compare.
    """

    def column(values: Tensor) -> Tensor:
        return values[chosen][:, None]

    geometry = sample.geometry
    roughness, metalness = column(gloss.roughness), column(gloss.metalness)
    facets = facet_lobe(geometry, roughness, column(gloss.tail))
    of_facets = metalness * facets
    slope = (1 - metalness) * diffuse_lobe(geometry, column(gloss.minnaert)) + of_facets
    offset = column(gloss.log_level).exp() * (1 - metalness) * facets
    usual = column(gloss.log_base).exp() * sample.observations.amax(1, keepdim=True)
    expected = Base(usual, _LAPLACE * column(gloss.log_base_error) * usual)
    base, weights = fit_base(
        sample, slope, offset, of_facets, lobe_error(geometry, roughness), expected
    )
    compared = _compare(sample, slope, offset, weights)
    weights = weights * slope / (weights * slope**2).sum(1, keepdim=True).clamp(min=1e-12)
    pixels = torch.stack((base[:, 0], (weights * offset).sum(1), *compared), dim=1)
    return pixels.numpy(), weights.numpy()


def _compare(
    sample: LitPixels, slope: Tensor, offset: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the reflectance (P,) of a matte surface, and two sums (P,) that weight the material.

    Each observation is predicted from the others twice, with the material and with the matte
    surface, and the weights of the robust fits. The ratio of the two sums is the weight of the
    material's prediction that minimises the squared error.
    """
    cosine = sample.geometry.n_dot_l.clamp(min=0)
    base, matte_weights = fit_base(sample, cosine, 0 * cosine, 0 * cosine, torch.zeros(1, 1))
    matte = predict_left_out(sample, cosine, 0 * cosine, matte_weights)
    difference = (predict_left_out(sample, slope, offset, weights) - matte) * sample.lit
    wrong = sample.observations.clamp(max=sample.white) - matte
    return base[:, 0], (difference * wrong).sum(1), difference.square().sum(1)


def _smooth(values: Float32Array, mask: Bools) -> Float32Array:
    """Return the values (P,) averaged over neighbours in a mask (H, W)."""
    return blurred(values, mask, _SMOOTH) / blurred(np.ones_like(values), mask, _SMOOTH)


def _tint(
    colours: Iterable[Float32Array], weights: Float32Array, offset: Float32Array
) -> Float32Array:
    """Return the colours (P, 3) of the bases relative to gray, with a mean of 1 over the channels.

    The highlights of dielectrics are white, so every channel has the offset (P,) of the gray image.
    """
    total = np.repeat(-offset[:, None], 3, axis=1)
    for place, colour in enumerate(colours):
        total += weights[:, place, None] * colour
    total = total.clip(min=0)
    mean = total.mean(axis=1, keepdims=True)
    return np.asarray(np.divide(total, mean, out=np.ones_like(total), where=mean > 0))


def _exposure(base: Float32Array, gloss: Gloss) -> float:
    """Return the exposure at which dielectrics have their usual reflectance and no base exceeds
    white.
    """
    white = max(float(np.quantile(base.max(axis=1), _WHITE_QUANTILE)), 1e-9)
    # NumPy is used because sums in PyTorch depend on the number of threads.
    dielectric, level = 1 - gloss.metalness.numpy(), gloss.log_level.exp().numpy()
    mean = float((dielectric * level).sum(dtype=np.float64)) / max(
        float(dielectric.sum(dtype=np.float64)), 1e-9
    )
    return float(np.clip(mean / _DIELECTRIC, white, _MOST_EXPOSURE * white))
