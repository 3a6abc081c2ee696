"""What the other pixels of a capture say about a pixel.

From ten observations, many pairs of a normal and a reflectance are possible. An object has few materials, and pixels
with other normals show other sides of the same reflectance. Universal photometric stereo (Ikehata, CVPR 2022 and 2023)
shows how much a network gains where pixels see each other. Here each pixel sees the tokens of a sample of its capture.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from splinecli.fits.robust import lit_values
from splinecli.networks.layers import zeroed

SAMPLE = 256  # pixels of a capture that its other pixels see

_DARK_SHARE = 0.02  # see lit_values. Darker pixels, such as a black background, say nothing
_LARGEST_LOG = 7.0  # of a pixel's brightness over that of its capture
_HEADS = 4


class Summary(NamedTuple):
    """What one layer says of G captures, from S pixels of each."""

    keys: Tensor  # keys, values: (G, heads, S, width / heads)
    values: Tensor
    mean: Tensor  # (G, 1, width)


class CaptureContext(NamedTuple):
    """What the network knows of a capture."""

    brightness: Tensor  # (1,), median of the largest observation of the sampled pixels
    layers: tuple[Summary, ...]  # of the layers of the set branch


def sample_of(observations: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the rows of the pixels, with observations (P, F), that the others see: at most SAMPLE lit ones, evenly
    spread. Where none is lit, the first one stands for all.
    """
    rows, _ = lit_values(observations, _DARK_SHARE, SAMPLE)
    return rows if len(rows) else np.zeros(1, np.intp)


def brightness_level(largest: Tensor, brightness: Tensor) -> Tensor:
    """Return the logarithm (P, 1) of the largest observation of each pixel (P, 1) over its capture's brightness (G,).

    Pixel p belongs to capture p % G.
    """
    levels = largest.view(-1, len(brightness)) / brightness.clamp(min=1e-9)
    return levels.clamp(min=1e-9).log().clamp(-_LARGEST_LOG, _LARGEST_LOG).view(-1, 1)


class ContextLayer(nn.Module):
    """Adds to the tokens of pixels what they find in the tokens of their capture: by attention and in the mean.

    At first, it adds nothing.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = nn.Linear(width + 1, width)
        self.query_norm, self.key_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries = nn.Linear(width, width)
        self.keys_values = nn.Linear(width, 2 * width)
        self.pooled = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.join = nn.Sequential(nn.Linear(3 * width, 2 * width), nn.GELU(), zeroed(nn.Linear(2 * width, width)))

    def forward(self, tokens: Tensor, level: Tensor, captures: int, known: Summary | None) -> tuple[Tensor, Summary]:
        """Return the changed tokens (P, width), and the summary of their captures.

        Args:
            tokens: (P, width).
            level: (P, 1), see brightness_level.
            captures: the number G of captures. Pixel p belongs to capture p % G.
            known: the summary of one capture; None if the pixels themselves are the samples of theirs.
        """
        embedded = self.embed(torch.cat((tokens, level), dim=1)).view(-1, captures, tokens.shape[1]).transpose(0, 1)
        summary = self._summarise(embedded) if known is None else known
        queries = self.query_norm(embedded)
        with torch.autocast(tokens.device.type, enabled=False):
            # In float32, as in the set branch.
            parts = _split(self.queries(queries.to(self.queries.weight.dtype))), summary.keys, summary.values
            found = nn.functional.scaled_dot_product_attention(*parts).transpose(1, 2).flatten(2)
        seen = torch.cat((queries, found.to(queries), summary.mean.to(queries).expand_as(queries)), dim=2)
        return tokens + self.join(seen).transpose(0, 1).reshape(tokens.shape), summary

    def _summarise(self, embedded: Tensor) -> Summary:
        sample = self.key_norm(embedded)
        keys, values = self.keys_values(sample).to(self.queries.weight.dtype).chunk(2, dim=2)
        return Summary(_split(keys), _split(values), self.pooled(sample).mean(dim=1, keepdim=True))


def _split(tokens: Tensor) -> Tensor:
    """Split tokens (G, P, width) into heads (G, heads, P, width / heads)."""
    return tokens.view(*tokens.shape[:2], _HEADS, -1).transpose(1, 2)
