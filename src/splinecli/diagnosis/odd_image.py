"""One image that contradicts the others: its lamp was moved or failed, its exposure differs, a shadow fell on it.

Each image is left out in turn. If what the lights cannot explain nearly vanishes without one of them, and stays without
any other, this one is odd. So is an image that the factors of rank 3 explain far less well than all others.

The thresholds were chosen on the same captures as those of light_check.py, in which one image was dimmed, exchanged or
half in shadow, or one light was moved by 40 degrees.
"""

from dataclasses import dataclass

import numpy as np

from splinecli.capture.lights.light_fit import Factors
from splinecli.maths import Doubles

MIN_LIGHTS = 10  # with fewer lights, a right image may seem odd by chance
MIN_MISFIT = 0.04  # smallest misfit of lights, one of whose images is odd, as a share of the brightness

ODD_MISFIT, OTHER_MISFIT = 0.35, 0.75
"""Largest misfit without the odd image, and smallest one without any other, as shares of that of all images."""

MIN_RESIDUAL, RESIDUAL_RATIO = 0.25, 2.5
"""An odd image's residual is above the first, as a share of its brightness, and this many times that of any other."""

MAX_RESIDUAL, MAX_OTHER_RESIDUAL = 0.2, 0.15
"""Where the factors leave more of all images, as on metals, misfits tell nothing; the second is for residuals, of the
other images."""

OTHER_BRIGHTNESS = 0.3
"""Largest misfit of an odd image, as a share of it, that counts as another brightness of the same image."""


@dataclass(frozen=True)
class OddImage:
    """An image that contradicts the others."""

    place: int
    left: float  # what is left without it of the misfit, or of the residual of the factors, as a share of that of all
    # as a share of what its light would give; None where it is not the fault, or the light's intensity is unknown
    brightness: float | None = None


def find_odd_image(factors: Factors, light_directions: Doubles) -> OddImage | None:
    """Return the image that contradicts the others under lights (F, 3), or None."""
    if len(light_directions) < MIN_LIGHTS:
        return None
    kinds = [factors] if factors.intensities_known else []
    for compared in (*kinds, factors.with_free_intensities()):
        shares = _shares_left(compared, light_directions)
        first, second = np.argsort(shares)[:2]
        alone = shares[first] < ODD_MISFIT and shares[second] > OTHER_MISFIT
        if alone and factors.residual < MAX_RESIDUAL:
            brightness = _brightness(compared, light_directions, int(first))
            return OddImage(int(first), float(shares[first]), brightness)
    residuals = factors.image_residuals / np.maximum(np.linalg.norm(factors.matrix, axis=0), 1e-12)
    second, first = np.argsort(residuals)[-2:]
    left = float(np.linalg.norm(np.delete(factors.image_residuals, first)))
    stands_out = residuals[first] > max(MIN_RESIDUAL, RESIDUAL_RATIO * residuals[second])
    if stands_out and left < MAX_OTHER_RESIDUAL:
        return OddImage(int(first), left / factors.residual)
    return None


def _shares_left(factors: Factors, light_directions: Doubles) -> Doubles:
    """Return the mean square misfits (F,) without each image, as roots of their shares of that of all images."""
    n_lights = len(light_directions)
    misfit = factors.misfits(light_directions[None])[0]
    if misfit < MIN_MISFIT:
        return np.ones(n_lights)
    without = np.repeat(light_directions[None], n_lights, axis=0)
    diagonal = np.arange(n_lights)
    without[diagonal, diagonal] = 0  # then all of this image is misfit
    left = factors.misfits(without) ** 2 - (factors.matrix**2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(left, 0) * n_lights / (n_lights - 1)) / misfit)


def _brightness(factors: Factors, light_directions: Doubles, place: int) -> float | None:
    """Return the brightness of an image as a share of what the others predict; None where it is not only scaled."""
    if not factors.intensities_known:
        return None
    others = np.delete(np.arange(len(light_directions)), place)
    fit = np.linalg.lstsq(light_directions[others], factors.matrix[:, others].T, rcond=None)[0]
    predicted, found = light_directions[place] @ fit, factors.matrix[:, place]
    brightness = float(found @ predicted / max(predicted @ predicted, 1e-12))
    misfit = np.linalg.norm(found - brightness * predicted) / max(float(np.linalg.norm(found)), 1e-12)
    return brightness if brightness > 0 and misfit < OTHER_BRIGHTNESS else None
