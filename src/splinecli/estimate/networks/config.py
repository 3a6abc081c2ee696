"""Network configurations: everything that rebuilds a network,
and the fits that it may start from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from msgspec import Meta
from torch import Tensor
from torch.nn.functional import normalize

from splinecli.errors import ModelError
from splinecli.estimate.fits.ia14 import solve_ia14
from splinecli.estimate.fits.least_squares import solve_iw12, weighted_least_squares
from splinecli.maths.observation_map import MAP_SIZE, Grid
from splinecli.records.base import settings

HEAD_WIDTH = 16  # channels of an attention head of the set branch


STARTING_FITS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "ls": lambda observed, lights, valid: weighted_least_squares(
        observed, lights, valid.to(observed.dtype)
    )[0],
    "iw12": solve_iw12,
    "iw12-all": partial(solve_iw12, shadow_share=0),
    "ia14": solve_ia14,
}
"""Fits by their names in NetworkConfig.fits. "iw12-all" uses every observation, which is far better
on metals.
"""


@torch.no_grad()
def fit_normals(
    names: Sequence[str],
    observations: Tensor,
    light_directions: Tensor,
    valid: Tensor | None = None,
) -> Tensor:
    """Return unit normals (P, K, 3) of K fits among STARTING_FITS, zero where a fit has none.

    The observations (P, F) have a largest value of 1 in each pixel. The light directions are unit,
    (F, 3) or (P, F, 3). `valid` is (P, F) bool, all by default.
    """
    if not names:
        return observations.new_zeros(len(observations), 0, 3)
    if valid is None:
        valid = torch.ones_like(observations, dtype=torch.bool)
    # A subtracted dark frame leaves negative values in shadows.
    observed = torch.where(valid, observations, 0).clamp(min=0).double()
    lights = light_directions.double()
    found = torch.stack([STARTING_FITS[name](observed, lights, valid) for name in names], dim=1)
    return normalize(torch.nan_to_num(found), dim=-1).to(observations.dtype)


Depth = Annotated[int, Meta(ge=1, le=64)]  # each layer takes memory, whatever its size


@dataclass(frozen=True)
class NetworkConfig:
    """The layers of a SPLINE-Net or a CNN-PS."""

    # "paper" has the layers of the authors' networks. "compact" is made for processors.
    size: Literal["paper", "compact"] = "compact"
    # cells along a side of the observation map
    map_size: Annotated[int, Meta(ge=8, le=128, multiple_of=4)] = MAP_SIZE
    width: Annotated[int, Meta(ge=2, le=4096)] = 64  # channels of the compact size
    # li_blocks, ne_blocks: residual blocks of LI-Net and of NE-Net in the compact size
    li_blocks: Depth = 2
    ne_blocks: Depth = 3
    # hidden features of NE-Net's head in the compact size
    head_width: Annotated[int, Meta(ge=1, le=4096)] = 256
    # how lights fall on the cells. "cnn-ps" is for the authors' weights and needs the paper size.
    grid: Grid = "even"
    # the fits among STARTING_FITS whose normals NE-Net starts from, beside the robust Lambertian
    # fit. Compact size only.
    fits: tuple[str, ...] = ()
    # whether there is a LI-Net. Without one, NE-Net reads the sparse map alone, which is CNN-PS.
    interpolates: bool = True
    error_head: bool = False  # whether NE-Net also estimates its own error. Compact size only.
    # whether a refinement net corrects the map of normals afterwards. Needs an error head.
    refines: bool = False
    refines_twice: bool = False  # whether a second refinement net follows the first
    # channels of the set branch, 0 for none. Compact size only.
    set_width: Annotated[int, Meta(ge=0, le=4096)] = 0
    set_layers: Depth = 3  # attention layers of the set branch
    # whether a sample of the capture is an input of each pixel. Needs a set branch.
    sees_capture: bool = False

    @property
    def is_canonical(self) -> bool:
        """Whether the lights of each pixel are turned until its robust Lambertian normal has
        azimuth zero.
        """
        return self.size == "compact"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as weight files and checkpoints store them."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """Rebuild a configuration from plain values. Raises ModelError for an unknown key or
        value.
        """
        config = cls(**settings(cls, values, "network setting", ModelError))
        for fit in config.fits:
            if fit not in STARTING_FITS:
                raise ModelError(
                    f"network setting 'fits' has {fit!r}; expected a list of"
                    f" {', '.join(STARTING_FITS)}"
                )
        compact_only = ("fits", "error_head", "set_width")
        wrong = {
            **{
                f"{name!r} needs the size 'compact'": getattr(config, name)
                and config.size != "compact"
                for name in compact_only
            },
            "'refines' needs 'error_head'": config.refines and not config.error_head,
            "'refines_twice' needs 'refines'": config.refines_twice and not config.refines,
            "'sees_capture' needs 'set_width' above 0": (
                config.sees_capture and not config.set_width
            ),
            f"'set_width' is {config.set_width}; expected a multiple of {HEAD_WIDTH}": (
                config.set_width % HEAD_WIDTH
            ),
            f"'grid' is {config.grid!r}; it needs the size 'paper'": (
                config.grid != "even" and config.size != "paper"
            ),
        }
        for problem, is_wrong in wrong.items():
            if is_wrong:
                raise ModelError(f"network setting {problem}")
        return config
