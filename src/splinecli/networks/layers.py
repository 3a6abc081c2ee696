"""Layers that several networks share."""

from typing import TypeVar

import torch
from torch import Tensor, nn

PATCH = 4  # side in cells of the patches that an encoder joins into one position
Layer = TypeVar("Layer", nn.Conv2d, nn.Linear)


def zeroed(layer: Layer) -> Layer:
    """Set the weights and offsets of a layer to zero and return it: what it corrects stays as it is at first."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


class ResidualBlock(nn.Module):
    """x + conv3x3(relu(conv3x3(relu(x)))) on (P, C, h, w), zero outside of a mask if there is one.

    It has no norm and starts as the identity.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = zeroed(nn.Conv2d(width, width, 3, padding=1))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        hidden: Tensor = self.first(torch.relu(x))
        # In place: a tile's maps of 32 channels decide how much memory is needed.
        change: Tensor = self.second((hidden if mask is None else hidden.mul_(mask)).relu_())
        if mask is not None:
            change.mul_(mask)
        return change.add_(x) if change.dtype == x.dtype else x + change


class MapEncoder(nn.Module):
    """Encodes maps (P, C, w, w) as features (P, width, w / 4, w / 4).

    Each patch of 4 x 4 cells becomes one position; this is fast on a CPU. Each position gets a learned embedding. Cells
    are light directions, so a map is not translation invariant as a photograph is.
    """

    def __init__(self, channels: int, width: int, blocks: int, map_size: int) -> None:
        super().__init__()
        side = map_size // PATCH
        self.patches = nn.Conv2d(channels * PATCH**2, width, 1)
        self.position = nn.Parameter(torch.zeros(1, width, side, side))
        self.blocks = nn.Sequential(*(ResidualBlock(width) for _ in range(blocks)))

    def forward(self, maps: Tensor) -> Tensor:
        patches = nn.functional.pixel_unshuffle(maps, PATCH).contiguous(memory_format=torch.channels_last)
        features: Tensor = self.blocks(self.patches(patches) + self.position)
        return features
