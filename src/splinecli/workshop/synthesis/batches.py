"""Batches of training pixels, and the faults of a capture: exposure, noise, quantisation and errors
of calibration.

Faults are drawn for each pixel from the distributions in the docstrings. They change only the
sparse observations, while the dense map remains the ground truth. Observations are linear, and 1 is
the full scale of the sensor.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol, Self

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from splinecli.images.saturation import restore_saturated
from splinecli.maths.transfer import decode_transfer
from splinecli.records.base import Count, Share
from splinecli.workshop.synthesis import draw_uniform
from splinecli.workshop.synthesis.lights import draw_light_counts


def disturb_light_directions(
    directions: Tensor, share: float, generator: torch.Generator
) -> Tensor:
    """Return the directions (P, F, 3) with Gaussian calibration errors for a share of the pixels.

    Their sigma along either axis is 8 U(0, 1)^3 degrees, which has a median of 1 degree and exceeds
    4 for a fifth.
    """
    pixels = len(directions)
    sigma = math.radians(8.0) * draw_uniform(generator, pixels, 1, 1) ** 3
    sigma = sigma * (draw_uniform(generator, pixels, 1, 1) < share)
    moved = directions + sigma * torch.randn(
        directions.shape, generator=generator, device=directions.device
    )
    moved = torch.cat((moved[..., :2], moved[..., 2:].clamp(min=0.01)), dim=-1)
    return torch.nn.functional.normalize(moved, dim=-1)


def disturb_light_intensities(
    observations: Tensor, share: float, generator: torch.Generator
) -> Tensor:
    """Return the observations (P, F) with Gaussian errors of the intensities for a share of the
    pixels.

    Their sigma is U(0, 5 %).
    """
    sigma = draw_uniform(generator, len(observations), 1, high=0.05) * (
        draw_uniform(generator, len(observations), 1) < share
    )
    factor = 1 + sigma * torch.randn(
        observations.shape, generator=generator, device=observations.device
    )
    return observations * factor.clamp(min=0)


def draw_light_intensities(
    pixels: int, lights: int, share: float, generator: torch.Generator
) -> Tensor:
    """Draw relative light intensities (P, F), of which the largest is 1.

    They are 2^U(-2, 0) for a share of the pixels, and equal for the others. Images are taken with
    unequal lamps and divided by the intensities afterwards, so the observations under a weak lamp
    have coarser steps and more noise.
    """
    unequal = draw_uniform(generator, pixels, 1) < share
    intensities = 2 ** draw_uniform(generator, pixels, lights, low=-2.0, high=0.0)
    return torch.where(unequal, intensities / intensities.amax(dim=1, keepdim=True), 1.0)


def draw_exposure(radiance: Tensor, saturated_share: float, generator: torch.Generator) -> Tensor:
    """Draw the factor (P, 1) from each pixel's radiance (P, F) to the sensor's range, whose full
    scale is 1.

    The brightest observation of a pixel is 10^U(-2.7, -0.7) for 40 % of the pixels, which are dark
    compared with the brightest in their capture, and 10^U(-1.3, 0) for the others. For
    `saturated_share` of the pixels it is U(1, 3), to be clipped.
    """
    pixels = len(radiance)
    dark = draw_uniform(generator, pixels, 1) < 0.4
    level = draw_uniform(generator, pixels, 1)
    level = 10 ** torch.where(dark, 2.0 * level - 2.7, 1.3 * level - 1.3)
    over = draw_uniform(generator, pixels, 1, low=1.0, high=3.0)
    level = torch.where(draw_uniform(generator, pixels, 1) < saturated_share, over, level)
    return level / radiance.amax(dim=1, keepdim=True).clamp(min=1e-6)


def add_sensor_noise(exposed: Tensor, generator: torch.Generator) -> Tensor:
    """Return values with Gaussian read noise and shot noise.

    Read noise is 10^U(-4, -2.5) of full scale, and shot noise sqrt(I) 10^U(-3.5, -2). The read
    noise is at most a thirtieth of a pixel's largest observation, because darker captures are
    rarely kept.
    """
    pixels = len(exposed)
    read = 10 ** draw_uniform(generator, pixels, 1, low=-4.0, high=-2.5)
    read = torch.minimum(read, exposed.amax(dim=1, keepdim=True) / 30)
    shot = 10 ** draw_uniform(generator, pixels, 1, low=-3.5, high=-2.0)
    sigma = (read * read + shot * shot * exposed.clamp(min=0)).sqrt()
    noise = torch.randn(exposed.shape, generator=generator, device=exposed.device)
    return (exposed + sigma * noise).clamp(0, 1)


def quantise(exposed: Tensor, eight_bit_share: float, generator: torch.Generator) -> Tensor:
    """Return values from 0 to 1, quantised to 8 bits for a share of the pixels and to 10 to 16 for
    others.

    Half of the 8-bit pixels are encoded with the sRGB curve, rounded and decoded again. Of the
    others, half are rounded and half truncated, as when only the high byte of 16 bits is kept.
    """
    pixels = len(exposed)
    eight = draw_uniform(generator, pixels, 1) < eight_bit_share
    kind = draw_uniform(generator, pixels, 1)
    depth = 10 + 2 * torch.randint(4, (pixels, 1), generator=generator, device=exposed.device)
    steps = torch.where(eight, 255.0, 2.0**depth - 1).to(exposed.dtype)
    rounded = (exposed * steps).round() / steps
    cut = (exposed * 256).floor().clamp(max=255) / 255
    # The linear values of the 256 levels, and the thresholds between adjacent levels.
    stored = np.linspace(0, 1, 511, dtype=np.float32)
    linear = torch.from_numpy(decode_transfer(stored, None)).to(exposed)
    encoded = linear[::2][torch.bucketize(exposed.contiguous(), linear[1::2].contiguous())]
    return torch.where(
        eight & (kind < 0.5), encoded, torch.where(eight & (kind < 0.75), cut, rounded)
    )


def restore(
    observed: Tensor, clipped: Tensor, directions: Tensor, valid: Tensor, generator: torch.Generator
) -> Tensor:
    """Return observations in which half of the pixels' clipped values are restored, as in `infer`.

    The others stay at full scale. All arrays are (P, F), except the unit directions (P, F, 3).
    Invalid observations are ignored.
    """
    chosen = (draw_uniform(generator, len(observed), 1) < 0.5)[:, 0] & clipped.any(dim=1)
    rows = chosen.nonzero()[:, 0]
    if not len(rows):
        return observed
    values = observed[rows].cpu().numpy()
    # Invalid observations are dark, so they hardly affect the fit.
    lights = (directions[rows] * valid[rows, :, None]).cpu().numpy()
    restore_saturated(values, clipped[rows].cpu().numpy(), lights.__getitem__)
    return observed.index_copy(0, rows, torch.from_numpy(values).to(observed))


LightCount = Annotated[int, Meta(ge=3)]


@dataclass(frozen=True)
class CaptureConfig:
    """How pixels are photographed, and how often each fault occurs, as a share of the pixels.

    A share of 0 disables a fault.
    """

    # min_lights, max_lights, usual_lights, usual_lights_share: see draw_light_counts
    min_lights: LightCount = 4
    max_lights: LightCount = 96
    usual_lights: LightCount = 10
    usual_lights_share: Share = 0.5
    # usual number of pixels per capture, which share lights, materials and faults. With 1, each
    # pixel is independent.
    capture_pixels: Count = 1
    ambient_share: Share = 0.5  # captures under ambient light, and independently drawn pixels
    light_direction_error_share: Share = 0.5  # pixels with errors of the light directions
    light_intensity_error_share: Share = 0.5  # pixels with errors of the light intensities
    # pixels whose lights differ in intensity; the observations are normalised
    unequal_lights_share: Share = 0.5
    # pixels with clipped observations; half are restored as in `infer`
    saturated_share: Share = 0.1
    sensor_noise: bool = True  # whether to add noise and quantisation
    eight_bit_share: Share = 0.3  # pixels with 8 bits; the others have 10 to 16
    # captures photographed as images through a simulated lens and sensor; see draw_optics
    optics_share: Share = 0.75

    def captures(self, pixels: int) -> int:
        """Return the number G of captures in a draw of `pixels` pixels. Pixel p belongs to capture
        p % G.
        """
        return max(1, pixels // self.capture_pixels)

    def light_counts(
        self, captures: int, generator: torch.Generator, *, available: int | None = None
    ) -> Tensor:
        """Draw the number of lights of each capture (G,), of at most the `available` lights."""
        most = self.max_lights if available is None else min(self.max_lights, available)
        usual, share = min(self.usual_lights, most), self.usual_lights_share
        return draw_light_counts(
            captures, self.min_lights, most, usual, generator, usual_share=share
        )


class DenseMap(NamedTuple):
    """True dense maps."""

    values: Tensor  # (P, 1, w, w), zero where the value is unknown, such as outside the unit disc
    known: Tensor  # same shape, 1 where values are measured
    # same shape, 1 where values are measured or interpolated from measured neighbours
    filled: Tensor


class PixelTruth(Protocol):
    """The true unit normals (P, 3) and the dense maps of P pixels, at the scale of the radiance.

    `rotate` rotates each pixel about the view axis by its own angle, given as cosine and sine (P,).
    """

    @property
    def normals(self) -> Tensor: ...
    def rotate(self, cosine: Tensor, sine: Tensor) -> Self: ...
    def dense_truth(self, size: int) -> DenseMap: ...


@dataclass(frozen=True)
class PixelBatch:
    """Simulated observations of P pixels, and their ground truth."""

    observations: Tensor  # (P, F), linear, divided by the light intensities
    light_directions: Tensor  # (P, F, 3), unit, as calibrated
    valid: Tensor  # (P, F) bool; false for padding
    truth: PixelTruth  # the normals and dense maps
    exposure: Tensor  # (P, 1), the factor from the true radiance to the observations
    captures: int  # number G of captures. Pixel p belongs to capture p % G


def photograph(
    truth: PixelTruth,
    radiance: Tensor,
    directions: Tensor,
    valid: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
) -> PixelBatch:
    """Return a batch of radiance (P, F) under directions (P, F, 3), photographed with random
    faults.

    Each pixel has its own camera and calibration faults.
    """
    pixels, lights = radiance.shape
    intensities = draw_light_intensities(pixels, lights, config.unequal_lights_share, generator)
    radiance = radiance * valid
    exposure = draw_exposure(radiance * intensities, config.saturated_share, generator)
    exposed = (radiance * intensities * exposure).clamp(max=1)
    clipped = exposed >= 1
    if config.sensor_noise:
        exposed = quantise(add_sensor_noise(exposed, generator), config.eight_bit_share, generator)
    exposed = torch.where(clipped, 1, exposed)
    observed = exposed * valid / intensities
    observed = disturb_light_intensities(observed, config.light_intensity_error_share, generator)
    calibrated = disturb_light_directions(directions, config.light_direction_error_share, generator)
    restored = restore(observed, clipped & valid, calibrated, valid, generator)
    return PixelBatch(restored, calibrated, valid, truth, exposure, pixels)
