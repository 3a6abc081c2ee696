"""The interface that every method of photometric stereo implements, and least squares; imported without PyTorch.

LS: Lambertian least squares. R. J. Woodham, "Photometric method for determining surface orientation from multiple
images", 1980.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from splinecli.fits.robust import solve_each
from splinecli.maths.normals import unit
from splinecli.system.progress import Progress

if TYPE_CHECKING:
    from splinecli.lights.lamp_light import LightOf
    from splinecli.refinement.refiner import NetworkRefiner


FEWEST_PIXELS = 64  # the smallest sample that can be learned from


@dataclass(frozen=True)
class StudentSize:
    """How much is learned."""

    sample: int  # number of pixels that the network estimates
    steps: int  # steps of learning
    width: int  # units in each hidden layer of the perceptron


def student_sizes(n_pixels: int) -> tuple[StudentSize, StudentSize]:
    """Return the usual size for a capture of n_pixels, and the size where that one is not enough.

    Each pixel of the sample is learned some 25 times.
    """
    usual = min(round(10_000 * max(1.0, n_pixels / 100_000) ** 0.25), n_pixels // 4)
    larger = min(3 * usual, n_pixels // 2)
    return StudentSize(usual, max(500, usual // 10), 192), StudentSize(larger, max(500, larger // 10), 320)


Observations = NDArray[np.float32]  # (P, F): linear, already divided by the light intensities

Directions = NDArray[np.floating]
"""(F, 3), or (P, F, 3) where near lamps give each pixel its own: unit vectors towards the lights; x right, y up, z to
the camera."""


def directions_at(light_directions: Directions, rows: slice | NDArray[Any]) -> Directions:
    """Return the light directions of some pixels: those that all pixels share, or the pixels' own."""
    return light_directions if light_directions.ndim == 2 else light_directions[rows]


class Estimator(Protocol):
    """A method that estimates the normals of pixels from their observations.

    Pixels may see others of their capture; see `for_capture`.

    name: the method's name in the registry. weights: name and SHA-256 of its weights, or None if it has none.
    device, precision: where and in which number format it computes; the report states both.
    fingerprint: name, weights and settings as one string. Equal fingerprints give equal normals, apart from rounding.
    """

    @property
    def name(self) -> str: ...
    @property
    def weights(self) -> dict[str, str] | None: ...
    @property
    def device(self) -> str: ...
    @property
    def precision(self) -> str: ...
    @property
    def fingerprint(self) -> str: ...

    def estimate(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> NDArray[np.floating]:
        """Estimate unit normals (P, 3); x right, y up, z to the camera.

        A pixel that is dark under every light has no normal. It gets (0, 0, 1).

        Args:
            progress: called after each batch with the number of its pixels.
        """
        ...


TILE_PIXELS = 16_384  # pixels that an estimator gets at once, unless it has a `tile_pixels` of its own
CONFIDENT_DEG = 5.0  # confidence is the probability that a normal is off by at most this angle

UNKNOWN_ERROR = (math.log(math.pi), math.log(30.0))
"""The distribution of the error of a normal that nothing is known of. Its confidence is 0."""


@runtime_checkable
class ConfidentEstimator(Estimator, Protocol):
    """An estimator that can also estimate its own accuracy, if its weights allow that."""

    @property
    def tells_confidence(self) -> bool: ...

    def estimate_with_error(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Estimate normals (P, 3) as `estimate` does, and the distributions (P, 2) of their errors.

        networks/li_ne_net.py describes the two numbers. A pixel that is dark under every light gets UNKNOWN_ERROR.
        """
        ...


def refiner_of(estimator: Estimator) -> NetworkRefiner | None:
    """Return what corrects the estimator's map of normals by what lies around each pixel, if anything does."""
    refiner: NetworkRefiner | None = getattr(estimator, "refiner", None)
    return refiner


AnyEstimator = TypeVar("AnyEstimator", bound=Estimator)


def for_capture(estimator: AnyEstimator, light_of: LightOf, n_pixels: int) -> AnyEstimator:
    """Return the estimator for the pixels of one capture: some see a sample of them first.

    Args:
        light_of: gives the observations and the light directions of some pixels.
        n_pixels: of the capture.
    """
    look_at = getattr(estimator, "for_capture", None)
    found: AnyEstimator = estimator if look_at is None else look_at(light_of, n_pixels)
    return found


def see_anew(estimator: Estimator, light_of: LightOf, n_pixels: int) -> Estimator:
    """Return an estimator of `for_capture` for the same capture with other observations; a distilled one learns again.

    The arguments are those of `for_capture`.
    """
    learn_anew = getattr(estimator, "learn_anew", None)
    if learn_anew is None:
        return for_capture(estimator, light_of, n_pixels)
    found: Estimator = learn_anew(light_of, n_pixels)
    return found


def tells_confidence(estimator: Estimator) -> TypeGuard[ConfidentEstimator]:
    """Return whether the estimator can estimate its own accuracy."""
    return isinstance(estimator, ConfidentEstimator) and estimator.tells_confidence


def confidence(errors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the probability (P,) that an error is at most CONFIDENT_DEG, from its distributions (P, 2)."""
    import torch

    from splinecli.networks.li_ne_net import probability_within

    return np.asarray(probability_within(torch.from_numpy(errors), CONFIDENT_DEG).numpy(), np.float32)


TOWARDS_CAMERA = (0.0, 0.0, 1.0)  # the normal of a pixel that is dark under every light


@dataclass(frozen=True)
class LeastSquares:
    """Minimise |I - L b| over all observations, including shadows; n = b / |b|. In float64 on the CPU."""

    name: str = "ls"
    weights: None = None
    device: str = "cpu"
    precision: str = "float64"
    fingerprint: str = "ls"

    def estimate(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> NDArray[np.float64]:
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3); see Estimator."""
        values = observations.astype(np.float64)
        if light_directions.ndim == 2:
            scaled = values @ np.linalg.pinv(light_directions).T
        else:
            scaled = solve_each(values, light_directions)
        normals: NDArray[np.float64] = unit(scaled)
        normals[~scaled.any(axis=1)] = TOWARDS_CAMERA
        if progress is not None:
            progress(len(normals))
        return normals
