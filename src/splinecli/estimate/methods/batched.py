"""Estimators in torch that process pixels in batches: fits of reflectance models, SPLINE-Net and
CNN-PS.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.errors import UsageError
from splinecli.estimate.methods.estimator import (
    TOWARDS_CAMERA,
    UNKNOWN_ERROR,
    Directions,
    Estimator,
    ObservationMaps,
    Observations,
    directions_at,
)
from splinecli.estimate.networks.set_branch import SAMPLE, CaptureContext, sample_of
from splinecli.estimate.networks.spline_net import Rotation
from splinecli.estimate.networks.weights import LoadedNetwork, untrained_warning
from splinecli.estimate.refinement.refiner import NetworkRefiner
from splinecli.lights.lighting import LightingAt, PixelIndices, PixelLighting, PixelPlaces
from splinecli.maths import Bools, Float32Array, Float64Array, Floats
from splinecli.maths.observation_map import map_scale, rotate_about_view_axis, sparse_map
from splinecli.maths.pixel_grid import slices
from splinecli.system.machine import NumberFormat, one_thread_each, side_by_side
from splinecli.system.progress import Progress, ignore

Solve = Callable[[Tensor, Tensor], Tensor]
"""Function from observations (P, F), with a largest value of 1 per pixel, and light directions
(F, 3) or (P, F, 3) to normals (P, 3).

The normals may have any length; a zero vector means that a pixel has no normal. All observations
are finite and non-negative.
"""


_FEWEST_BATCHES, _FEWEST_AT_ONCE = 8, 256  # pixels; smaller batches take more time per pixel


class _InBatches(Estimator):
    """An estimator that splits the pixels into batches of at most `batch_size`."""

    batch_size: int
    _dtype = torch.float32

    def _solve_all(
        self,
        solve: Solve,
        observations: Observations,
        light_directions: Directions,
        progress: Progress,
        columns: int = 3,
    ) -> Float32Array:
        """Return the results (P, columns) of `solve`, called on batches in parallel.

        `solve` receives unscaled observations and returns unit normals in its first three columns;
        zero vectors are replaced with (0, 0, 1). `progress` is called after each batch with its
        number of pixels.
        """
        results = np.empty((len(observations), columns), np.float32)
        size = self.batch_size
        if self.device == "cpu":
            # Few pixels are split into several smaller batches, regardless of the number of cores,
            # so that no core waits for another.
            size = min(size, max(_FEWEST_AT_ONCE, -(-len(observations) // _FEWEST_BATCHES)))

        def solve_batch(rows: slice) -> int:
            batch, lights = (
                torch.as_tensor(values, dtype=self._dtype, device=self.device)
                for values in (observations[rows], directions_at(light_directions, rows))
            )
            solved = solve(batch, lights)
            solved[~solved[:, :3].any(dim=1), :3] = solved.new_tensor(TOWARDS_CAMERA)
            results[rows] = solved.cpu().numpy()
            return len(batch)

        for count in side_by_side(solve_batch, slices(len(observations), size)):
            progress(count)
        return results


class BatchedEstimator(_InBatches):
    """An estimator that calls `solve` on batches of pixels in float64.

    Each pixel is first divided by its largest observation, so that thresholds and priors have the
    same meaning for dark and bright pixels, and the scale of the images does not matter. Raises
    UsageError for a batch size below 1.
    """

    _dtype = torch.float64

    def __init__(self, name: str, solve: Solve, device: str, batch_size: int) -> None:
        if batch_size < 1:
            raise UsageError("the batch size must be a whole number of at least 1")
        self.name, self.device, self.batch_size, self._solve = name, device, batch_size, solve
        self.fingerprint = f"{name} {self.precision}"

    def estimate(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> Float32Array:
        """Estimate unit normals (P, 3) from observations (P, F) under lights (F, 3) or (P, F, 3);
        see Estimator.
        """

        def solve_scaled(batch: Tensor, lights: Tensor) -> Tensor:
            batch = batch.clamp(min=0)
            normals = self._solve(batch / map_scale(batch), lights)
            # Divide in two steps, because normalize would treat a vector of tiny length as zero.
            largest = normals.abs().amax(dim=1, keepdim=True).clamp(min=1e-300)
            return normalize(normals / largest, dim=1)

        return self._solve_all(solve_scaled, observations, light_directions, progress)


_CANDIDATES = 4096  # pixels among which the context of a capture is chosen
_FEWEST_COVERED = 64  # if fewer candidates are fully covered, all are used
# Smallest brightness of a fully covered outline pixel, relative to the mean of its inner neighbours
_COVERED = 0.85


def context_sample(lighting_at: LightingAt, mask: Bools) -> tuple[Tensor, Tensor]:
    """Return the observations (S, F) and light directions, (F, 3) or (S, F, 3), of a sample of a
    capture's pixels.

    The mask (H, W) has at least one true pixel. Outline pixels that the object covers only
    partially are excluded, because they are too dark: on rendered spheres of 40 pixels, they
    doubled the error of the other pixels. On small objects, this also excludes some steep pixels
    that are fully covered. It only works if the mask ends at the object's outline.
    """
    n_pixels = int(np.count_nonzero(mask))
    candidates = np.linspace(0, n_pixels - 1, min(n_pixels, _CANDIDATES)).astype(np.intp)
    light = lighting_at(candidates)
    covered = np.flatnonzero(
        _is_covered(candidates, light.observations.max(axis=1), mask, lighting_at)
    )
    if len(covered) < _FEWEST_COVERED:
        covered = np.arange(len(candidates))
    pixels = covered[sample_of(light.observations[covered])]
    observations, directions = float_tensors(
        light.observations[pixels], directions_at(light.directions, pixels)
    )
    return observations, directions


def _is_covered(
    pixels: PixelIndices, brightest: Floats, mask: Bools, lighting_at: LightingAt
) -> Bools:
    """Return which pixels (n,), whose largest observations are `brightest`, seem to be fully
    covered.
    """
    from cv2 import erode

    covered = np.ones(len(pixels), np.bool_)
    # The object continues beyond the border of the image.
    inner = erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rows, columns = PixelPlaces(mask).places(pixels)
    at_outline = np.flatnonzero(~inner[rows, columns])
    near = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2) + 1
    rows, columns = (np.stack((rows, columns), axis=1)[at_outline, None] + near).transpose(2, 0, 1)
    is_inner = np.pad(inner, 1)[rows, columns]
    if not is_inner.any():
        return covered
    numbers = np.cumsum(mask, dtype=np.int32).reshape(mask.shape) - 1
    known, places = np.unique(
        numbers[rows[is_inner] - 1, columns[is_inner] - 1], return_inverse=True
    )
    of_inner = np.zeros(is_inner.shape)
    of_inner[is_inner] = lighting_at(known).observations.max(axis=1)[places]
    covered[at_outline] = brightest[at_outline] * is_inner.sum(axis=1) >= _COVERED * of_inner.sum(
        axis=1
    )
    return covered


def float_tensors(*arrays: Floats) -> tuple[Tensor, ...]:
    """Return float32 tensors of arrays, copied if necessary, because tensors do not accept negative
    strides.
    """
    return tuple(torch.from_numpy(np.ascontiguousarray(values, np.float32)) for values in arrays)


ROTATION_SPAN_DEG = 20.0
"""Range of the rotations for a network with a canonical azimuth. Training used up to 15 degrees in
either direction.
"""


class NetworkEstimator(_InBatches):
    """LI-Net followed by NE-Net (for CNN-PS, NE-Net alone) on batches of pixels.

    `name` is the method's name in the registry, `precision` the number format of the convolutions,
    and `rotations` the number of estimates that are averaged (see `rotations_of`). With `refines`,
    the map is then corrected by the refinement net, if the weights include one. Memory grows with
    the batch size, by about 0.25 MB per pixel. Raises UsageError if rotations or batch_size is
    below 1.
    """

    def __init__(
        self,
        name: str,
        loaded: LoadedNetwork,
        *,
        device: torch.device | str = "cpu",
        precision: NumberFormat = "bfloat16",
        refines: bool = True,
        rotations: int = 1,
        batch_size: int = 1024,
    ) -> None:
        if rotations < 1 or batch_size < 1:
            raise UsageError("rotations and the batch size must be whole numbers of at least 1")
        self.name = name
        self.weights: dict[str, str] = {"name": loaded.name, "sha256": loaded.sha256}
        self.device, self.precision, self.batch_size = str(device), str(precision), batch_size
        self.network = loaded.network.to(device)
        self.has_confidence = self.network.config.error_head
        refine_net = self.network.refine_net
        if refines and refine_net is not None:
            self.refiner = NetworkRefiner(refine_net, self.precision)
        self.needs_capture = self.refiner is not None or self.network.config.sees_capture
        self.fingerprint = f"{name} {loaded.sha256} {precision} {rotations} views"
        if self.network.config.sees_capture:
            # In earlier versions, contexts were smaller, included all pixels of the outline, and
            # were shared by all rotations.
            self.fingerprint += f" with a context of up to {SAMPLE} pixels, outline {_COVERED}"
        if self.refiner is not None:
            self.fingerprint += (
                f", without indirect light, refined in {self.refiner.turns} turns, halved, with"
                " detail"
            )
        self._rotations = rotations_of(rotations, canonical=loaded.network.config.is_canonical)
        self._contexts: list[CaptureContext | None] = [
            None
        ] * rotations  # the capture's context for each rotation

    @torch.no_grad()
    def bind(self, lighting_at: LightingAt, mask: Bools) -> NetworkEstimator:
        """Return this estimator with the context of one capture, computed from a sample of its
        pixels; see Estimator.

        Without it, each call of `estimate` treats its pixels as a separate capture.
        """
        if not self.network.config.sees_capture or not mask.any():
            return self
        sample, lights = (values.to(self.device) for values in context_sample(lighting_at, mask))
        found = copy.copy(self)
        # Use one thread, so that the number of threads does not affect rounding.
        bfloat16 = torch.autocast(
            lights.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"
        )
        with one_thread_each(), bfloat16:
            found._contexts = [
                self.network.encode_context(sample, lights, rotation)
                for rotation in self._rotations
            ]
        return found

    def estimate_with_error(
        self,
        observations: Observations,
        light_directions: Directions,
        *,
        progress: Progress = ignore,
    ) -> tuple[Float32Array, Float32Array]:
        """Estimate unit normals (P, 3) and the distributions (P, 2) of their errors; see Estimator.

        The parameters of the distributions are averaged over the rotations. They are 0 if the
        network has no error head.
        """
        if self._contexts[0] is None and self.network.config.sees_capture and len(observations):

            def lighting_at(pixels: PixelIndices) -> PixelLighting:
                return PixelLighting(observations[pixels], directions_at(light_directions, pixels))

            alone = self.bind(lighting_at, np.ones((1, len(observations)), np.bool_))
            return alone.estimate_with_error(observations, light_directions, progress=progress)
        results = self._solve_all(
            self._average_rotations, observations, light_directions, progress, columns=5
        )
        return results[:, :3], results[:, 3:]

    def _average_rotations(self, batch: Tensor, lights: Tensor) -> Tensor:
        """Return normals and the distributions of their errors (P, 5), which are 0 without an error
        head.
        """
        total = batch.new_zeros(len(batch), 5)
        with torch.autocast(
            lights.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"
        ):
            for rotation, context in zip(self._rotations, self._contexts, strict=True):
                normals, error = self.network(batch, lights, rotation=rotation, context=context)
                total[:, :3] += normals
                if error is not None:
                    total[:, 3:] += error
        unit = normalize(total[:, :3], dim=-1)
        averaged = torch.cat((unit, total[:, 3:] / len(self._rotations)), dim=1)
        dark = batch.amax(dim=1) <= 0
        averaged[dark] = averaged.new_tensor((0.0, 0.0, 0.0, *UNKNOWN_ERROR))
        return averaged

    @torch.inference_mode()
    def observation_maps(
        self,
        observations: Observations,
        light_directions: Directions,
        all_observations: Observations,
        all_directions: Float64Array,
    ) -> ObservationMaps | None:
        """Return the network's input, the output of LI-Net, and the maps of all observations; see
        Estimator.
        """
        network, config = self.network, self.network.config
        seen, lights, all_seen, all_lights = (
            torch.as_tensor(values, dtype=torch.float32, device=self.device)
            for values in (observations, light_directions, all_observations, all_directions)
        )
        maps = network.build_maps(seen, lights)
        dense = network.interpolate(maps)
        if dense is None:
            return None
        all_lights = all_lights.expand(len(observations), -1, 3)
        turned = rotate_about_view_axis(all_lights, maps.cosine[:, None], maps.sine[:, None])
        values = all_seen / maps.scale
        every = sparse_map(values, turned, size=config.map_size, grid=config.grid)

        def known(values: Tensor, occupied: Tensor) -> Float32Array:
            return np.asarray(
                values.masked_fill(occupied == 0, torch.nan)[:, 0].cpu().numpy(), np.float32
            )

        inside = network.inside.expand_as(dense)
        of_all = known(every.values, every.occupied)
        return ObservationMaps(
            known(maps.sparse, maps.occupied), known(dense, inside), of_all, config.grid
        )

    def warn_of_lights(self, n_lights: int) -> list[str]:
        """Return a warning if the weights were not trained for this number of lights."""
        return untrained_warning(self.weights["sha256"], n_lights)


def rotations_of(count: int, *, canonical: bool) -> list[Rotation]:
    """Return `count` rotations of the lights about the view axis.

    Without a canonical azimuth, a network uses the angles 360 k / count, as in CNN-PS. They would
    have no effect on a network with a canonical azimuth, which instead uses small angles within
    ROTATION_SPAN_DEG that move lights across the borders of cells, and each angle again with
    mirrored lights.
    """
    if not canonical:
        return [Rotation(360.0 * k / count) for k in range(count)]
    turns = (count + 1) // 2
    span = ROTATION_SPAN_DEG if turns > 1 else 0.0
    step = span / max(turns - 1, 1)
    return [Rotation(step * (k // 2) - span / 2, mirror=k % 2 == 1) for k in range(count)]
