"""Which observations are shadow: the threshold that IW12 and trimmed LS share."""

from __future__ import annotations

from torch import Tensor

SHADOW_SHARE = 0.05
"""Of the pixel's largest observation."""

FEWEST_LIT = 3
"""Observations that a normal needs; a pixel with fewer lit ones has to take what there is."""


def lit_observations(observations: Tensor, share: float = SHADOW_SHARE) -> Tensor:
    """Which observations (P, F) reach the share of the pixel's largest, which is 1, (P, F) bool.

    All of them in a pixel where fewer than three do.
    """
    lit = observations >= share
    return lit | (lit.sum(dim=1, keepdim=True) < FEWEST_LIT)
