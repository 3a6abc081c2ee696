"""Lights that are found from the images of the object, where no file gives them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splinecli.maths.arrays import Bools, Doubles, Singles

FirstLight = Literal["left", "right", "above", "below"]  # side of the image from which a light comes
ESTIMATE = "estimate"  # given in place of a light file: the lights are found from the images


@dataclass(frozen=True, eq=False)
class FoundLights:
    """Lights of F images."""

    directions: Doubles  # (F, 3) float64, unit; x right, y up, z to the camera
    errors_deg: Doubles  # (F,), the expected errors of the directions in degrees
    intensities: Doubles | None = None  # (F,), with a mean of 1; None where they are known


def placeholders(n_lights: int) -> Doubles:
    """Return directions (F, 3) that mean nothing, in place of those that are found later: any that give normals."""
    azimuth = 2 * np.pi * np.arange(n_lights) / max(n_lights, 1)
    return np.stack((0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), np.full(n_lights, 0.8)), axis=1)


LightFinder = Callable[[Singles, Bools, bool], FoundLights]
"""Finds lights from observations (P, F), the mask (H, W) of their pixels, and whether the intensities are known."""
