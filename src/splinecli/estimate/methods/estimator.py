"""The interface that every method of photometric stereo implements, and least squares. This module
does not import PyTorch.

LS: Lambertian least squares. R. J. Woodham, "Photometric method for determining surface orientation
from multiple images", 1980.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from splinecli.maths import Array, Bools, Float32Array, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.robust import solve_each
from splinecli.system.progress import Progress, ignore

if TYPE_CHECKING:
    from splinecli.estimate.refinement.refiner import NetworkRefiner
    from splinecli.lights.lighting import LightingAt
    from splinecli.maths.observation_map import Grid


FEWEST_TO_DISTIL = 64  # smallest sample from which a network can be distilled


@dataclass(frozen=True)
class StudentSize:
    """The size of a distilled network, of its training sample and of its training."""

    sample: int  # number of pixels that the network estimates
    steps: int  # training steps
    width: int  # units in each hidden layer of the perceptron


def student_sizes(n_pixels: int) -> tuple[StudentSize, StudentSize]:
    """Return the usual size for a capture of n_pixels, and the size to use if that is not enough.

    Training visits each pixel of the sample about 20 times. A sample that is larger by half reduces
    the mean error on a rendered relief of 6 megapixels by less than 0.01 degrees.
    """
    usual = min(round(10_000 * max(1.0, n_pixels / 100_000) ** 0.15), n_pixels // 4)
    larger = min(3 * usual, n_pixels // 2)
    return StudentSize(usual, max(500, usual // 12), 96), StudentSize(
        larger, max(500, larger // 12), 192
    )


Observations = Float32Array  # (P, F), linear, divided by the light intensities

# (F, 3), or (P, F, 3) if near lamps give each pixel its own: unit vectors towards the lights; x
# right, y up, z to the camera.
Directions = Floats


def directions_at(light_directions: Directions, pixels: slice | Array) -> Directions:
    """Return the light directions of some pixels, which all pixels share or which differ from pixel
    to pixel.
    """
    return light_directions if light_directions.ndim == 2 else light_directions[pixels]


# Pixels passed to an estimator at once, unless its `tile_pixels` differs
TILE_PIXELS = 16_384


class Estimator:
    """A method that estimates the normals of pixels from their observations, with all hooks that a
    method may have.

    The default hooks do nothing.

    name: the method's name in the registry. weights: name and SHA-256 of its weights, or None if it
    has none. device, precision: where and in which number format it computes; the report states
    both. fingerprint: name, weights and settings as one string. Equal fingerprints give equal
    normals, apart from rounding. has_confidence: whether it also estimates its own accuracy.
    needs_capture: whether its estimate of a pixel depends on the other pixels and the mask.
    tile_pixels: the number of pixels that it gets at once.
    refiner: corrects the map of normals, using the neighbourhood of each pixel; or None.
    """

    name: str
    weights: dict[str, str] | None = None
    device: str = "cpu"
    precision: str = "float64"
    fingerprint: str
    has_confidence: bool = False
    needs_capture: bool = False
    tile_pixels: int = TILE_PIXELS
    refiner: NetworkRefiner | None = None

    def estimate(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> Floats:
        """Estimate unit normals (P, 3); x right, y up, z to the camera.

        A pixel that is black under every light has no normal and gets (0, 0, 1). The observations
        are (P, F), the light directions (F, 3) or (P, F, 3). `progress` is called after each batch
        with its number of pixels. Methods without confidence override this function, all others
        override estimate_with_error.
        """
        return self.estimate_with_error(observations, light_directions, progress=progress)[0]

    def estimate_with_error(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> tuple[Floats, Floats | None]:
        """Estimate normals (P, 3) as `estimate` does, and the distributions (P, 2) of their errors.

        The distributions are None for methods without confidence. Their two parameters are
        described in networks/li_ne_net.py. A pixel that is black under every light gets
        UNKNOWN_ERROR.
        """
        return self.estimate(observations, light_directions, progress=progress), None

    def bind(self, lighting_at: LightingAt, mask: Bools) -> Estimator:
        """Return the estimator for one capture, possibly with an encoded sample of its pixels as
        context.

        `lighting_at` returns the observations and light directions of given pixels of the mask
        (H, W).
        """
        return self

    def rebind(self, lighting_at: LightingAt, mask: Bools) -> Estimator:
        """Return the estimator, which `bind` made, for the same capture with other observations."""
        return self.bind(lighting_at, mask)

    def observation_maps(
        self,
        observations: Observations,
        light_directions: Directions,
        all_observations: Observations,
        all_directions: Float64Array,
    ) -> ObservationMaps | None:
        """Return the observation maps of pixels, or None if the method has none.

        The observations (P, F) and (P, F') are of the same pixels, under light directions (F, 3)
        and (F', 3).
        """
        return None

    def warn_of_lights(self, n_lights: int) -> list[str]:
        """Return a warning if the method is not suitable for this number of lights."""
        return []


class ObservationMaps(NamedTuple):
    """Observation maps (P, w, w) in the frames of the pixels, relative to the largest observation,
    NaN in empty cells.
    """

    sparse: Float32Array  # the input of the network
    dense: Float32Array  # the output of LI-Net
    every: Float32Array  # of all lights
    grid: Grid


CONFIDENT_DEG = 5.0  # confidence is the probability that a normal is off by at most this angle

UNKNOWN_ERROR = (
    math.log(math.pi),
    math.log(30.0),
)  # without a normal; its confidence is 0


def confident_share(errors: Floats) -> Float32Array:
    """Return the probabilities (P,) that errors are at most CONFIDENT_DEG, from their distributions
    (P, 2).
    """
    import torch

    from splinecli.estimate.networks.li_ne_net import probability_within

    return np.asarray(
        probability_within(torch.from_numpy(errors), CONFIDENT_DEG).numpy(), np.float32
    )


TOWARDS_CAMERA = (0.0, 0.0, 1.0)  # the normal of a pixel that is black under every light


class LeastSquares(Estimator):
    """Least squares over all observations, including shadows: minimise |I - L b|, n = b / |b|.
    Computes in float64 on the CPU.
    """

    name = fingerprint = "ls"

    def estimate(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> Float64Array:
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3);
        see Estimator.
        """
        values = observations.astype(np.float64)
        if light_directions.ndim == 2:
            scaled = values @ np.linalg.pinv(light_directions).T
        else:
            scaled = solve_each(values, light_directions)
        normals: Float64Array = unit(scaled)
        normals[~scaled.any(axis=1)] = TOWARDS_CAMERA
        progress(len(normals))
        return normals
