"""From a Capture and an Estimator to a NormalEstimate, and the surface from which near lamps light
each pixel.

The surface determines the direction and the attenuation of each near lamp's light at each pixel. To
find it, fit normals, integrate them, move the pixels onto the surface, and fit again with the light
directions and the inverse-square falloff that the lamps have there. The surface begins as the
object's mean plane. (Logothetis et al., "A CNN based approach for the point-light photometric
stereo problem", arXiv 2210.04655, alternate in the same way.)

If the estimator has a refiner, light from other parts of the object is removed first, and the map
is refined. Pixels are processed in tiles, so that only the results grow with the capture.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from splinecli.capture import Capture
from splinecli.errors import SplinecliError
from splinecli.estimate.confidence import add_common_error, correct_errors
from splinecli.estimate.methods import Estimator, make_estimator
from splinecli.estimate.methods.estimator import TILE_PIXELS, confident_share
from splinecli.lights import lighting
from splinecli.lights.lighting import (
    IndirectLight,
    LightingAt,
    PixelIndices,
    PixelLighting,
    PixelPlaces,
    parts_of_pixels,
)
from splinecli.maths import Bools, Float32Array
from splinecli.maths.normals import AngularErrors, angular_error_map_deg, summarise_errors
from splinecli.maths.pixel_grid import Blocks, on_map, rays_at, slices
from splinecli.surface.integration import integrate_normals
from splinecli.system.machine import return_freed_memory
from splinecli.system.progress import Clock, Progress, ignore

# Larger captures are fitted at about this size: fine detail hardly moves the surface
PIXELS_ON_THE_WAY = 40_000


def find_surface(capture: Capture) -> Capture:
    """Return the capture with the points of its surface. With points already, or distant lights, it
    is unchanged.
    """
    lamps = capture.lamps
    if lamps is None or lamps.points is not None:
        return capture
    # the intermediate fit: fast, and robust against shadows and highlights
    estimator = make_estimator("iw12")
    blocks = Blocks.over(capture.mask, PIXELS_ON_THE_WAY)
    observations = blocks.average(capture.observations, capture.mask)
    depth = np.full(blocks.mask.shape, lighting.flat_depth(lamps))
    # Intermediate fits. An error of the surface only matters as a share of the distance of the
    # lamps, so few are enough.
    for _ in range(2):
        points = lighting.surface_points(lamps, *blocks.centres(), depth[blocks.mask])
        light = PixelLighting.of(observations, replace(lamps, points=points))
        normals = light.in_frame_of_capture(
            estimator.estimate(light.observations, light.directions)
        )
        depth = integrate_normals(
            on_map(normals.astype(np.float64), blocks.mask),
            blocks.mask,
            blocks.shrink_camera(lamps.camera_matrix),
        )
        if lamps.camera_matrix is None:
            depth *= blocks.step  # from blocks to pixels
    rows, columns = (places.astype(np.float64) for places in np.nonzero(capture.mask))
    points = lighting.surface_points(lamps, rows, columns, blocks.interpolate(depth, capture.mask))
    return replace(capture, lamps=replace(lamps, points=points))


@dataclass(frozen=True)
class NormalEstimate:
    """The normals of one capture, and their errors if the capture has ground truth.

    normal_map: (H, W, 3) float32, unit inside the mask and zero outside.
    seconds: time spent on the estimation.
    error_map_deg: (H, W) float32, NaN at pixels without ground truth; None if the capture has no
    ground truth. errors: summary of error_map_deg, or None.
    confidence_map: (H, W) float32, the probability that the normal is off by at most CONFIDENT_DEG;
        zero outside the mask. None if the method has no confidence.
    capture_judged: whether the confidence also covers how well the whole capture fits its lights
    and its values.
    """

    capture: Capture
    normal_map: Float32Array
    seconds: float
    error_map_deg: Float32Array | None = None
    errors: AngularErrors | None = None
    confidence_map: Float32Array | None = None
    capture_judged: bool = False

    @property
    def expected_under_5(self) -> float | None:
        """Expected share of pixels whose normals are off by at most 5 degrees; None without
        confidence.
        """
        if self.confidence_map is None:
            return None
        return float(self.confidence_map[self.capture.mask].mean())


def estimate_normals(
    capture: Capture,
    estimator: Estimator,
    *,
    progress: Progress = ignore,
    clock: Clock | None = None,
) -> NormalEstimate:
    """Estimate the normals of a capture. Under near lamps, find its surface first (see
    find_surface).

    The capture of the result has the points of this surface. `progress` is called with the number
    of pixels just finished, after each batch of the estimator. The clock times the stages that
    follow, and shows them. Raises SplinecliError if the normals are not unit vectors.

    Examples:
        >>> from splinecli.recipe import read_capture
        >>> from splinecli.estimate.inference import estimate_normals
        >>> from splinecli.estimate.methods import make_estimator
        >>> estimate = estimate_normals(read_capture("examples/medallion"), make_estimator("ls"))
        >>> round(estimate.errors.mean, 1)
        6.0
    """
    started = time.perf_counter()
    capture = find_surface(capture)
    normals, errors, judged = _estimate(capture, estimator, progress, clock or Clock())
    return_freed_memory()
    seconds = time.perf_counter() - started
    _check_unit(normals, estimator.name)
    confidence_map = None if errors is None else on_map(_confidence(errors), capture.mask)
    del errors
    normal_map = on_map(normals, capture.mask)
    del normals
    error_map = summary = None
    if capture.ground_truth is not None:
        error_map = angular_error_map_deg(normal_map, capture.ground_truth, capture.mask)
        summary = summarise_errors(error_map)
    return NormalEstimate(capture, normal_map, seconds, error_map, summary, confidence_map, judged)


def _estimate(
    capture: Capture, estimator: Estimator, progress: Progress, clock: Clock
) -> tuple[Float32Array, Float32Array | None, bool]:
    """Return the normals (P, 3), the distributions (P, 2) of their errors, and whether these cover
    the whole capture.

    Methods without confidence have no distributions.
    """
    found = estimate_pixels(
        capture.mask, capture.observations, lighting_on(capture), estimator, progress, clock
    )
    normals, errors, lighting_at = found
    if errors is None:
        return normals, None, False
    if estimator.refiner is not None:
        advance = clock.begin("refine", capture.n_pixels, "refining")
        estimator.refiner.refine(
            capture.mask, capture.observations, lighting_at, normals, errors, progress=advance
        )
    judged = correct_errors(capture, estimator, lighting_at, normals, errors)
    of_lights = (
        () if capture.light_errors_deg is None else (float(capture.light_errors_deg.mean()),)
    )
    for error_deg in (*of_lights, *(warning.error_deg for warning in capture.warnings)):
        if error_deg:
            add_common_error(errors, error_deg)
    return normals, errors, judged


# Indirect light is found from the normals of every fourth pixel, if these are not too few
_GATHER_STEP, _FEWEST_GATHERED = 4, 10_000
# The most numbers, observations and directions, that an estimator gets at once
_TILE_VALUES = 1 << 24


class PixelEstimates(NamedTuple):
    """The results of an estimator, before refinement.

    normals: (P, 3) float32, unit, in the capture's frame.
    errors: (P, 2) float32, the distributions of their errors; None for methods without confidence.
    lighting_at: the light of the pixels as used for the last estimate: without indirect light where
    that was removed.
    """

    normals: Float32Array
    errors: Float32Array | None
    lighting_at: LightingAt


def estimate_pixels(
    mask: Bools,
    observations: Float32Array,
    lighting_without: Callable[[IndirectLight | None, PixelIndices], PixelLighting],
    estimator: Estimator,
    progress: Progress = ignore,
    clock: Clock | None = None,
) -> PixelEstimates:
    """Estimate the normals of a capture's pixels. Where indirect light matters, it is removed
    first.

    Only the networks with a refiner remove indirect light. The refinement net also learns from
    these estimates.

    Args:
        mask: (H, W), with P true pixels.
        observations: (P, F), as they were photographed.
        lighting_without: gives the light of some pixels without the given indirect light; None
            removes nothing.
        progress, clock: see estimate_normals.
    """
    clock, n_pixels = clock or Clock(), len(observations)
    # NaN reveals the use of normals that have not been estimated.
    normals = np.full((n_pixels, 3), np.nan, np.float32)
    errors = np.empty((n_pixels, 2), np.float32) if estimator.has_confidence else None

    def estimate(
        estimator: Estimator,
        pixels: PixelIndices,
        lighting_at: LightingAt,
        progress: Progress = ignore,
    ) -> None:
        if not len(pixels):
            return
        light = lighting_at(pixels)
        found, of_pixels = estimator.estimate_with_error(
            light.observations, light.directions, progress=progress
        )
        if errors is not None:
            errors[pixels] = of_pixels
        normals[pixels] = light.in_frame_of_capture(found)

    lighting_at = partial(lighting_without, None)
    refiner = estimator.refiner
    # Directions that differ from pixel to pixel are computed in float64.
    each = 1 if lighting_at(np.arange(1)).directions.ndim == 2 else 10
    tile_pixels = min(
        estimator.tile_pixels, max(TILE_PIXELS, _TILE_VALUES // (each * observations.shape[1]))
    )
    bound = estimator.bind(lighting_at, mask)
    if refiner is None or errors is None:
        for pixels in parts_of_pixels(n_pixels, tile_pixels):
            estimate(bound, pixels, lighting_at, progress)
        return PixelEstimates(normals, errors, lighting_at)
    step = max(1, min(_GATHER_STEP, n_pixels // _FEWEST_GATHERED))
    for pixels in parts_of_pixels(n_pixels, tile_pixels, step=step):
        estimate(bound, pixels, lighting_at, progress)
    advance = clock.begin("indirect_light", n_pixels, "removing indirect light")
    direct = lighting_at
    indirect = lighting.find_indirect_light(mask, observations, direct, normals, known=step)
    if indirect is not None:
        lighting_at = partial(lighting_without, indirect)
        # The other pixels keep their first estimates: estimating all again gained 0.02 degrees.
        without = estimator.rebind(lighting_at, mask)
    for pixels in parts_of_pixels(n_pixels, tile_pixels):
        left = pixels % step > 0
        if indirect is not None:
            changed = indirect.counts_at(observations[pixels], pixels)
            estimate(without, pixels[changed], lighting_at)
            left &= ~changed
        estimate(bound, pixels[left], direct, progress)
        advance(len(pixels))
    return PixelEstimates(normals, errors, lighting_at)


def lighting_on(capture: Capture) -> Callable[[IndirectLight | None, PixelIndices], PixelLighting]:
    """Return a function for the light of some of a capture's pixels: see `lighting_without` of
    estimate_pixels.
    """
    places = PixelPlaces(capture.mask)

    def lighting_without(indirect: IndirectLight | None, pixels: PixelIndices) -> PixelLighting:
        observations = capture.observations[pixels]
        if indirect is not None:
            observations = indirect.remove(observations, pixels)
        if capture.lamps is not None:
            return PixelLighting.of(observations, capture.lamps.choose_pixels(pixels))
        if capture.camera_matrix is None:
            return PixelLighting(observations, capture.light_directions)
        rays = rays_at(*places.places(pixels), capture.camera_matrix)
        return PixelLighting.distant(observations, capture.light_directions, rays)

    return lighting_without


def _confidence(errors: Float32Array) -> Float32Array:
    """Return the confidence (P,) from distributions of errors (P, 2), without further arrays of
    their size.
    """
    found = np.empty(len(errors), np.float32)
    for part in slices(len(errors), TILE_PIXELS):
        found[part] = confident_share(errors[part])
    return found


def _check_unit(normals: Float32Array, method: str) -> None:
    # A zero normal would have an error of 0 degrees, and NaN would be left out of the mean.
    for part in slices(len(normals), TILE_PIXELS):
        length = np.linalg.norm(normals[part], axis=1)
        # Accepts float16 and bfloat16, and rejects zero vectors and NaN.
        if not (np.abs(length - 1) <= 1e-2).all():
            raise SplinecliError(f"method {method} gave normals that are not unit vectors")
