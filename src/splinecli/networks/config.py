"""Network configurations: everything needed to rebuild a network, frozen, stored inside its weight file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from splinecli.errors import ModelError
from splinecli.networks.starting_fits import STARTING_FITS
from splinecli.observation_map import MAP_SIZE, Grid

_CHOICES = {
    "size": ("paper", "compact"),
    "grid": get_args(Grid),
    "interpolates": (True, False),
    "error_head": (True, False),
}


@dataclass(frozen=True)
class NetworkConfig:
    """A SPLINE-Net, or a CNN-PS.

    Attributes:
        size: "paper", the layers of the authors' networks; "compact", made for laptop cores.
        map_size: cells along a side of the observation map.
        grid: how lights fall on its cells; "cnn-ps" for the authors' own weights, of the paper size alone.
        fits: whose normals NE-Net starts from, among the STARTING_FITS, beside the robust Lambertian one; of the
            compact size alone.
        interpolates: whether there is a LI-Net. Without it NE-Net reads the sparse map alone, which is CNN-PS.
        error_head: whether NE-Net tells its error, too; of the compact size alone.
        width, li_blocks, ne_blocks, head_width: channels, residual blocks of each network and the head's
            hidden features of the compact size; the paper size has fixed layers and ignores them.
    """

    size: Literal["paper", "compact"] = "compact"
    map_size: int = MAP_SIZE
    width: int = 64
    li_blocks: int = 2
    ne_blocks: int = 3
    head_width: int = 256
    grid: Grid = "even"
    fits: tuple[str, ...] = ()
    interpolates: bool = True
    error_head: bool = False

    @property
    def is_canonical(self) -> bool:
        """Whether each pixel's lights are turned until its robust Lambertian normal has azimuth zero."""
        return self.size == "compact"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as stored in weight files and checkpoints."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """Rebuild a configuration. Raises ModelError for an unknown key or value."""
        known = {field.name: field.type for field in fields(cls)}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ModelError(f"unknown network setting {unknown[0]!r}; known are {', '.join(known)}")
        values = dict(values)
        fits = _fits(values.pop("fits", ()))
        for name, value in values.items():
            if name in _CHOICES:
                if value not in _CHOICES[name]:
                    expected = " or ".join(map(repr, _CHOICES[name]))
                    raise ModelError(f"network {name} is {value!r}; expected {expected}")
            elif not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 4096:
                raise ModelError(
                    f"network setting {name!r} is {value!r}; expected a whole number from 1 to 4096"
                )
        config = cls(**values, fits=fits)
        # Both sizes halve the map twice; an instance norm needs more than one cell after that.
        if config.map_size % 4 or not 8 <= config.map_size <= 128:
            raise ModelError(f"network setting 'map_size' is {config.map_size}; expected 8 to 128 in fours")
        if config.width < 2:
            raise ModelError(f"network setting 'width' is {config.width}; expected at least 2")
        if config.fits and config.size != "compact":
            raise ModelError("network setting 'fits' is for the size 'compact' alone")
        if config.error_head and config.size != "compact":
            raise ModelError("network setting 'error_head' is for the size 'compact' alone")
        if config.grid != "even" and config.size != "paper":
            raise ModelError(f"network grid is {config.grid!r}; only the size 'paper' has it")
        return config


def _fits(names: Any) -> tuple[str, ...]:
    known = ", ".join(STARTING_FITS)
    if not isinstance(names, list | tuple) or not all(name in STARTING_FITS for name in names):
        raise ModelError(f"network setting 'fits' is {names!r}; expected a list of {known}")
    return tuple(names)
