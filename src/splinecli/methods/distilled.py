"""An estimator made for one capture: a perceptron that learned a network's normals on a sample of the pixels.

One capture has one set of lights and a few materials, so most of its pixels say the same. Under near lamps, the lights
change smoothly over the image. The network estimates a sample of them, the perceptron learns it and estimates the rest
at some 80 times the speed. What the perceptron does not follow is mostly the network's noise (Hinton, Vinyals and Dean,
Distilling the knowledge in a neural network, arXiv 1503.02531).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.errors import UsageError
from splinecli.lights.lamp_light import LightOf
from splinecli.maths.normals import angle_between_deg
from splinecli.methods.estimator import (
    UNKNOWN_ERROR,
    ConfidentEstimator,
    Directions,
    Observations,
    directions_at,
    for_capture,
    refiner_of,
)
from splinecli.methods.least_squares import TOWARDS_CAMERA
from splinecli.methods.pixel_sample import PixelSample, draw_sample
from splinecli.methods.student_size import FEWEST_PIXELS, StudentSize
from splinecli.networks.error_head import median_error_deg
from splinecli.networks.perceptron import Perceptron
from splinecli.system.machine import side_by_side
from splinecli.system.progress import Progress

_CANDIDATES = 100_000  # pixels that the sample is drawn from

_HELD_OUT = 1 / 8  # of the sample
_TILE = 2048  # pixels whose hidden layers stay in a processor's cache
_RARE_SHARE = 0.01  # of the pixels, and
_RARE_PER_SAMPLE = 2  # times the sample are the most pixels of rare kinds that go through the network
_LARGEST_SHARE = 0.7  # of the expected error; on rendered pixels, more cost 0.3 degrees and more against the truth


@dataclass(frozen=True)
class Distillation:
    """What was learned, and how well."""

    sample: int  # number of pixels that the network estimated for learning
    held_out: int  # number of these that were not learned. They are an even sample of the capture
    mean_deg: float  # mean_deg, p95_deg: angles between perceptron and network on the pixels held out
    p95_deg: float
    expected_deg: float  # the mean error that the network expects of itself on them

    @property
    def is_good(self) -> bool:
        """Whether the perceptron follows the network as closely as the network's own errors deserve."""
        return self.mean_deg <= _LARGEST_SHARE * self.expected_deg


class DistilledEstimator:
    """The perceptron for most pixels of a capture, and the network for rare and unlike ones; see distil."""

    tells_confidence = True
    tile_pixels = 1 << 18
    """The few rare pixels of a tile still fill a batch of the network."""

    def __init__(
        self,
        teacher: ConfidentEstimator,
        perceptron: Perceptron,
        sample: PixelSample,
        found: Distillation,
        size: StudentSize,
    ) -> None:
        self._teacher, self._perceptron, self._sample, self._size = teacher, perceptron, sample, size
        self.distillation = found
        self.n_unlike = 0
        self.name, self.weights = teacher.name, teacher.weights
        self.refiner = refiner_of(teacher)
        self.device, self.precision = teacher.device, teacher.precision
        self.fingerprint = f"{teacher.fingerprint} distilled from {found.sample} pixels"

    def learn_anew(self, light_of: LightOf, n_pixels: int) -> ConfidentEstimator:
        """Learn the capture again after its observations changed. Return the network if it cannot be learned.

        The arguments are those of `distil`.
        """
        teacher = for_capture(self._teacher, light_of, n_pixels)
        try:
            learned = distil(teacher, light_of, n_pixels, self._size)
        except UsageError:  # too few pixels are still lit
            return teacher
        return learned if learned.distillation.is_good else teacher

    def report(self) -> dict[str, Any]:
        """Return how the capture was estimated so far, as JSON values."""
        found = self.distillation
        return {
            "sample": found.sample,
            "held_out": found.held_out,
            "angle_to_network_deg": {"mean": round(found.mean_deg, 4), "p95": round(found.p95_deg, 4)},
            "expected_error_deg": round(found.expected_deg, 4),
            "unlike_pixels": self.n_unlike,
        }

    def estimate(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> NDArray[np.float32]:
        """Estimate unit normals (P, 3) from observations (P, F) under the capture's lights; see Estimator."""
        return self.estimate_with_error(observations, light_directions, progress=progress)[0]

    def estimate_with_error(
        self, observations: Observations, light_directions: Directions, *, progress: Progress | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Estimate unit normals (P, 3) and the distributions (P, 2) of the network's errors; see ConfidentEstimator."""
        normals, errors = (np.empty((len(observations), columns), np.float32) for columns in (3, 2))
        unlike = np.empty(len(observations), np.bool_)  # the pixels that are rare, or unlike the sample

        def apply(rows: slice) -> slice:
            own = observations[rows]
            inputs = _inputs(self._perceptron, own, directions_at(light_directions, rows), self.device)
            found = self._perceptron(inputs, bfloat16=self.precision == "bfloat16")
            normals[rows], errors[rows] = (values.cpu().numpy() for values in found)
            dark = ~(own > 0).any(axis=1)
            normals[rows][dark | ~normals[rows].any(axis=1)] = TOWARDS_CAMERA
            errors[rows][dark] = UNKNOWN_ERROR
            unlike[rows] = self._sample.unlike(inputs).cpu().numpy() & ~dark
            return rows

        tiles = (slice(start, start + _TILE) for start in range(0, len(observations), _TILE))
        for rows in side_by_side(apply, tiles):
            if progress is not None:
                progress(int(np.count_nonzero(~unlike[rows])))
        if unlike.any():
            self.n_unlike += int(np.count_nonzero(unlike))
            normals[unlike], errors[unlike] = self._teacher.estimate_with_error(
                observations[unlike], directions_at(light_directions, unlike), progress=progress
            )
        return normals, errors


def distil(
    teacher: ConfidentEstimator,
    light_of: LightOf,
    n_pixels: int,
    size: StudentSize,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> DistilledEstimator:
    """Return an estimator for the pixels of one capture that learned from `teacher` on a sample of them.

    The result is the same for the same seed.

    Args:
        light_of: gives the observations and the light directions of some pixels.
        n_pixels: of the capture.
        progress: called with numbers of pixels; in all, twice the pixels of the sample.

    Raises:
        UsageError: too few pixels are lit for a sample of FEWEST_PIXELS.
    """
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    light = light_of(np.sort(rng.choice(n_pixels, min(_CANDIDATES, n_pixels), replace=False)))
    lit = np.flatnonzero((light.observations > 0).any(axis=1))
    candidates = light.observations[lit]
    directions = directions_at(light.directions, lit)
    if len(candidates) // 2 < FEWEST_PIXELS:  # the sample is at most half of them
        raise UsageError(f"{len(candidates)} pixels are lit, too few to distil the network")
    lights = torch.as_tensor(directions, dtype=torch.float32)
    perceptron = Perceptron(lights, size.width, generator).to(teacher.device)
    with torch.inference_mode(False), torch.enable_grad():
        inputs = _inputs(perceptron, candidates, directions, teacher.device)
        rare_share = min(_RARE_SHARE, _RARE_PER_SAMPLE * size.sample / n_pixels)
        sample = draw_sample(inputs, size.sample, generator, rare_share=rare_share)
        rows = sample.rows.numpy()
        taught = teacher.estimate_with_error(candidates[rows], directions_at(directions, rows), progress=progress)
        inputs = inputs[sample.rows.to(inputs.device)]
        normals, errors = (torch.as_tensor(np.asarray(values, np.float32), device=inputs.device) for values in taught)
        held = round(_HELD_OUT * len(inputs))  # the first pixels are an even sample of all
        share = len(inputs) / size.steps
        done = 0.0

        def count() -> None:
            nonlocal done
            done += share
            if progress is not None and done >= 1:
                progress(int(done))
                done -= int(done)

        learned_from = inputs[held:], normals[held:], errors[held:]
        perceptron.learn(*learned_from, steps=size.steps, generator=generator, progress=count)
    with torch.inference_mode():
        learned, _ = perceptron(inputs[:held], bfloat16=teacher.precision == "bfloat16")
        angles = angle_between_deg(learned.cpu().numpy(), normals[:held].cpu().numpy())
    mean_deg, p95_deg = float(angles.mean()), float(np.quantile(angles, 0.95))
    found = Distillation(len(inputs), held, mean_deg, p95_deg, float(median_error_deg(errors[:held]).mean()))
    return DistilledEstimator(teacher, perceptron, sample, found, size)


def _inputs(
    perceptron: Perceptron, observations: Observations, light_directions: Directions, device: str
) -> torch.Tensor:
    lights = torch.as_tensor(light_directions, dtype=torch.float32, device=device)
    return perceptron.inputs(torch.as_tensor(observations).to(device), lights)
