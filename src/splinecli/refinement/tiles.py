"""The refinement net on a whole capture, in tiles that overlap, so that memory does not grow with the capture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.fits.two_halves import alternating_signs
from splinecli.light.lamp_light import LIT_AT_ONCE, LightOf
from splinecli.networks.refine_channels import CHANNELS
from splinecli.networks.refine_net import COARSEST, Part, RefineNet
from splinecli.refinement.detail import FEWEST_LIGHTS, restore_detail
from splinecli.refinement.detail import REACH as DETAIL_REACH
from splinecli.refinement.features import Turn, brightness, refine_features, turn_features, turn_maps
from splinecli.system.memory import return_freed_memory
from splinecli.system.progress import Progress

MARGIN = 64
"""Pixels around a tile that are seen, a multiple of COARSEST.

The net can see further (REACH), but what lies beyond the margin turns no normal by more than 0.01 degrees.
"""

TILE = 608
"""Side of the part of the map that is refined at once, a multiple of COARSEST. Its margin comes on top.

Larger tiles take less time, because their margins are smaller in all, and more memory.
"""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class _Tile:
    """A part of the map with a margin.

    Args:
        mask: (h, w), with the margin; h and w are multiples of COARSEST, so that a turned tile has the same cells.
        rows: (h, w), the rows of its pixels in the capture.
        inner: the part without the margin.
    """

    mask: NDArray[np.bool_]
    rows: NDArray[np.integer]
    inner: Part


class _Band:
    """The refined normals and errors of a row of tiles, until the tiles below no longer need those from before.

    Args:
        pixels: the rows of these pixels in the capture, which follow one another.
        normals, errors: (P, 3) and (P, 2) of the whole capture.
    """

    def __init__(self, pixels: slice, normals: Floats, errors: Floats) -> None:
        self._pixels = pixels
        self._pairs = [(values, values[pixels].copy()) for values in (normals, errors)]

    def put(self, rows: NDArray[np.integer], *refined: Floats) -> None:
        """Keep refined normals and errors of some of the band's pixels."""
        for (_, kept), found in zip(self._pairs, refined, strict=True):
            kept[rows - self._pixels.start] = found

    def write(self) -> None:
        """Write what is kept into the arrays of the whole capture."""
        for whole, kept in self._pairs:
            whole[self._pixels] = kept


class NetworkRefiner:
    """Corrects the normals of a capture, and the distributions of their errors, by what lies around each pixel.

    Args:
        network: the refinement net, on its device.
        precision: the number format of the convolutions.
        turns: the results of this many quarter turns of the map are averaged. Mirror images gain nothing beside them.
        tile, margin: see TILE and MARGIN. With a margin of REACH, tiles change nothing.
    """

    def __init__(
        self, network: RefineNet, precision: str, *, turns: int = 4, tile: int = TILE, margin: int = MARGIN
    ) -> None:
        assert tile % COARSEST == 0 == margin % COARSEST
        assert tile >= margin, "the margin of a tile must be within its neighbours"
        self.network = network
        self.precision = precision
        self.turns = turns
        self.tile, self.margin = tile, margin

    def without_turns(self) -> NetworkRefiner:
        """Return the refiner that sees the map once, for captures whose pixels are estimated quickly."""
        return NetworkRefiner(self.network, self.precision, turns=1, tile=self.tile, margin=self.margin)

    @torch.inference_mode()
    def refine(
        self,
        mask: NDArray[np.bool_],
        observations: Floats,
        light_of: LightOf,
        normals: Floats,
        errors: Floats,
        *,
        progress: Progress | None = None,
    ) -> None:
        """Refine normals (P, 3) and the distributions (P, 2) of their errors in place.

        A pixel that is dark under every light stays as it is. See networks/error_head.py for the distributions.

        Args:
            mask: (H, W), with P true pixels.
            observations: (P, F); only their brightness counts here.
            light_of: gives the observations and the light directions of some pixels.
            normals, errors: of the estimator, in the capture's frame.
            progress: called after each tile with the number of its pixels.
        """
        device = self.network.enter.weight.device
        middle = light_of(np.array([len(normals) // 2])).directions  # as one pixel sees the lights
        directions = torch.as_tensor(middle, dtype=torch.float32, device=device).view(-1, 3)
        features_of = partial(
            refine_features,
            reference=brightness(torch.from_numpy(observations)),
            signs=alternating_signs(directions),
        )
        lit = observations.max(axis=1) > 0
        mask = _around_object(mask)
        above = _Band(slice(0, 0), normals, errors)
        for pixels, tiles in self._rows_of_tiles(mask):
            return_freed_memory()  # what the tiles above left is in pieces
            band = _Band(pixels, normals, errors)
            for tile in tiles:
                own = tile.rows[tile.inner][tile.mask[tile.inner]]
                refined, refined_errors = self._refine(tile, light_of, normals, errors, features_of)
                # Nothing is known of a pixel that is dark under every light.
                known = lit[own]
                band.put(own[known], refined[known], refined_errors[known])
                if progress is not None:
                    progress(len(own))
            # These tiles needed the pixels above as they were. The tiles below need these tiles' pixels.
            above.write()
            above = band
        above.write()

    def _rows_of_tiles(self, mask: NDArray[np.bool_]) -> Iterator[tuple[slice, Iterator[_Tile]]]:
        """Yield the pixels of each row of tiles, and its tiles that have pixels."""
        pixels_before = np.concatenate(([0], np.count_nonzero(mask, axis=1).cumsum()))
        for top in range(0, mask.shape[0], self.tile):
            bottom = min(top + self.tile, len(mask))
            pixels = slice(int(pixels_before[top]), int(pixels_before[bottom]))
            band = slice(max(0, top - self.margin), top + self.tile + self.margin)
            rows = mask[band].cumsum(dtype=np.int32).reshape(mask[band].shape)
            rows += int(pixels_before[band.start]) - 1
            yield pixels, self._tiles_of_band(mask[band], rows, top - band.start)

    def _tiles_of_band(self, mask: NDArray[np.bool_], rows: NDArray[np.integer], top: int) -> Iterator[_Tile]:
        """Yield the tiles of a part of the map with a margin, of which they begin at the row `top`."""
        for left in range(0, mask.shape[1], self.tile):
            outer = slice(max(0, left - self.margin), left + self.tile + self.margin)
            seen = mask[:, outer]
            start = left - outer.start
            inner = slice(top, top + self.tile), slice(start, start + self.tile)
            if seen[inner].any():
                yield _Tile(seen, rows[:, outer], inner)

    def _refine(
        self,
        tile: _Tile,
        light_of: LightOf,
        normals: Floats,
        errors: Floats,
        features_of: Callable[..., torch.Tensor],
    ) -> tuple[Floats, Floats]:
        """Return the refined normals and errors of a tile without its margin."""
        device = self.network.enter.weight.device

        def tensor(values: NDArray[np.floating]) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        features = torch.zeros(*tile.mask.shape, CHANNELS, device=device)
        rows, places = tile.rows[tile.mask], torch.from_numpy(np.flatnonzero(tile.mask)).to(device)
        for start in range(0, len(rows), LIT_AT_ONCE):
            block = rows[start : start + LIT_AT_ONCE]
            light = light_of(block)
            features.view(-1, CHANNELS)[places[start : start + LIT_AT_ONCE]] = features_of(
                tensor(light.observations),
                tensor(light.directions),
                tensor(light.in_frame_of_pixels(normals[block])),
                tensor(errors[block]),
            )
        mask = torch.from_numpy(tile.mask).to(device, torch.float32)[None]
        seen, inner = _with_neighbours(tile.inner, tile.mask.shape)
        features = features.permute(2, 0, 1)
        found, found_errors = self._average_turns(features, mask, seen)
        if light.observations.shape[1] >= FEWEST_LIGHTS:
            found = restore_detail(found, features[:, *seen], mask[:, *seen])
        inside = tile.mask[tile.inner]
        refined, refined_errors = (
            values[:, *inner].permute(1, 2, 0).cpu().numpy()[inside] for values in (found, found_errors)
        )
        own = tile.rows[tile.inner][inside]
        for start in range(0, len(own), LIT_AT_ONCE):
            part = slice(start, start + LIT_AT_ONCE)
            light = light_of(own[part])
            if light.turns is None:
                break
            refined[part] = light.in_frame_of_capture(refined[part])
        return refined, refined_errors

    def _average_turns(
        self, features: torch.Tensor, mask: torch.Tensor, wanted: Part
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return normals (3, h, w) and errors (2, h, w) of a part of the map, averaged over the turns of the map."""
        normals = errors = torch.zeros((), device=mask.device)
        for turn in map(Turn, range(self.turns)):
            turned, turned_mask = turn_features(features, turn), turn_maps(mask, turn)
            part = _turned_part(wanted, mask.shape[-2:], turn.quarters)
            with torch.autocast(mask.device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"):
                found, found_errors = self.network(turned[None], turned_mask[None], part)
            normals = normals + turn_maps(found[0], turn.back, vectors=((0, 1),))
            errors = errors + turn_maps(found_errors[0], turn.back)
        return torch.nn.functional.normalize(normals, dim=0), errors / self.turns


def _around_object(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the part of a mask that has pixels, between multiples of COARSEST. Behind the map it has a margin."""
    bounds = []
    for axis in (1, 0):
        places = np.flatnonzero(mask.any(axis=axis))
        bounds.append(slice(places[0] // COARSEST * COARSEST, -(-(places[-1] + 1) // COARSEST) * COARSEST))
    part = mask[tuple(bounds)]
    missing = [(0, side.stop - side.start - length) for side, length in zip(bounds, part.shape, strict=True)]
    return np.pad(part, missing)


def _with_neighbours(part: Part, shape: Sequence[int]) -> tuple[Part, Part]:
    """Return a part of a map of this shape with all pixels that its detail depends on, and where the part is in it."""
    margin = -(-DETAIL_REACH // COARSEST) * COARSEST
    grown, within = [], []
    for side, length in zip(part, shape, strict=True):
        start, stop, _ = side.indices(length)
        first = max(0, start - margin)
        grown.append(slice(first, min(stop + margin, length)))
        within.append(slice(start - first, stop - first))
    return (grown[0], grown[1]), (within[0], within[1])


def _turned_part(part: Part, shape: Sequence[int], quarters: int) -> Part:
    """Return where a part of a map of this shape is when the map is turned counterclockwise by quarters."""
    rows, columns = (slice(*side.indices(length)) for side, length in zip(part, shape, strict=True))
    height, width = shape
    for _ in range(quarters):
        rows, columns = slice(width - columns.stop, width - columns.start), rows
        height, width = width, height
    return rows, columns
