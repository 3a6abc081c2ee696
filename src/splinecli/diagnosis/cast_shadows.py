"""Tell bumps from hollows by the shadows that a surface casts on itself.

With x and y of all lights negated, the normals are those of the surface turned inside out. It has the same shading and
the same attached shadows (Belhumeur, Kriegman and Yuille, IJCV 1999), but it casts shadows in other places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splinecli.diagnosis.frame_evidence import _FITS, RoughNormals
from splinecli.fits.robust import fit_robustly, shadow_weights
from splinecli.maths import Bools, Doubles, Floats

AGREEMENT_WEIGHT = 5.0
"""Weight of a difference of agreements, beside those of light_check.py. Synthetic bumps agree by 0.2 to 0.9 with right
lights, below 0.02 with negated ones; photographs of statues by 0.07 to 0.3, and below 0.01."""

MISSING, MISSING_OF_OTHER = 0.02, 0.1
"""From the first share of lit observations that should be in cast shadow and are not, lights are doubted if the other
reading has at most the second part of it."""

OPEN_MISSING, OPEN_MISSING_OF_OTHER = 0.01, 0.75
"""The same shares, from which lights may be wrong. If both readings lack about as many shadows, the images were
rendered without cast shadows, which is not evidence against the lights."""

_FEWEST_SHARE, _FEWEST = 0.001, 20  # of lit observations in shadow, below which they are noise and highlights
_MAX_PIXELS, _MAX_LIGHTS = 6000, 24
_LIT_SHARE, _DARK_SHARE = 0.25, 0.4  # of a pixel's brightest shading, and of its own, beyond which shadows are judged
_MARGIN = 0.5  # pixels that a surface must rise above a ray


@dataclass(frozen=True, eq=False)
class Shadows:
    """How well cast shadows of a surface agree with dark observations that should be lit."""

    agreement: float  # correlation, from -1 to 1; 0 where too few are dark
    missing: float  # share of the lit observations that should be in cast shadow, but are bright

    def evidence(self, other: Shadows) -> float:
        """Return the evidence for another reading against this one, as an advantage of light_check.py."""
        found = AGREEMENT_WEIGHT * (other.agreement - self.agreement)
        if self.missing > MISSING and other.missing < MISSING_OF_OTHER * self.missing:
            return found + 1
        if other.missing > MISSING and self.missing < MISSING_OF_OTHER * other.missing:
            return found - 1
        return found

    def leaves_open(self, other: Shadows) -> bool:
        """Return whether shadows that this reading needs are missing, more than those of another one."""
        return self.missing > OPEN_MISSING and other.missing < OPEN_MISSING_OF_OTHER * self.missing


@dataclass(frozen=True, eq=False)
class ShadowCheck:
    """Dark observations of a sample, to be compared with the shadows of its surfaces under its lights."""

    normals: RoughNormals  # on a coarser grid
    lights: Doubles  # (f, 3)
    lit: Bools  # (p, f), whether a matte pixel would be bright
    dark: Bools  # (p, f), whether it is dark nevertheless

    @classmethod
    def of(cls, observations: Floats, lights: Doubles, normals: RoughNormals) -> ShadowCheck:
        """Return the check of observations (P, F) under lights (F, 3), with the smoothed normals that these give."""
        step = max(1, int(np.ceil(np.sqrt(len(observations) / _MAX_PIXELS))))
        part = slice(None, None, step), slice(None, None, step)
        rows = np.zeros(normals.mask.shape, np.intp)
        rows[normals.mask] = np.arange(len(observations))
        coarse = RoughNormals(normals.normals[part], normals.mask[part], normals.outward[part])
        chosen = np.linspace(0, len(lights) - 1, min(len(lights), _MAX_LIGHTS)).astype(int)
        values = observations[rows[part][coarse.mask]].astype(np.float64)
        values /= np.maximum(values.max(axis=1, keepdims=True), 1e-12)
        shading = fit_robustly(values, shadow_weights(values), lights, _FITS)[0] @ lights[chosen].T
        lit = shading > _LIT_SHARE * shading.max(axis=1, keepdims=True).clip(min=1e-12)
        return cls(coarse, lights[chosen], lit, lit & (values[:, chosen] < _DARK_SHARE * shading))

    def shadows(self, matrix: Doubles) -> Shadows:
        """Return the shadows under the lights after a multiplication with a matrix (3, 3)."""
        from splinecli.surface.integration import integrate_normals

        normals = self.normals.transformed(matrix)
        if not self.lit.any():
            return Shadows(0.0, 0.0)
        heights = integrate_normals(normals.normals, normals.mask, stiffness=0)
        cast = cast_shadows(heights, self.lights @ matrix.T)[normals.mask][self.lit]
        dark = self.dark[self.lit]
        common = np.count_nonzero(cast & dark)
        agreement = 0.0
        if common >= max(_FEWEST, _FEWEST_SHARE * len(dark)) and not cast.all() and not dark.all():
            agreement = float(np.corrcoef(cast, dark)[0, 1])
        return Shadows(agreement, float((cast & ~dark).mean()))


def cast_shadows(heights: Doubles, lights: Doubles) -> Bools:
    """Return where a surface shades itself (h, w, F), from heights (h, w) in pixels, NaN outside the object."""
    height, width = heights.shape
    relief = float(np.nanmax(heights) - np.nanmin(heights))
    padded = np.full((3 * height, 3 * width), -np.inf)
    padded[height : 2 * height, width : 2 * width] = np.where(np.isfinite(heights), heights, -np.inf)
    surface = np.where(np.isfinite(heights), heights, np.inf)
    cast = np.zeros((height, width, len(lights)), np.bool_)
    for place, (x, y, z) in enumerate(lights):
        level = float(np.hypot(x, y))
        # A ray that has climbed by the whole relief meets nothing.
        longest = max(height, width) if z <= 0 else min(max(height, width), int(relief * level / z) + 1)
        for step in range(2, longest if level > 0 else 0):
            down, right = round(-y / level * step), round(x / level * step)
            if abs(down) < height and abs(right) < width:
                rows, columns = slice(height + down, 2 * height + down), slice(width + right, 2 * width + right)
                cast[..., place] |= padded[rows, columns] > surface + z / level * step + _MARGIN
    return cast
