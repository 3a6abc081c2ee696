"""A sample of pixels that is spread over their appearance, so that it contains rare materials and highlights."""

from dataclasses import dataclass

import torch
from torch import Tensor

CELLS = 256  # number of groups of pixels of like appearance
EVEN_SHARE = 0.5  # Share of the sample that is drawn evenly from all pixels. The rest is drawn evenly from the groups.


@dataclass(frozen=True)
class PixelSample:
    """A sample of pixels, and the appearances that it covers."""

    rows: Tensor  # (N,) distinct numbers of the pixels. The first EVEN_SHARE are an even sample of all pixels
    centres: Tensor  # (K, C), the features at the centres of the groups
    rare: Tensor  # (K,) bool, the groups of fewest pixels
    reach: float  # the largest distance of a pixel, among those that could be drawn, from the nearest centre

    def unlike(self, features: Tensor) -> Tensor:
        """Return which pixels (P,) with features (P, C) are in rare groups, or farther away than any group reaches."""
        from_rare, from_others = (_nearest(features, self.centres[group]) for group in (self.rare, ~self.rare))
        # Rounding must not make a pixel unlike itself.
        return (from_rare < from_others) | (from_others > 1.001 * self.reach + 1e-4)


def _nearest(features: Tensor, centres: Tensor) -> Tensor:
    """Return the distances (P,) of features (P, C) from the nearest of centres (K, C); infinity if there are none."""
    if not len(centres):
        return torch.full_like(features[:, 0], torch.inf)
    # Twice as fast as torch.cdist.
    rest = torch.addmm(centres.square().sum(dim=1), features, centres.T, alpha=-2).amin(dim=1)
    return (rest + features.square().sum(dim=1)).clamp(min=0).sqrt()


def draw_sample(features: Tensor, size: int, generator: torch.Generator, *, rare_share: float = 0.0) -> PixelSample:
    """Draw a sample of `size` pixels, or half of all pixels if that is less.

    The pixels are grouped around centres: each further centre is the pixel farthest from all centres so far (Gonzalez,
    Clustering to minimize the maximum intercluster distance, 1985). Rare appearances thereby get groups of their own.

    Args:
        features: (P, C) of the pixels that may be drawn, in any order.
        generator: on the CPU.
        rare_share: largest share of the pixels in groups that count as rare.
    """
    order = torch.randperm(len(features), generator=generator)
    size = min(size, len(features) // 2)
    n_even = round(EVEN_SHARE * size)
    centres, nearest, reach = _group(features)
    counts = torch.bincount(nearest, minlength=len(centres))
    by_count = torch.argsort(counts, stable=True)
    rare = torch.empty_like(counts, dtype=torch.bool)
    rare[by_count] = counts[by_count].cumsum(0) <= rare_share * int(counts.sum())
    left = order[n_even:]
    # One pixel of each group in turn, until there are enough.
    turns = torch.argsort(_rank_in_group(nearest[left.to(nearest.device)].cpu()), stable=True)
    rows = torch.cat((order[:n_even], left[turns[: size - n_even]]))
    return PixelSample(rows, features[centres], rare, reach)


def _group(features: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return the pixels (K,) at the centres, the group of each pixel (P,), and the largest distance from a centre."""
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
