"""Detection of shadows. IW12, ST14, IA14 and trimmed LS use the same rule, each with its own threshold."""

import torch
from torch import Tensor

UNSHADED = 0.6
"""The quantile of a pixel's observations that serves as the reference for its shadows. More than half of the
observations may be shadows, and more than a third highlights. The largest observation is a poor reference, because on
a metal all others are dark beside the highlight."""

FEWEST_LIT = 3  # number of brightest observations that never count as shadows, because a normal needs three


def lit_observations(
    observations: Tensor, share: float, valid: Tensor | None = None, *, fewest: int = FEWEST_LIT
) -> Tensor:
    """Return which observations (P, F) reach `share` of the pixel's quantile UNSHADED or are among its `fewest`
    largest.

    Args:
        observations: (P, F), not negative.
        share: the threshold; 0 takes all observations.
        valid: (P, F) bool; false ones are not lit. None means all are valid.
    """
    if not len(observations):  # an empty batch has no quantile
        return observations.bool()
    known = observations if valid is None else observations.masked_fill(~valid, torch.nan)
    floor = share * known.nanquantile(UNSHADED, dim=1, keepdim=True)
    there = observations if valid is None else observations.masked_fill(~valid, 0)
    largest = there.topk(min(fewest, there.shape[1]), dim=1).values[:, -1:]
    lit = observations >= torch.minimum(floor, largest)
    return lit if valid is None else lit & valid
