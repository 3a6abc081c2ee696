"""Lights that are found from the images of the object, where no file gives them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splinecli.errors import UsageError
from splinecli.maths import Bools, Doubles, Singles

SIDES_DEG = {
    "right": 0.0,
    "upper-right": 45.0,
    "above": 90.0,
    "upper-left": 135.0,
    "left": 180.0,
    "lower-left": 225.0,
    "below": 270.0,
    "lower-right": 315.0,
}
"""Azimuths of the sides of an image: counter-clockwise from the right."""

ESTIMATE = "estimate"  # given in place of a light file: the lights are found from the images


@dataclass(frozen=True, eq=False)
class FoundLights:
    """Lights of F images."""

    directions: Doubles  # (F, 3) float64, unit; x right, y up, z to the camera
    errors_deg: Doubles  # (F,), the expected errors of the directions in degrees
    intensities: Doubles | None = None  # (F,), with a mean of 1; None where they are known


def azimuth_of(first_light: str) -> float:
    """Return the azimuth in degrees of a side of the image, such as `upper-left`, or of a number of degrees.

    Raises UsageError for other text.
    """
    if first_light in SIDES_DEG:
        return SIDES_DEG[first_light]
    try:
        azimuth = float(first_light)
    except ValueError:
        azimuth = np.nan
    if not abs(azimuth) <= 360:
        raise UsageError(
            f"the first light comes from {first_light!r}; expected one of {', '.join(SIDES_DEG)}, or its azimuth in"
            " degrees, counter-clockwise from the right"
        )
    return azimuth


def placeholders(n_lights: int) -> Doubles:
    """Return directions (F, 3) that mean nothing, in place of those that are found later: any that give normals."""
    azimuth = 2 * np.pi * np.arange(n_lights) / max(n_lights, 1)
    return np.stack((0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), np.full(n_lights, 0.8)), axis=1)


LightFinder = Callable[[Singles, Bools, bool], FoundLights]
"""Finds lights from observations (P, F), the mask (H, W) of their pixels, and whether the intensities are known."""
