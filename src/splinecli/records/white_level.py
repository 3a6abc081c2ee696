"""The white level of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Origin = Literal["given", "file", "images", "full scale"]


@dataclass(frozen=True)
class WhiteLevel:
    """The stored value at or above which observations are considered saturated."""

    value: float  # in the unit of the files, such as 4095
    # given by the user, stated in the files, found in the images, or the full scale of the files
    origin: Origin
