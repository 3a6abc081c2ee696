"""Which observations are lit: the rule that IW12, ST14, IA14 and trimmed LS share, each with a threshold of its own."""

from __future__ import annotations

import torch
from torch import Tensor

UNSHADED = 0.6
"""Quantile of a pixel's intensities that its shadows are told by: half of them may be shadows, nearly half highlights.
The largest would not do: beside a metal's highlight all else is dark."""

FEWEST_LIT = 3
"""The brightest observations that never count as shadows: a normal needs three."""


def lit_observations(
    observations: Tensor, share: float, valid: Tensor | None = None, *, fewest: int = FEWEST_LIT
) -> Tensor:
    """Which observations (P, F) reach `share` of their pixel's quantile UNSHADED, or are among its `fewest` largest.

    Args:
        observations: (P, F), not negative.
        share: 0 for all.
        valid: (P, F) bool, all by default; others are not lit.
    """
    if not len(observations):  # of nothing there is no quantile
        return observations.bool()
    known = observations if valid is None else observations.masked_fill(~valid, torch.nan)
    floor = share * known.nanquantile(UNSHADED, dim=1, keepdim=True)
    there = observations if valid is None else observations.masked_fill(~valid, 0)
    largest = there.topk(min(fewest, there.shape[1]), dim=1).values[:, -1:]
    lit = observations >= torch.minimum(floor, largest)
    return lit if valid is None else lit & valid
