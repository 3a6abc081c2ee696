"""Batches of training pixels from any source: what a capture would show of them, and the truth."""

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
    """How pixels are photographed, and the share of the pixels whose capture has each fault.

    A share of 0 switches a fault off.
    """

    # min_lights, max_lights, usual_lights: see draw_light_counts
    min_lights: LightCount = 4
    max_lights: LightCount = 96
    usual_lights: LightCount = 10
    # usual number of pixels of one capture, which share its lights, materials and faults. 1 draws each on its own.
    capture_pixels: Count = 1
    ambient_share: Share = 0.5  # captures under ambient light; generated pixels that are drawn one by one, too
    light_direction_error_share: Share = 0.5  # pixels with errors of the light directions
    light_intensity_error_share: Share = 0.5  # pixels with errors of the light intensities
    unequal_lights_share: Share = 0.5  # pixels whose lights differ in intensity, which is divided out
    saturated_share: Share = 0.1  # pixels that are clipped. Half of them are restored as `infer` does.
    sensor_noise: bool = True  # whether there are noise and quantisation
    eight_bit_share: Share = 0.3  # pixels with 8 bits; the others have 10 to 16
    optics_share: Share = 0.75  # captures, photographed as images, that a lens and a sensor changed; see draw_optics

    def captures(self, pixels: int) -> int:
        """Return the number G of captures in a draw of so many pixels. Pixel p belongs to capture p % G."""
        return max(1, pixels // self.capture_pixels)


class DenseMap(NamedTuple):
    """True dense maps."""

    values: Tensor  # (P, 1, w, w), zero where nothing is known, such as outside the unit disc
    known: Tensor  # of the same shape, 1 where values are measured
    filled: Tensor  # of the same shape, 1 where values are measured or interpolated from measured neighbours


class PixelTruth(Protocol):
    """The true normals and dense maps of P pixels."""

    @property
    def normals(self) -> Tensor:
        """Unit normals (P, 3)."""

    def rotate(self, cosine: Tensor, sine: Tensor) -> Self:
        """Turn each pixel about the view axis by its own angle, given as cosine and sine (P,)."""

    def dense_truth(self, size: int) -> DenseMap:
        """Return the complete maps at the scale of the radiance."""


@dataclass(frozen=True)
class PixelBatch:
    """P pixels as a capture shows them, and their truth."""

    observations: Tensor  # (P, F), linear, divided by the light intensities
    light_directions: Tensor  # (P, F, 3), unit, as calibrated
    valid: Tensor  # (P, F) bool; false for padding
    truth: PixelTruth  # the normals and dense maps
    exposure: Tensor  # (P, 1), the factor from the radiance of the truth to the observations
    captures: int  # number G of captures. Pixel p belongs to capture p % G


def photograph(
    truth: PixelTruth,
    radiance: Tensor,
    directions: Tensor,
    valid: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
) -> PixelBatch:
    """Photograph radiance (P, F) under directions (P, F, 3), each pixel with faults of its own.

    These are the faults of a camera and of a calibration.
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
