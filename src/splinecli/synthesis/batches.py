"""Batches of training pixels from any source: simulated observations and ground truth."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol, Self

import torch
from msgspec import Meta
from torch import Tensor

from splinecli.records import Count, Share
from splinecli.synthesis import faults

LightCount = Annotated[int, Meta(ge=3)]


@dataclass(frozen=True)
class CaptureConfig:
    """How pixels are photographed, and how often each fault occurs, as a share of the pixels.

    A share of 0 disables a fault.
    """

    # min_lights, max_lights, usual_lights: see draw_light_counts
    min_lights: LightCount = 4
    max_lights: LightCount = 96
    usual_lights: LightCount = 10
    # usual number of pixels per capture, which share lights, materials and faults. With 1, each pixel is independent.
    capture_pixels: Count = 1
    ambient_share: Share = 0.5  # captures under ambient light, and independently drawn pixels
    light_direction_error_share: Share = 0.5  # pixels with errors of the light directions
    light_intensity_error_share: Share = 0.5  # pixels with errors of the light intensities
    unequal_lights_share: Share = 0.5  # pixels whose lights differ in intensity; the observations are normalised
    saturated_share: Share = 0.1  # pixels with clipped observations; half are restored as in `infer`
    sensor_noise: bool = True  # whether to add noise and quantisation
    eight_bit_share: Share = 0.3  # pixels with 8 bits; the others have 10 to 16
    optics_share: Share = 0.75  # captures photographed as images through a simulated lens and sensor; see draw_optics

    def captures(self, pixels: int) -> int:
        """Return the number G of captures in a draw of `pixels` pixels. Pixel p belongs to capture p % G."""
        return max(1, pixels // self.capture_pixels)


class DenseMap(NamedTuple):
    """True dense maps."""

    values: Tensor  # (P, 1, w, w), zero where the value is unknown, such as outside the unit disc
    known: Tensor  # same shape, 1 where values are measured
    filled: Tensor  # same shape, 1 where values are measured or interpolated from measured neighbours


class PixelTruth(Protocol):
    """The true normals and dense maps of P pixels."""

    @property
    def normals(self) -> Tensor:
        """Unit normals (P, 3)."""

    def rotate(self, cosine: Tensor, sine: Tensor) -> Self:
        """Rotate each pixel about the view axis by its own angle, given as cosine and sine (P,)."""

    def dense_truth(self, size: int) -> DenseMap:
        """Return the complete maps at the scale of the radiance."""


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
    """Photograph radiance (P, F) under directions (P, F, 3), each pixel with its own random faults.

    These are camera and calibration faults.
    """
    pixels, lights = radiance.shape
    intensities = faults.draw_light_intensities(pixels, lights, config.unequal_lights_share, generator)
    radiance = radiance * valid
    exposure = faults.draw_exposure(radiance * intensities, config.saturated_share, generator)
    exposed = (radiance * intensities * exposure).clamp(max=1)
    clipped = exposed >= 1
    if config.sensor_noise:
        exposed = faults.quantise(faults.add_sensor_noise(exposed, generator), config.eight_bit_share, generator)
    exposed = torch.where(clipped, 1, exposed)
    observed = exposed * valid / intensities
    observed = faults.disturb_light_intensities(observed, config.light_intensity_error_share, generator)
    calibrated = faults.disturb_light_directions(directions, config.light_direction_error_share, generator)
    restored = faults.restore(observed, clipped & valid, calibrated, valid, generator)
    return PixelBatch(restored, calibrated, valid, truth, exposure, pixels)
