"""An estimator for a single capture: a perceptron trained on a network's normals for a sample of
the pixels.

A capture has one set of lights, or lights that change smoothly over the image, and few materials,
so most of its pixels are redundant. The network estimates a sample of the pixels. Trained on this
sample, the perceptron estimates the rest over 100 times as fast. The part that it does not
reproduce is mostly the network's noise (Hinton, Vinyals and Dean, Distilling the knowledge in a
neural network, arXiv 1503.02531).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from splinecli.errors import UsageError
from splinecli.estimate.fits.least_squares import weighted_least_squares
from splinecli.estimate.methods.estimator import (
    FEWEST_TO_DISTIL,
    TOWARDS_CAMERA,
    UNKNOWN_ERROR,
    Directions,
    Estimator,
    Observations,
    StudentSize,
    directions_at,
)
from splinecli.estimate.networks.li_ne_net import median_error_deg
from splinecli.lights.lighting import LightingAt
from splinecli.maths import Bools, Float32Array
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.observation_map import map_scale
from splinecli.maths.pixel_grid import slices
from splinecli.system.machine import one_thread_each, side_by_side
from splinecli.system.progress import Progress, ignore

CELLS = 256  # number of groups of pixels with similar appearance
# Share of the sample that is drawn uniformly from all pixels. The rest is drawn evenly from the
# groups.
EVEN_SHARE = 0.5


@dataclass(frozen=True)
class PixelSample:
    """A sample of pixels and the appearances that it covers."""

    # (N,), distinct indices of the pixels. The first EVEN_SHARE are a uniform sample of all pixels
    rows: Tensor
    # (K, C), the features at the centres of the groups, the smallest groups first
    centres: Tensor
    n_rare: int  # number of groups considered rare
    # largest distance of a candidate pixel from the nearest centre
    reach: float

    def unlike(self, features: Tensor) -> Tensor:
        """Return which pixels (P,) with features (P, C) are in rare groups, or outside all
        groups.
        """
        # Twice as fast as torch.cdist.
        products = torch.addmm(self.centres.square().sum(dim=1), features, self.centres.T, alpha=-2)
        squares = features.square().sum(dim=1)
        from_rare, from_others = (
            (part.amin(dim=1) + squares).clamp(min=0).sqrt()
            if part.shape[1]
            else torch.full_like(squares, torch.inf)
            for part in (products[:, : self.n_rare], products[:, self.n_rare :])
        )
        # The tolerance keeps rounding errors from excluding pixels of the sample.
        return (from_rare < from_others) | (from_others > 1.001 * self.reach + 1e-4)


def draw_sample(
    features: Tensor, size: int, generator: torch.Generator, *, rare_share: float = 0.0
) -> PixelSample:
    """Draw a sample of `size` pixels, or half of all pixels if that is less.

    The pixels are grouped around centres, each of which is the pixel farthest from all previous
    centres (Gonzalez, Clustering to minimize the maximum intercluster distance, 1985), so that rare
    appearances get separate groups. The features (P, C) are of the candidate pixels, and the
    generator is on the CPU. `rare_share` is the largest share of the pixels in groups that are
    considered rare.
    """
    order = torch.randperm(len(features), generator=generator)
    size = min(size, len(features) // 2)
    n_even = round(EVEN_SHARE * size)
    centres, nearest, reach = _group(features)
    counts = torch.bincount(nearest, minlength=len(centres))
    by_count = torch.argsort(counts, stable=True)
    n_rare = int((counts[by_count].cumsum(0) <= rare_share * int(counts.sum())).sum())
    left = order[n_even:]
    # Take one pixel from each group in turn, until there are enough.
    turns = torch.argsort(_rank_in_group(nearest[left.to(nearest.device)].cpu()), stable=True)
    pixels = torch.cat((order[:n_even], left[turns[: size - n_even]]))
    return PixelSample(pixels, features[centres[by_count]], n_rare, reach)


def _group(features: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return the pixels (K,) at the centres, the group of each pixel (P,), and the largest distance
    from a centre.
    """
    centres = [int(((features - features.mean(dim=0)) ** 2).sum(dim=1).argmin())]
    squares = (features * features).sum(dim=1)
    distance = torch.full_like(squares, torch.inf)
    nearest = torch.zeros(len(features), dtype=torch.long, device=features.device)
    for number in range(min(CELLS, len(features))):
        centre = centres[number]
        new = squares - 2 * (features @ features[centre]) + squares[centre]
        nearest[new < distance] = number
        distance = torch.minimum(distance, new)
        centres.append(int(distance.argmax()))
    reach = float(distance.amax().clamp(min=0).sqrt())
    return torch.tensor(centres[:-1], device=features.device), nearest, reach


def _rank_in_group(groups: Tensor) -> Tensor:
    """Return how many earlier pixels are in the group of each pixel (P,)."""
    by_group = torch.argsort(groups, stable=True)
    counts = torch.bincount(groups)
    rank = torch.empty_like(groups)
    rank[by_group] = torch.arange(len(groups)) - (counts.cumsum(0) - counts)[groups[by_group]]
    return rank


BATCH = 256
_LEARNING_RATE = 1e-2
_WARM_UP = 0.1  # share of the steps during which the learning rate rises
# Decay rates of Adam's means of the gradient and of its square (arXiv 1412.6980)
_MOMENTUM, _SQUARES = 0.9, 0.99
_ERROR_SHARE = 0.05  # weight of the errors in the loss
_ROUNDED = 0.02  # radians; the loss is the angle, but becomes quadratic below this value


class Perceptron(nn.Module):
    """A network that corrects a pixel's least-squares normal from its observations in the capture's
    order of lights.

    The unit light directions are (F, 3), or (P, F, 3) of some pixels if they differ because of near
    lamps. The hidden layers are `width` wide. The weights are drawn with the generator.
    """

    solve: Tensor | None
    mean: Tensor
    spread: Tensor

    def __init__(self, light_directions: Tensor, width: int, generator: torch.Generator) -> None:
        super().__init__()
        near = light_directions.ndim == 3
        n_inputs = light_directions.shape[-2] + (6 if near else 3)
        self.register_buffer(
            "solve", None if near else torch.linalg.pinv(light_directions.double()).T.float()
        )
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("spread", torch.ones(n_inputs))
        with torch.random.fork_rng(devices=[]):  # the layers draw weights that are replaced below
            sizes = (n_inputs, width, width, width, 5)
            self.layers = nn.ModuleList(
                nn.Linear(wide, units) for wide, units in itertools.pairwise(sizes)
            )
        weights, biases = self._weights_and_biases()
        for weight in weights[:-1]:
            nn.init.kaiming_uniform_(weight, nonlinearity="relu", generator=generator)
        for values in (weights[-1], *biases):
            nn.init.zeros_(values)  # training starts from least squares

    def _weights_and_biases(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        parameters = list(self.parameters())
        return parameters[::2], parameters[1::2]

    def inputs(self, observations: Tensor, light_directions: Tensor) -> Tensor:
        """Return observations (P, F) scaled to a largest value of 1, followed by least-squares
        normals, (P, F + 3).

        For lights (P, F, 3), their mean direction (P, 3) is placed in between, because it encodes
        the pixel's position.
        """
        scaled = observations / map_scale(observations)
        if self.solve is not None:
            return torch.cat((scaled, normalize(scaled @ self.solve, dim=1)), dim=1)
        fitted, _ = weighted_least_squares(scaled, light_directions, torch.ones_like(scaled))
        return torch.cat((scaled, light_directions.mean(dim=1), normalize(fitted, dim=1)), dim=1)

    def forward(self, inputs: Tensor, *, bfloat16: bool = False) -> tuple[Tensor, Tensor]:
        """Return unit normals (P, 3) and the distributions of their errors (P, 2); see
        networks/li_ne_net.py.

        For the inputs (P, C), see `inputs`. With bfloat16, the last layer still computes in
        float32.
        """
        scaled = (inputs - self.mean) / self.spread
        with torch.autocast(inputs.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            *hidden, last = self.layers
            for layer in hidden:
                scaled = layer(scaled).relu_()
        found = last(scaled.to(inputs.dtype))
        return normalize(inputs[:, -3:] + found[:, :3], dim=1), found[:, 3:]

    def gradient(self, inputs: Tensor, normals: Tensor, errors: Tensor) -> list[Tensor]:
        """Return the gradients of the loss, in the order of `parameters`.

        For pixels with inputs (P, C), the loss is the mean angle to the normals (P, 3), plus
        _ERROR_SHARE times the mean square difference from the errors (P, 2). The angle is not
        squared, so that the network's outliers do not affect the normals of other pixels. Without
        autograd, training takes half of the time.
        """
        (*weights, last), (*biases, offset) = self._weights_and_biases()
        passed = [(inputs - self.mean) / self.spread]
        for weight, bias in zip(weights, biases, strict=True):
            passed.append(linear(passed[-1], weight, bias).relu_())
        found = linear(passed[-1], last, offset)
        corrected = inputs[:, -3:] + found[:, :3]
        length = corrected.norm(dim=1, keepdim=True).clamp_(min=1e-12)
        unit = corrected / length
        away = unit - normals
        away /= (away.square().sum(dim=1, keepdim=True) + _ROUNDED**2).sqrt_()
        across = (away - unit * (unit * away).sum(dim=1, keepdim=True)) / length
        change = torch.cat((across, _ERROR_SHARE * (found[:, 3:] - errors)), dim=1).div_(
            len(inputs)
        )
        gradients: list[Tensor] = []
        for weight, values in zip((last, *reversed(weights)), reversed(passed), strict=True):
            gradients[:0] = change.T @ values, change.sum(dim=0)
            if values is not passed[0]:
                change = torch.ops.aten.threshold_backward(change @ weight, values, 0)
        return gradients

    @one_thread_each()
    @torch.no_grad()
    def learn(
        self,
        inputs: Tensor,
        normals: Tensor,
        errors: Tensor,
        *,
        steps: int,
        generator: torch.Generator,
        progress: Callable[[], object],
    ) -> None:
        """Train on the normals (P, 3) and errors (P, 2) of pixels with inputs (P, C). Calls
        `progress` after each step.
        """
        parameters = list(self.parameters())
        parameters[-1][3:] = errors.mean(dim=0)
        self.mean.copy_(inputs.mean(dim=0))
        self.spread.copy_(inputs.std(dim=0) + 1e-3)
        values = parameters_to_vector(parameters)
        # The parameters become views of the vector, which each step updates as a whole.
        vector_to_parameters(values, parameters)
        mean, square = torch.zeros_like(values), torch.zeros_like(values)
        order = torch.empty(0, dtype=torch.long)
        for step in range(1, steps + 1):
            if len(order) < BATCH:
                order = torch.randperm(len(inputs), generator=generator)
            pixels, order = order[:BATCH].to(inputs.device), order[BATCH:]
            gradient = parameters_to_vector(
                self.gradient(inputs[pixels], normals[pixels], errors[pixels])
            )
            mean.lerp_(gradient, 1 - _MOMENTUM)
            square.lerp_(gradient.square_(), 1 - _SQUARES)
            rate = _LEARNING_RATE * _rate_share(step / steps)
            rate *= math.sqrt(1 - _SQUARES**step)
            rate /= 1 - _MOMENTUM**step
            values.addcdiv_(mean, square.sqrt().add_(1e-8), value=-rate)
            progress()


def _rate_share(done: float) -> float:
    """Return the factor of the learning rate after a share of the steps: a linear rise, then a
    cosine decay.
    """
    return min(
        done / _WARM_UP, 0.5 + 0.5 * math.cos(math.pi * max(0.0, done - _WARM_UP) / (1 - _WARM_UP))
    )


_CANDIDATES = 100_000  # pixels from which the sample is drawn

_TILE = 8192  # with smaller tiles, cores often wait for each other


@dataclass(frozen=True)
class DistilledFrom:
    """The training of a perceptron and the accuracy that it reached."""

    sample: int  # number of pixels that the network estimated
    held_out: int  # number of these not used for training, a uniform sample of the capture
    # mean_deg, p95_deg: angles between the normals of perceptron and network for the held-out
    # pixels
    mean_deg: float
    p95_deg: float
    expected_deg: float  # the network's mean predicted error for the held-out pixels

    @property
    def is_good(self) -> bool:
        """Whether the perceptron approximates the network closely enough, compared with the
        network's own errors.
        """
        # On rendered pixels, a larger factor increased the true error by 0.3 degrees or more.
        return self.mean_deg <= 0.7 * self.expected_deg


class DistilledEstimator(Estimator):
    """The perceptron for most pixels of a capture, and the network for rare or dissimilar pixels;
    see distil.
    """

    has_confidence = True
    needs_capture = True
    tile_pixels = 1 << 20
    """Large enough for the few rare pixels of a tile to fill several batches of the network."""

    def __init__(
        self,
        teacher: Estimator,
        perceptron: Perceptron,
        sample: PixelSample,
        found: DistilledFrom,
        size: StudentSize,
    ) -> None:
        self._teacher, self._perceptron, self._sample = teacher, perceptron, sample
        self._size, self.distillation, self.n_unlike = size, found, 0
        self.name, self.weights = teacher.name, teacher.weights
        self.refiner = teacher.refiner
        self.device, self.precision = teacher.device, teacher.precision
        self.fingerprint = f"{teacher.fingerprint} distilled from {found.sample} pixels"

    def rebind(self, lighting_at: LightingAt, mask: Bools) -> Estimator:
        """Return a new perceptron for the changed observations, or the network if too few pixels
        remain lit.
        """
        teacher = self._teacher.bind(lighting_at, mask)
        try:
            learned = distil(teacher, lighting_at, int(np.count_nonzero(mask)), self._size)
        except UsageError:  # too few lit pixels
            return teacher
        return learned if learned.distillation.is_good else teacher

    def report(self) -> dict[str, Any]:
        """Return how the capture has been estimated so far, as JSON values."""
        found = self.distillation
        return {
            "sample": found.sample,
            "held_out": found.held_out,
            "angle_to_network_deg": {
                "mean": round(found.mean_deg, 4),
                "p95": round(found.p95_deg, 4),
            },
            "expected_error_deg": round(found.expected_deg, 4),
            "unlike_pixels": self.n_unlike,
        }

    def estimate_with_error(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> tuple[Float32Array, Float32Array]:
        """Estimate unit normals (P, 3) and the distributions (P, 2) of the network's errors; see
        Estimator.
        """
        normals, errors = (np.empty((len(observations), columns), np.float32) for columns in (3, 2))
        # The pixels that are rare or dissimilar to the sample
        unlike = np.empty(len(observations), np.bool_)

        def apply(rows: slice) -> slice:
            own = observations[rows]
            inputs = _inputs(
                self._perceptron, own, directions_at(light_directions, rows), self.device
            )
            found = self._perceptron(inputs, bfloat16=self.precision == "bfloat16")
            normals[rows], errors[rows] = (values.cpu().numpy() for values in found)
            dark = ~(own > 0).any(axis=1)
            normals[rows][dark | ~normals[rows].any(axis=1)] = TOWARDS_CAMERA
            errors[rows][dark] = UNKNOWN_ERROR
            unlike[rows] = self._sample.unlike(inputs).cpu().numpy() & ~dark
            return rows

        for rows in side_by_side(apply, slices(len(observations), _TILE)):
            progress(int(np.count_nonzero(~unlike[rows])))
        if unlike.any():
            self.n_unlike += int(np.count_nonzero(unlike))
            taught = self._teacher.estimate_with_error(
                observations[unlike], directions_at(light_directions, unlike), progress=progress
            )
            normals[unlike], errors[unlike] = taught
        return normals, errors


def distil(
    teacher: Estimator,
    lighting_at: LightingAt,
    n_pixels: int,
    size: StudentSize,
    *,
    seed: int = 0,
    progress: Progress = ignore,
) -> DistilledEstimator:
    """Return an estimator for one capture's pixels, trained on `teacher`'s normals for a sample of
    the pixels.

    Equal seeds give equal results. The teacher must have confidence and be bound to the capture;
    see Estimator.bind. `progress` is called with numbers of pixels, which add up to twice the size
    of the sample. Raises UsageError if too few pixels are lit for a sample of FEWEST_TO_DISTIL.
    """
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    light = lighting_at(np.sort(rng.choice(n_pixels, min(_CANDIDATES, n_pixels), replace=False)))
    lit = np.flatnonzero((light.observations > 0).any(axis=1))
    candidates = light.observations[lit]
    directions = directions_at(light.directions, lit)
    if len(candidates) // 2 < FEWEST_TO_DISTIL:  # the sample contains at most half of them
        raise UsageError(
            f"only {len(candidates)} pixels are lit, which is too few to distil the network"
        )
    lights = torch.as_tensor(directions, dtype=torch.float32)
    perceptron = Perceptron(lights, size.width, generator).to(teacher.device)
    with torch.inference_mode(False):  # inference mode forbids updates in place
        inputs = _inputs(perceptron, candidates, directions, teacher.device)
        # Rare pixels, which the network processes, are at most 0.5 % of all pixels and half as many
        # as the sample.
        rare_share = min(0.005, 0.5 * size.sample / n_pixels)
        sample = draw_sample(inputs, size.sample, generator, rare_share=rare_share)
        pixels = sample.rows.numpy()
        taught = teacher.estimate_with_error(
            candidates[pixels], directions_at(directions, pixels), progress=progress
        )
        inputs = inputs[sample.rows.to(inputs.device)]
        normals, errors = (
            torch.as_tensor(np.asarray(values, np.float32), device=inputs.device)
            for values in taught
        )
        held = round(len(inputs) / 8)  # the first pixels are a uniform sample
        share = len(inputs) / size.steps
        done = 0.0

        def count() -> None:
            nonlocal done
            done += share
            if done >= 1:
                progress(int(done))
                done -= int(done)

        learned_from = inputs[held:], normals[held:], errors[held:]
        perceptron.learn(*learned_from, steps=size.steps, generator=generator, progress=count)
    with torch.inference_mode():
        learned, _ = perceptron(inputs[:held], bfloat16=teacher.precision == "bfloat16")
        angles = angle_between_deg(learned.cpu().numpy(), normals[:held].cpu().numpy())
    found = DistilledFrom(
        sample=len(inputs),
        held_out=held,
        mean_deg=float(angles.mean()),
        p95_deg=float(np.quantile(angles, 0.95)),
        expected_deg=float(median_error_deg(errors[:held]).mean()),
    )
    return DistilledEstimator(teacher, perceptron, sample, found, size)


def _inputs(
    perceptron: Perceptron, observations: Observations, light_directions: Directions, device: str
) -> torch.Tensor:
    lights = torch.as_tensor(light_directions, dtype=torch.float32, device=device)
    return perceptron.inputs(torch.as_tensor(observations).to(device), lights)
