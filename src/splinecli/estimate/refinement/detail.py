"""Detail that the refinement net smooths away although it is real.

The net relies on the errors that SPLINE-Net predicts. Many of these are the same everywhere, for
example those from wrong light intensities, and contain no information about detail. Real detail
agrees between two halves of the lights; noise does not.

A capture at half the resolution, and its results at the full one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from splinecli.estimate.networks.refine_net import Box, gaussian_sum, reach_of, unit_maps
from splinecli.estimate.refinement.tiles import pixels_before
from splinecli.lights.lighting import LIT_AT_ONCE, LightingAt, PixelIndices, PixelLighting
from splinecli.maths import Array, Bools, Float32Array
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import on_map
from splinecli.system.machine import side_by_side

# Weight of a pixel that is dark under every light, relative to lit ones of the capture's brightness
_DARK = 1e-6


@dataclass(frozen=True, eq=False)
class HalfCapture:
    """A capture of half the size: each pixel is the mean of the masked ones in a block of 2 x 2 of
    another capture.
    """

    mask: Bools  # (H / 2, W / 2), with Q true pixels
    observations: Float32Array  # (Q, F)
    normals: Float32Array  # (Q, 3), unit, in the capture's frame
    errors: Float32Array  # (Q, 2)
    # (Q,), the row in the other capture of one pixel of each block, whose lights hold for it
    members: PixelIndices
    whole: LightingAt  # gives the light of the other capture's pixels

    @classmethod
    def of(
        cls,
        mask: Bools,
        lighting_at: LightingAt,
        normals: Float32Array,
        errors: Float32Array,
        reference: float,
    ) -> HalfCapture:
        """Return half of a capture with a mask (H, W), both even, of P true pixels, and the
        brightness `reference`.

        `lighting_at` gives the observations and light directions of some pixels. The normals (P, 3)
        and errors (P, 2) are in the capture's frame.
        """
        half = _over_blocks(np.logical_or, mask)
        rows_above, done_above = pixels_before(mask), pixels_before(half)
        n_half, n_lights = int(done_above[-1]), lighting_at(np.arange(1)).observations.shape[1]
        values, of_normals, of_errors = (
            np.empty((n_half, columns), np.float32) for columns in (n_lights, 3, 2)
        )
        small = cls(half, values, of_normals, of_errors, np.empty(n_half, np.int32), lighting_at)
        step = max(1, LIT_AT_ONCE // (2 * mask.shape[1]))  # rows of blocks

        def halve(first: int) -> None:
            last = min(first + step, len(half))
            seen, kept = mask[2 * first : 2 * last], half[first:last]
            rows = np.arange(rows_above[2 * first], rows_above[2 * last], dtype=np.int32)
            if not len(rows):
                return
            observations = lighting_at(rows).observations
            largest = torch.from_numpy(observations).amax(dim=1, keepdim=True).numpy()
            equal = np.where(largest > 0, np.float32(1), np.float32(_DARK))
            # In a block, the observations depend mostly on the normals of its brightest pixels.
            weights = np.maximum(largest, np.float32(_DARK * reference))
            found = np.hstack((normals[rows], errors[rows])) * weights
            sent = np.hstack((observations * equal, equal, found, weights))
            sums = _over_blocks(np.add, on_map(sent, seen))[kept]
            done = slice(done_above[first], done_above[last])
            small.observations[done] = sums[:, :-7] / sums[:, -7:-6]
            small.normals[done] = unit(sums[:, -6:-3])
            small.errors[done] = sums[:, -3:-1] / sums[:, -1:]
            small.members[done] = _over_blocks(np.maximum, on_map(rows, seen))[kept]

        for _ in side_by_side(halve, range(0, len(half), step)):
            pass
        return small

    def lighting_at(self, rows: PixelIndices) -> PixelLighting:
        """Return the observations and light directions of some pixels."""
        return replace(self.whole(self.members[rows]), observations=self.observations[rows])

    def enlarged(self, box: Box) -> tuple[torch.Tensor, torch.Tensor]:
        """Return normals (3, h, w), not of unit length, and errors (2, h, w) in a box of the other
        capture's map.

        They are interpolated bilinearly between pixels of the mask. The box is between even rows
        and columns.
        """
        rows, columns = (slice(max(0, side.start // 2 - 1), side.stop // 2 + 1) for side in box)
        mask = self.mask[rows]
        numbers = mask.cumsum(dtype=np.int32).reshape(mask.shape) + (
            np.count_nonzero(self.mask[: rows.start]) - 1
        )
        mask, numbers = mask[:, columns], numbers[:, columns]
        some = numbers[mask]
        values = np.hstack((self.normals[some], self.errors[some]))
        maps = enlarge(
            torch.from_numpy(on_map(values, mask)).permute(2, 0, 1), torch.from_numpy(mask)
        )
        top, left = box[0].start - 2 * rows.start, box[1].start - 2 * columns.start
        maps = maps[
            :, top : top + box[0].stop - box[0].start, left : left + box[1].stop - box[1].start
        ]
        return maps[:3], maps[3:]


def enlarge(maps: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return maps (C, h, w) at twice the resolution, interpolated bilinearly between the pixels of
    a mask (h, w).
    """
    weights = mask.to(maps)[None]
    weighed = torch.cat((maps * weights, weights))[None]
    found = interpolate(weighed, scale_factor=2, mode="bilinear")[0]
    return found[:-1].div_(found[-1:].clamp_(min=1e-6))


def _over_blocks(function: np.ufunc, values: Array) -> Array:
    """Return a function of the four values (H, W, ...) in each block of 2 x 2, (H / 2, W / 2,
    ...).
    """
    rows = function(values[::2], values[1::2])
    return np.asarray(function(rows[:, ::2], rows[:, 1::2]))


FINE = 1.5  # detail is the part that a Gaussian filter with this sigma in pixels removes
WINDOW = 3.0  # detail is compared in a Gaussian window with this sigma in pixels
DETAIL_REACH = reach_of(FINE) + reach_of(WINDOW)  # no pixel further away than this changes a result
FEWEST_FOR_DETAIL = 6  # fewer have no residuals, or hardly any, and so do not show noise well
_TINY = 1e-12


def restore_detail(
    refined: Tensor, estimated: Tensor, least_squares: Tensor, noise: Tensor, mask: Tensor
) -> Tensor:
    """Add detail to refined normals that the refinement net removed although it is real.

    The detail comes from SPLINE-Net's normals. It is considered real where the additional detail of
    least squares is clearly larger than its noise, and to the extent that both agree. Images that
    are shifted towards their lights, by half a pixel for example, have the same effect as detail.

    All normals (3, H, W) are unit. The least squares had at least FEWEST_LIGHTS lights, and the
    noise (1, H, W) is theirs; see fits/least_squares.py. The mask (1, H, W) is 1 inside, else 0,
    and the other maps are zero outside, as is the result. Black pixels are left unchanged.
    """
    mask = mask * least_squares.any(dim=0)  # black pixels carry no information
    removed, missing, noise = (
        _detail(maps, mask) for maps in (estimated - refined, least_squares - refined, noise)
    )
    alike = (
        _energy(removed, missing) / (_energy(removed, removed) * _energy(missing, missing)).sqrt()
    )
    return unit_maps(refined + _real_share(missing, noise) * alike * removed)


def restore_octave(
    enlarged: Tensor,
    estimated: Tensor,
    least_squares: Tensor,
    noise: Tensor,
    largest: Tensor,
    mask: Tensor,
) -> Tensor:
    """Add detail to normals from half the resolution, taken from SPLINE-Net's normals where it is
    real.

    Detail is the part of the normals that is lost when they are halved, as by HalfCapture, and
    enlarged again (Burt and Adelson, The Laplacian pyramid as a compact image code, 1983). It is
    considered real where the detail of least squares is clearly larger than its noise. Bright
    pixels get more weight than dark ones, by their largest observation (1, H, W).

    The enlarged normals (3, H, W) are unit, as is the result, which is zero outside the mask. See
    restore_detail for the other arguments. The maps begin at even rows and columns.
    """
    mask = mask * least_squares.any(dim=0)
    largest = largest * mask
    halved = _without_octave(torch.cat((estimated, least_squares, noise)), largest)
    of_estimated, of_least_squares, of_noise = torch.split(halved, [3, 3, 1])
    detail = (estimated - unit_maps(of_estimated)).mul_(mask)
    missing = (least_squares - unit_maps(of_least_squares)).mul_(largest)
    noise = (noise - of_noise).mul_(largest)
    return unit_maps(detail.mul_(_real_share(missing, noise)).add_(enlarged))


def _real_share(missing: Tensor, noise: Tensor) -> Tensor:
    """Return the share (H, W) of missing detail (3, H, W) to restore, given the noise (1, H, W) in
    it.
    """
    real = 1 - _energy(noise, noise) / _energy(missing, missing)
    # Nothing is restored below 0.7, and everything above 0.9.
    return ((real - 0.7) / (0.9 - 0.7)).clamp(0, 1)


def _energy(one: Tensor, other: Tensor) -> Tensor:
    return gaussian_sum((one * other).sum(dim=0), WINDOW).clamp(min=_TINY)


def _detail(maps: Tensor, mask: Tensor) -> Tensor:
    """Return the detail of maps (C, H, W), zero outside the mask, whatever they are there."""
    maps = maps * mask
    return maps - gaussian_sum(maps, FINE) / gaussian_sum(mask, FINE).clamp(min=_TINY) * mask


def _without_octave(maps: Tensor, weights: Tensor) -> Tensor:
    """Return maps (C, H, W) after weighted means of 2 x 2 pixels, enlarged again."""
    height, width = maps.shape[-2:]
    sums = avg_pool2d(torch.cat((maps * weights, weights))[None], 2, ceil_mode=True)[0]
    return enlarge(sums[:-1] / sums[-1:].clamp(min=_TINY), sums[-1] > 0)[:, :height, :width]
