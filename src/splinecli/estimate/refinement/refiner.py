"""The refinement nets on a whole capture: in tiles, and on large captures at a lower resolution.

The nets were trained on objects of a hundred to three hundred pixels a side. On larger maps, their
receptive field covers less of the object, and their results are worse. So a large capture is halved
until it has about the size of the training objects, and then enlarged octave by octave, with the
detail that is real; see detail.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
import torch

from splinecli.estimate.fits.least_squares import alternating_signs
from splinecli.estimate.networks.refine_net import (
    COARSEST,
    FEATURE_CHANNELS,
    Box,
    RefineNet,
    channels,
    unit_maps,
)
from splinecli.estimate.refinement.detail import (
    DETAIL_REACH,
    FEWEST_FOR_DETAIL,
    HalfCapture,
    restore_detail,
    restore_octave,
)
from splinecli.estimate.refinement.features import (
    MapTurn,
    brightness,
    refine_features,
    turn_features,
    turn_maps,
    two_halves,
)
from splinecli.estimate.refinement.tiles import (
    Band,
    Tile,
    around_object,
    rows_of_tiles,
    turned_part,
)
from splinecli.lights.lighting import LIT_AT_ONCE, LightingAt, PixelIndices, PixelLighting
from splinecli.maths import Array, Bools, Float32Array
from splinecli.maths.observation_map import map_scale
from splinecli.maths.pixel_grid import slices
from splinecli.system.machine import return_freed_memory, side_by_side
from splinecli.system.progress import Progress, ignore

# Pixels around a tile that the nets use as context, a multiple of COARSEST. Two nets reach further
# (RefineNet's `reach`), but context beyond the margin changes no normal by more than 0.01 degrees.
# A margin of 64, which is enough for one net, leaves visible seams with two.
MARGIN = 112
# Side of the part of the map that is refined at once, a multiple of COARSEST, without its margin.
# Larger tiles take less time, because their margins are smaller in total, but more memory.
TILE = 512

MOST_PIXELS = 150_000  # the most pixels of a capture that the net processes at full resolution

_DETAIL_MARGIN = -(-DETAIL_REACH // COARSEST) * COARSEST

Maps = tuple[torch.Tensor, torch.Tensor]


@dataclass(frozen=True, eq=False)
class _Capture:
    """A capture to be refined, or a half of one."""

    mask: Bools  # (H, W), with P true pixels
    observations: Float32Array  # (P, F)
    lighting_at: LightingAt  # gives the light of some pixels
    normals: Float32Array  # (P, 3), replaced, as are the errors (P, 2)
    errors: Float32Array
    reference: float  # reference, signs: of the whole capture; see refine_features
    signs: torch.Tensor


@dataclass(eq=False)
class NetworkRefiner:
    """Corrects a capture's normals, and the distributions of their errors, using the neighbourhood
    of each pixel.

    The network is one refinement net or two, on their device, and `precision` the number format of
    the convolutions. The results of `turns` quarter turns of the map are averaged; adding mirror
    images does not help. With a margin of the net's `reach`, tiles change nothing. Captures of
    fewer than FEWEST_LIGHTS do not show which detail is real, so the net processes their maps at
    full resolution: more than MOST_PIXELS, but once instead of in all turns.
    """

    network: RefineNet
    precision: str
    _: KW_ONLY
    turns: int = 4
    tile: int = TILE
    margin: int = MARGIN
    most_pixels: int = MOST_PIXELS

    def __post_init__(self) -> None:
        assert self.tile % COARSEST == 0 == self.margin % COARSEST
        assert self.tile >= self.margin, "the margin of a tile must be within its neighbours"

    @torch.inference_mode()
    def refine(
        self,
        mask: Bools,
        observations: Float32Array,
        lighting_at: LightingAt,
        normals: Float32Array,
        errors: Float32Array,
        *,
        progress: Progress = ignore,
    ) -> None:
        """Refine normals (P, 3) and the distributions (P, 2) of their errors in place.

        They are the estimator's, in the capture's frame; see networks/li_ne_net.py for the
        distributions. A pixel that is dark under every light is left unchanged. The mask (H, W) has
        P true pixels. Only the brightness of the observations (P, F) is used here: `lighting_at`
        gives the observations and the light directions of some pixels. `progress` is called after
        each tile with the number of its pixels.
        """
        middle = lighting_at(np.array([len(normals) // 2])).directions  # the lights at one pixel
        capture = _Capture(
            around_object(mask),
            observations,
            lighting_at,
            normals,
            errors,
            brightness(torch.from_numpy(observations)),
            alternating_signs(self._tensor(middle).view(-1, 3)),
        )
        self._refine(capture, progress)

    def _refine(self, capture: _Capture, progress: Progress = ignore) -> None:
        half, turns, margin = None, self.turns, self.margin
        whole = capture.normals, capture.errors
        if len(capture.normals) > self.most_pixels:
            turns = 1
            if len(capture.signs) >= FEWEST_FOR_DETAIL:
                half = HalfCapture.of(capture.mask, capture.lighting_at, *whole, capture.reference)
                margin = _DETAIL_MARGIN
                smaller = replace(
                    capture,
                    mask=around_object(half.mask),
                    observations=half.observations,
                    lighting_at=half.lighting_at,
                    normals=half.normals,
                    errors=half.errors,
                )
                self._refine(smaller)
        # NumPy takes ten times as long.
        lit = (torch.from_numpy(capture.observations).amax(dim=1) > 0).numpy()
        above = Band(slice(0, 0), *whole)

        def refine(tile: Tile) -> tuple[PixelIndices, Float32Array, Float32Array]:
            inside = tile.mask[tile.inner]
            own = tile.rows[tile.inner][inside]
            seen, inner = _with_neighbours(tile.inner, tile.mask.shape)
            maps = (
                self._see(capture, tile, seen, turns)
                if half is None
                else self._enlarge(capture, tile, seen, half)
            )
            refined, errors = (
                values[:, *inner].permute(1, 2, 0).cpu().numpy()[inside] for values in maps
            )
            _turn_back(refined, own, capture.lighting_at)
            return own, refined, errors

        # The net's layers are large enough for all cores.
        run = map if half is None else side_by_side
        for pixels, tiles in rows_of_tiles(capture.mask, self.tile, margin):
            return_freed_memory()  # the freed memory of the tiles above is fragmented
            band = Band(pixels, *whole)
            for own, refined, errors in run(refine, tiles):
                # Nothing is known of a pixel that is dark under every light.
                known = lit[own]
                band.put(own[known], refined[known], errors[known])
                progress(len(own))
            # These tiles needed the pixels above as they were. The tiles below need these tiles'
            # pixels.
            above.write()
            above = band
        above.write()

    def _see(self, capture: _Capture, tile: Tile, seen: Box, turns: int) -> Maps:
        """Return the net's normals (3, h, w) and errors (2, h, w) in a part of a tile, averaged
        over rotations.
        """

        def features_of(rows: PixelIndices, light: PixelLighting, _: slice) -> torch.Tensor:
            return refine_features(
                self._tensor(light.observations),
                self._tensor(light.directions),
                self._tensor(light.in_frame_of_pixels(capture.normals[rows])),
                self._tensor(capture.errors[rows]),
                capture.reference,
                capture.signs,
            )

        # With one thread for each part, the results do not depend on the number of threads.
        run = side_by_side if self._device.type == "cpu" else map
        features = self._maps(tile, FEATURE_CHANNELS, capture.lighting_at, features_of, run)
        mask = self._tensor(tile.mask)[None]
        normals, errors = self._average_turns(features, mask, seen, turns)
        if len(capture.signs) >= FEWEST_FOR_DETAIL:
            features = features[:, *seen]
            estimated = features[channels("normal")]
            least_squares = estimated + features[channels("plain")]
            normals = restore_detail(
                normals, estimated, least_squares, features[channels("noise")], mask[:, *seen]
            )
        return normals, errors

    def _enlarge(self, capture: _Capture, tile: Tile, seen: Box, half: HalfCapture) -> Maps:
        """Return normals (3, h, w) and errors (2, h, w) in a part of a tile: the half capture's,
        with detail.
        """
        smooth, errors = half.enlarged(tile.box)
        inside = smooth[:, torch.from_numpy(tile.mask)].T.numpy()
        errors = errors[:, *seen].to(self._device)

        def values_of(rows: PixelIndices, light: PixelLighting, part: slice) -> torch.Tensor:
            normals = (
                light.in_frame_of_pixels(values) for values in (inside[part], capture.normals[rows])
            )
            observations, directions = map(self._tensor, (light.observations, light.directions))
            scale = map_scale(observations)
            fit = two_halves(observations / scale, directions, capture.signs)
            values = (fit.normals, fit.noise.clamp(-1, 1), scale / capture.reference)
            return torch.cat((*map(self._tensor, normals), *values), dim=1)

        maps = self._maps(tile, 11, capture.lighting_at, values_of)[:, *seen]
        smooth, estimated, least_squares, noise, largest = torch.split(maps, [3, 3, 3, 1, 1])
        mask = self._tensor(tile.mask)[None, *seen]
        return restore_octave(
            unit_maps(smooth), estimated, least_squares, noise, largest, mask
        ), errors

    def _maps(
        self,
        tile: Tile,
        columns: int,
        lighting_at: LightingAt,
        values_of: Callable[[PixelIndices, PixelLighting, slice], torch.Tensor],
        run: Callable[..., Iterable[torch.Tensor]] = map,
    ) -> torch.Tensor:
        """Return maps (columns, h, w), zero outside the mask, of a tile's values (N, columns).

        `values_of` gives them from rows of the capture, their light and their slice of the tile's
        pixels. `run` calls it for each part of the pixels.
        """
        maps = torch.zeros(columns, *tile.mask.shape, device=self._device)
        rows = tile.rows[tile.mask]
        places = torch.from_numpy(np.flatnonzero(tile.mask)).to(self._device)
        parts = [*slices(len(rows), LIT_AT_ONCE)]
        values = run(lambda part: values_of(rows[part], lighting_at(rows[part]), part), parts)
        for part, each in zip(parts, values, strict=True):
            maps.view(columns, -1)[:, places[part]] = each.T
        return maps

    def _average_turns(
        self, features: torch.Tensor, mask: torch.Tensor, wanted: Box, turns: int
    ) -> Maps:
        """Return normals (3, h, w) and errors (2, h, w) of a part of the map, averaged over the
        turns of the map.
        """
        normals = errors = torch.zeros((), device=mask.device)
        for turn in map(MapTurn, range(turns)):
            turned, turned_mask = turn_features(features, turn), turn_maps(mask, turn)
            part = turned_part(wanted, mask.shape[-2:], turn.quarters)
            with torch.autocast(
                mask.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"
            ):
                found, found_errors = self.network(turned[None], turned_mask[None], part)
            normals = normals + turn_maps(found[0], turn.back, vectors=((0, 1),))
            errors = errors + turn_maps(found_errors[0], turn.back)
        return unit_maps(normals), errors / turns

    @property
    def _device(self) -> torch.device:
        return self.network.enter.weight.device

    def _tensor(self, values: Array) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self._device)


def _turn_back(normals: Float32Array, rows: PixelIndices, lighting_at: LightingAt) -> None:
    """Rotate normals (N, 3) of rows of a capture from the pixels' own frames into the capture's, in
    place.
    """
    for part in slices(len(rows), LIT_AT_ONCE):
        light = lighting_at(rows[part])
        if light.turns is None:
            break
        normals[part] = light.in_frame_of_capture(normals[part])


def _with_neighbours(part: Box, shape: Sequence[int]) -> tuple[Box, Box]:
    """Return a part of a map of this shape with all pixels that its detail depends on, and where
    the part is in it.
    """

    def grow(side: slice, length: int) -> tuple[slice, slice]:
        start, stop, _ = side.indices(length)
        first = max(0, start - _DETAIL_MARGIN)
        return slice(first, min(stop + _DETAIL_MARGIN, length)), slice(start - first, stop - first)

    (rows, own_rows), (columns, own_columns) = map(grow, part, shape)
    return (rows, columns), (own_rows, own_columns)
