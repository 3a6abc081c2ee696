"""Search for lights under which the network that estimates normals predicts the smallest errors and
its normals have the least curl.

The network was trained under correct lights on many reflectances. Under wrong lights, the
observations of a pixel match none of these, so it predicts larger errors, even for metals and
glossy surfaces, which a matte model does not explain. The predicted error is differentiable, so its
gradient is used for the search.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.estimate.methods import DEFAULT_METHOD
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import resolve_weights
from splinecli.lights.least_curl import OPPOSITE, BestLights, Lights
from splinecli.maths import Bools, Float64Array, Floats, Integers
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.pixel_grid import Blocks, thin_out
from splinecli.system.machine import in_order, one_thread_each

_GRID_PIXELS, _MOST_LIGHTS = 500, 30
_AVERAGED = 400  # pixels of the capture, at least, for each pixel of the grid
_STEPS, _STEP, _OWN_STEP = 14, 0.06, 0.01  # of the common matrix, and of each light
_MOMENTUM, _SQUARES = 0.7, 0.9  # decay of the means of the gradient and of its square in Adam
# for checking given lights
_FEW_PIXELS, _FEW_STEPS, _DOUBT_DEG = 250, 8, 10.0
# The check stops if the cost falls by less in the first half of the steps, as with correct lights
_HALF_FALL = 0.25
# Weights, relative to the logarithm of the predicted error, of the curl of the normals, of the
# distance from the start, and of the spread of the albedo, which increases if unknown intensities
# are wrong (Alldrin, Mallick and Kriegman, "Resolving the generalized bas-relief ambiguity by
# entropy minimization", CVPR 2007).
_CURL, _NEAR, _ALBEDO = 1.5, 0.5, 1.0
_CURL_TO_CHOOSE, _GUESS_TO_CHOOSE, _FIRST_TO_CHOOSE = 2.0, 0.3, 0.3
_LEAST_Z, _LEAST_LIGHT_Z, _LEAST_COSINE = 0.2, 0.05, 0.2
_INTENSITY_SPREAD = 0.3  # standard deviation of the logarithm of each intensity


def best_lights(
    observations: Floats,
    mask: Bools,
    starts: Sequence[Lights],
    guess: Float64Array,
    guess_errors_deg: Float64Array,
    errors_deg: Float64Array,
    *,
    intensities_known: bool,
) -> BestLights:
    """Return the best lights near one of the starts.

    The observations (P, F) are linear, divided by the light intensities if these are known. The
    mask (H, W) has P true pixels, in row-major order. `errors_deg` (F,) are the expected distances
    of the lights from their start, in degrees. Any start except the first must be clearly better to
    be chosen; the guess (F, 3), with separate errors, has a low weight. Bumps and hollows are not
    distinguished.
    """
    count = observations.shape[1]
    used = _some_lights(count)
    images = _Images.of(observations, mask, used)
    errors = torch.tensor(np.radians(errors_deg[used]), dtype=torch.float32)
    follow = partial(_follow, images, errors, intensities_known=intensities_known)
    parts = [Lights(each.directions[used], each.intensities[used]) for each in starts]
    with one_thread_each() as threads:
        # like side_by_side, but with gradients
        found = [*in_order(follow, parts, threads, lambda: torch.set_num_threads(1))]

    def cost(each: _Followed) -> float:
        away = np.minimum(
            *(
                np.log1p(
                    (
                        angle_between_deg(each.lights.directions * sign, guess[used])
                        / guess_errors_deg[used]
                    )
                    ** 2
                    / 2
                ).mean()
                for sign in (1.0, OPPOSITE)
            )
        )
        return float(
            each.expected + _CURL_TO_CHOOSE * np.log(each.curl + 0.02) + _GUESS_TO_CHOOSE * away
        )

    costs = np.array([cost(each) for each in found])
    costs[1:] += _FIRST_TO_CHOOSE
    best = int(costs.argmin())
    lights = found[best].lights
    if len(used) < count:
        start = starts[best]
        # Move the other lights by the same matrix.
        move = np.linalg.lstsq(start.directions[used], lights.directions, rcond=None)[0]
        directions, intensities = unit(start.directions @ move), start.intensities.copy()
        directions[used], intensities[used] = lights
        lights = Lights(directions, intensities)
    return BestLights(lights, best, found[best].expected, found[best].curl)


def _some_lights(count: int) -> Integers:
    return np.linspace(0, count - 1, min(count, _MOST_LIGHTS)).astype(int)


@dataclass(frozen=True, eq=False)
class LightWitness:
    """Assessment of the given lights (F, 3) of images, and of alternatives, by the network."""

    images: _Images
    used: Integers
    given: Float64Array  # (F, 3)

    @classmethod
    def of(cls, observations: Floats, mask: Bools, given: Float64Array) -> LightWitness:
        """Return the witness for observations (P, F), which are divided by the light
        intensities.
        """
        used = _some_lights(len(given))
        return cls(_Images.of(observations, mask, used, _FEW_PIXELS), used, given)

    def cost(self, directions: Float64Array) -> float:
        """Return the mean logarithm of the errors that the network predicts under lights (F, 3),
        plus the weighted logarithm of the curl of its normals.
        """
        lights = torch.tensor(directions[self.used], dtype=torch.float32)
        with torch.no_grad(), one_thread_each():
            expected, curl, _ = self.images.judge(lights, lights.new_zeros(len(lights)))
        return _Followed(Lights(directions, directions), expected.item(), curl.item()).cost

    def descend(self, *, intensities_known: bool) -> tuple[float, float]:
        """Return by how much the cost falls under better lights near the given ones, and the mean
        angle in degrees between both.
        """
        given = self.given[self.used]
        errors = torch.full((len(given),), np.radians(_DOUBT_DEG), dtype=torch.float32)
        start = Lights(given, np.ones(len(given)))
        with one_thread_each():
            better = _follow(
                self.images,
                errors,
                start,
                intensities_known=intensities_known,
                steps=_FEW_STEPS,
                half_fall=_HALF_FALL,
            )
        moved_deg = float(angle_between_deg(better.lights.directions, given).mean())
        return self.cost(self.given) - better.cost, moved_deg


class _Followed(NamedTuple):
    lights: Lights
    expected: float
    curl: float

    @property
    def cost(self) -> float:
        return float(self.expected + _CURL * np.log(self.curl + 0.02))


@dataclass(frozen=True, eq=False)
class _Images:
    """The bright pixels of images on a coarse grid, and the neighbours of inner pixels."""

    values: Tensor  # (p, F)
    # (5, n), the indices of pixels and of their right, left, upper and lower neighbours
    neighbours: Tensor

    @classmethod
    def of(
        cls, observations: Floats, mask: Bools, used: Integers, most: int = _GRID_PIXELS
    ) -> _Images:
        step = max(1, math.isqrt(np.count_nonzero(mask) // (_AVERAGED * most)))
        # The mean of all pixels of a large capture is hardly better.
        observations, mask = thin_out(observations, mask, step)
        blocks = Blocks.over(mask, most)
        values = blocks.average(observations, mask)[:, used]
        brightest = values.max(axis=1)
        typical = np.quantile(brightest, 0.99)
        bright = brightest > 0.05 * typical
        numbers = np.full(np.add(blocks.mask.shape, 2), -1)
        numbers[1:-1, 1:-1][blocks.mask] = np.where(bright, np.cumsum(bright) - 1, -1)
        middle = numbers[1:-1, 1:-1]
        around = (
            middle,
            numbers[1:-1, 2:],
            numbers[1:-1, :-2],
            numbers[:-2, 1:-1],
            numbers[2:, 1:-1],
        )
        neighbours = np.stack([each.ravel() for each in around])
        neighbours = neighbours[:, (neighbours >= 0).all(axis=0)]
        scaled = values[bright] / max(float(typical), 1e-12)
        return cls(torch.tensor(scaled, dtype=torch.float32), torch.from_numpy(neighbours))

    def judge(self, directions: Tensor, log_intensities: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the mean logarithm of the errors that the network predicts under lights, the curl
        of its normals, and the spread of the logarithm of the resulting albedo.
        """
        observed = self.values / log_intensities.exp()
        normals, error = _network()(observed, directions)
        cosines = (normals @ directions.T).clamp(min=0)
        # Fit the albedo without shadows, and use absolute deviations because highlights are
        # outliers.
        lit = (cosines > _LEAST_COSINE).float()
        fitted = (lit * observed * cosines).sum(dim=1) / (lit * cosines**2).sum(dim=1).clamp(1e-6)
        albedo = fitted.clamp(min=1e-6).log()
        spread = (albedo - albedo.median()).abs().mean()
        return error[:, 0].mean(), self._curl(normals), spread

    def _curl(self, normals: Tensor) -> Tensor:
        if not self.neighbours.shape[1]:
            return normals.new_ones(())
        z = normals[:, 2].clamp(min=_LEAST_Z)
        slopes = -normals[:, :2] / z[:, None]
        here, right, left, above, below = self.neighbours
        p_x, q_x = (slopes[right] - slopes[left]).unbind(1)
        p_y, q_y = (slopes[above] - slopes[below]).unbind(1)
        # The square root has no gradient at zero.
        size = (p_x**2 + p_y**2 + q_x**2 + q_y**2 + 1e-8).sqrt()
        curl = ((p_y - q_x) ** 2 + 1e-8).sqrt()
        largest = size.detach().quantile(0.95)
        weights = z[here] ** 3 * (normals[here, 2] > _LEAST_Z)
        total = (weights * torch.minimum(size, largest)).sum().clamp(min=1e-6)
        return (weights * torch.minimum(curl, largest)).sum() / total


@cache
def _network() -> SplineNet:
    """Return the network that predicts the errors, in float32. Raises ModelError."""
    network = resolve_weights(DEFAULT_METHOD).network
    return network.requires_grad_(False)


def _follow(
    images: _Images,
    errors: Tensor,
    start: Lights,
    *,
    intensities_known: bool,
    steps: int = _STEPS,
    half_fall: float = 0.0,
) -> _Followed:
    """Return the best lights found by gradient descent (Adam, Kingma and Ba, ICLR 2015).

    Starting from `start`, a common matrix transforms all lights, and each light also moves slightly
    on its own.
    """
    directions = start.directions.copy()
    directions[:, 2] = directions[:, 2].clip(min=_LEAST_LIGHT_Z)
    began = torch.tensor(unit(directions), dtype=torch.float32)
    common, own = torch.zeros(3, 3, requires_grad=True), torch.zeros_like(began, requires_grad=True)
    logs = torch.tensor(np.log(start.intensities), dtype=torch.float32)
    own_logs = torch.zeros_like(logs, requires_grad=not intensities_known)
    sizes = {common: _STEP, own: _OWN_STEP}
    if not intensities_known:
        sizes[own_logs] = 2 * _OWN_STEP
    means = {each: (torch.zeros_like(each), torch.zeros_like(each)) for each in sizes}
    best, least = _Followed(start, 0.0, 1.0), np.inf
    for number in range(steps + 1):
        vectors = began @ (torch.eye(3) + common) + own
        lights = normalize(vectors, dim=1)
        relative = logs
        if not intensities_known:  # these give the same images of a matte surface
            relative = logs + own_logs + vectors.norm(dim=1).log()
            relative = relative - relative.mean()
        expected, curl, spread = images.judge(lights, relative)
        near = torch.log1p(((lights - began) / errors[:, None]).square().sum(dim=1) / 2).mean()
        near = near + 0.5 * (own_logs / _INTENSITY_SPREAD).square().mean()
        low = (_LEAST_LIGHT_Z - lights[:, 2]).clamp(min=0).square().sum()
        cost = expected + _CURL * (curl + 0.02).log() + _NEAR * near + 100 * low
        if not intensities_known:
            cost = cost + _ALBEDO * (spread + 0.05).log()
        if not number:
            first = cost.item()
        if cost.item() < least:
            least = cost.item()
            found = Lights(
                unit(lights.detach().double().numpy()), relative.detach().double().exp().numpy()
            )
            best = _Followed(found, expected.item(), curl.item())
        if number == steps // 2 and first - least < half_fall:
            break
        if number < steps:
            share = 0.53 + 0.5 * np.cos(np.pi * number / (steps + 1))
            # torch.optim takes a second to import
            gradients = torch.autograd.grad(cost, [*sizes])
            with torch.no_grad():
                for (each, size), gradient in zip(sizes.items(), gradients, strict=True):
                    mean, square = means[each]
                    mean.lerp_(gradient, 1 - _MOMENTUM)
                    square.lerp_(gradient.square(), 1 - _SQUARES)
                    typical = (square / (1 - _SQUARES ** (number + 1))).sqrt() + 1e-8
                    rate = size * share / (1 - _MOMENTUM ** (number + 1))
                    each.addcdiv_(mean, typical, value=-rate)
    return best
