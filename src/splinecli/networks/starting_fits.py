"""The fits whose normals NE-Net weighs and corrects, beside the robust Lambertian fit."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from splinecli.fits.ia14 import solve_ia14
from splinecli.fits.least_squares import solve_iw12, weighted_least_squares


def _least_squares(observations: Tensor, light_directions: Tensor, valid: Tensor) -> Tensor:
    return weighted_least_squares(observations, light_directions, valid.to(observations.dtype))[0]


STARTING_FITS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "ls": _least_squares,
    "iw12": solve_iw12,
    "iw12-all": partial(solve_iw12, shadow_share=0),
    "ia14": solve_ia14,
}
"""Fits by their names in NetworkConfig.fits. "iw12-all" uses every observation, which is far better on metals."""


@torch.no_grad()
def fit_normals(
    names: Sequence[str], observations: Tensor, light_directions: Tensor, valid: Tensor | None = None
) -> Tensor:
    """Return unit normals (P, K, 3) of K fits among STARTING_FITS, zero where a fit has none.

    The observations (P, F) have a largest value of 1 in each pixel. The light directions are unit, (F, 3) or (P, F, 3).
    `valid` is (P, F) bool, all by default.
    """
    if not names:
        return observations.new_zeros(len(observations), 0, 3)
    if valid is None:
        valid = torch.ones_like(observations, dtype=torch.bool)
    # A subtracted dark frame leaves negative values in shadows.
    observed = torch.where(valid, observations, 0).clamp(min=0).double()
    lights = light_directions.double()
    found = torch.stack([STARTING_FITS[name](observed, lights, valid) for name in names], dim=1)
    return torch.nn.functional.normalize(torch.nan_to_num(found), dim=-1).to(observations.dtype)
