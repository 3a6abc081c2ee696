"""The refinement net on a whole capture, in tiles that overlap, so that memory does not grow with the capture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.methods.lamp_light import LampLight
from splinecli.networks.refine_features import brightness, refine_features
from splinecli.networks.refine_net import COARSEST, REACH, RefineNet

TILE = 512
"""Side of the part of the map that is refined at once, a multiple of COARSEST. Its margin of REACH comes on top."""

LightOf = Callable[[NDArray[np.integer]], LampLight]
"""From rows of a capture's pixels to their observations and light directions."""

Floats = NDArray[np.float32]


class Refiner:
    """Corrects the normals of a capture, and the distributions of their errors, by what lies around each pixel.

    Args:
        network: the refinement net, on its device.
        precision: the number format of the convolutions.
        tile: see TILE.
    """

    def __init__(self, network: RefineNet, precision: str, *, tile: int = TILE) -> None:
        assert tile % COARSEST == 0 == REACH % COARSEST
        self.network = network
        self.precision = precision
        self.tile = tile

    @torch.inference_mode()
    def refine(
        self,
        mask: NDArray[np.bool_],
        observations: Floats,
        light_of: LightOf,
        normals: Floats,
        errors: Floats,
    ) -> tuple[Floats, Floats]:
        """Return refined normals (P, 3) and distributions of their errors (P, 2); see networks/error_head.py.

        A pixel that is dark under every light stays as it is.

        Args:
            mask: (H, W), with P true pixels.
            observations: (P, F); only their brightness counts here.
            light_of: gives the observations and the light directions of some pixels.
            normals, errors: of the estimator, in the capture's frame.
        """
        row_of_pixel = np.cumsum(mask.reshape(-1), dtype=np.int32).reshape(mask.shape) - 1
        reference = brightness(torch.from_numpy(observations))
        refined, refined_errors = np.empty_like(normals), np.empty_like(errors)
        for top in range(0, mask.shape[0], self.tile):
            for left in range(0, mask.shape[1], self.tile):
                inner = slice(top, top + self.tile), slice(left, left + self.tile)
                if not mask[inner].any():
                    continue
                outer = tuple(slice(max(0, side.start - REACH), side.stop + REACH) for side in inner)
                seen = mask[outer]
                rows = row_of_pixel[outer][seen]
                found, found_errors = self._refine(
                    seen, light_of(rows), normals[rows], errors[rows], reference
                )
                # The margin belongs to other tiles.
                own = np.zeros_like(mask[outer])
                own[
                    tuple(
                        slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer, strict=True)
                    )
                ] = True
                kept = own[seen]
                refined[rows[kept]], refined_errors[rows[kept]] = found[kept], found_errors[kept]
        # Nothing is known of a pixel that is dark under every light.
        dark = observations.max(axis=1) <= 0
        refined[dark], refined_errors[dark] = normals[dark], errors[dark]
        return refined, refined_errors

    def _refine(
        self, mask: NDArray[np.bool_], light: LampLight, normals: Floats, errors: Floats, reference: float
    ) -> tuple[Floats, Floats]:
        """Refine the pixels of one tile (h, w)."""
        device = self.network.enter.weight.device

        def tensor(values: NDArray[np.floating]) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        found = refine_features(
            tensor(light.observations),
            tensor(light.directions),
            tensor(light.in_frame_of_pixels(normals)),
            tensor(errors),
            reference,
        )
        inside = torch.from_numpy(mask).to(device)
        features = found.new_zeros(found.shape[1], *mask.shape)
        features[:, inside] = found.T
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=self.precision == "bfloat16"):
            maps = self.network(features[None], inside.float()[None, None])
        refined, refined_errors = (values[0][:, inside].T.cpu().numpy() for values in maps)
        return np.asarray(light.in_frame_of_capture(refined), np.float32), refined_errors
