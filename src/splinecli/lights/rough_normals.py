"""Rough normals under given lights, and the evidence about the lights from these normals and from
cast shadows.

Lights in a wrong frame fit the images as well as correct ones. But the normals of a surface have no
curl (Horn, "Shape from shading", 1970; Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity",
IJCV 1999), and they point outwards at the outline of the object (Ikeuchi and Horn 1981). Therefore,
the normals show whether the lights are in the right frame.

The shadows that a surface casts on itself distinguish bumps from hollows. If x and y of all lights
are negated, the normals belong to the surface with its depth inverted. Shading and attached shadows
remain the same (Belhumeur, Kriegman and Yuille, IJCV 1999), but cast shadows move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splinecli.maths import Bools, Float64Array, Floats
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.robust import fit_robustly, shadow_weights

# standard deviation in pixels for smoothing the normals before they are differentiated
SMOOTHING = 1.5
RIM_PIXELS = 3  # width of the rim inside the outline, in pixels
# a rim pixel is considered steep if its normal is at least 45 degrees from the viewing direction
STEEP_Z = 0.7
_LOWEST_Z = 0.2  # limits slopes, which are unbounded towards the outline
_FITS = 5  # weighted fits for each pixel
_TURNED_PIXELS = 2000


@dataclass(frozen=True, eq=False)
class RoughNormals:
    """Normals on a grid of pixels."""

    normals: Float64Array  # (h, w, 3), unit in the mask, zero outside
    mask: Bools  # (h, w)
    # (h, w, 2), unit, x right and y up, pointing out of the mask at the rim; zero elsewhere
    outward: Float64Array

    @property
    def rim_steepness(self) -> float:
        """The share of the rim's pixels that are steep. It is the same in all frames of the
        lights.
        """
        rim = self.outward.any(axis=2)
        return float((self.normals[rim][:, 2] < STEEP_Z).mean()) if rim.any() else 0.0

    def transformed(self, matrix: Float64Array) -> RoughNormals:
        """Return the normals for lights multiplied by a matrix (3, 3)."""
        normals = self.normals @ np.linalg.inv(matrix)
        return RoughNormals(
            np.where(self.mask[..., None], unit(normals), 0.0), self.mask, self.outward
        )

    def curl(self) -> float:
        """Return the median |curl| of the slopes divided by their median derivative; 0 for a
        surface.
        """
        if (found := self._derivatives_inside()) is None:
            return float("nan")
        (p_x, p_y), (q_x, q_y) = found
        size = np.sqrt(p_x**2 + p_y**2 + q_x**2 + q_y**2)
        return float(np.median(np.abs(p_y - q_x)) / max(np.median(size), 1e-12))

    def least_curl_deg(self, *, mirrored: bool) -> float:
        """Return the rotation of the lights that minimises the curl of the normals, in degrees, -90
        to 89.

        The lights rotate about the view axis, from x to y; if `mirrored`, their x is negated first.
        After a further rotation by 180 degrees, the curl is the same. NaN if the mask has too few
        pixels.
        """
        if (found := self._derivatives_inside()) is None:
            return float("nan")
        (p_x, p_y), (q_x, q_y) = found
        p_x, p_y = (-p_x, -p_y) if mirrored else (p_x, p_y)
        step = max(1, len(p_x) // _TURNED_PIXELS)
        angles = np.radians(np.arange(-90, 90))[:, None]
        # The slopes rotate with the normals.
        curls = np.cos(angles) * (p_y - q_x)[::step] - np.sin(angles) * (p_x + q_y)[::step]
        return float(np.median(np.abs(curls), axis=1).argmin() - 90)

    def _derivatives_inside(
        self,
    ) -> tuple[tuple[Float64Array, Float64Array], tuple[Float64Array, Float64Array]] | None:
        """Return the derivatives (n,) of both slopes to the right and upwards at inner pixels.

        Return None if there are too few pixels.
        """
        from scipy.ndimage import binary_erosion

        z = np.maximum(self.normals[..., 2], _LOWEST_Z)
        inside = binary_erosion(self.mask & (self.normals[..., 2] > _LOWEST_Z))
        if inside.sum() < 50:
            return None
        p, q = (_derivatives(-self.normals[..., axis] / z) for axis in (0, 1))
        return (p[0][inside], p[1][inside]), (q[0][inside], q[1][inside])

    def rim(self) -> float:
        """Return the mean cosine, in the image plane, between normals and the outward direction at
        the rim.

        Only steep pixels are used. The mean is 1 for a closed convex outline, 0 if one axis is
        flipped, and -1 if both are.
        """
        steep = self.outward.any(axis=2) & (self.normals[..., 2] < STEEP_Z)
        if not steep.any():
            return float("nan")
        along = unit(self.normals[steep][:, :2])
        return float((along * self.outward[steep]).sum(axis=1).mean())


def rough_normals(
    observations: Floats, light_directions: Float64Array, mask: Bools
) -> RoughNormals:
    """Return smoothed normals from a robust fit that minimises absolute deviations.

    Observations are (P, F), at the pixels of a mask (H, W); light directions (F, 3).
    """
    return smooth_normals(fitted_normals(observations, light_directions), mask)


def fitted_normals(observations: Floats, light_directions: Float64Array) -> Float64Array:
    """Return unit normals (P, 3) that fit observations (P, F) with the least absolute deviations.

    Lights are (F, 3) or (P, F, 3).
    """
    values = observations.astype(np.float64)
    values /= np.maximum(values.max(axis=1, keepdims=True), 1e-12)
    return unit(fit_robustly(values, shadow_weights(values), light_directions, _FITS)[0])


def median_turn_deg(
    observations: Floats,
    lights: Float64Array,
    other_lights: Float64Array,
    other_observations: Floats | None = None,
) -> float:
    """Return the median angle in degrees between the normals from two readings of a capture.

    If the second reading is right, this is the error of the first. Each is a robust fit of
    observations (P, F) under lights (F, 3) or (P, F, 3). By default, both have the same
    observations.
    """
    others = observations if other_observations is None else other_observations
    step = max(1, len(observations) // _TURNED_PIXELS)
    normals = []
    for values, directions in ((observations, lights), (others, other_lights)):
        own = directions if directions.ndim == 2 else directions[::step]
        normals.append(fitted_normals(values[::step], own))
    return float(np.median(angle_between_deg(*normals)))


def smooth_normals(vectors: Floats, mask: Bools) -> RoughNormals:
    """Return smoothed normals in the directions of vectors (P, 3), at the pixels of a mask (H,
    W).
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    normals = np.zeros((*mask.shape, 3))
    normals[mask] = unit(vectors)
    smooth = gaussian_filter(normals, (SMOOTHING, SMOOTHING, 0))
    smooth = np.where(mask[..., None], unit(smooth), 0.0)
    padded = np.pad(mask, RIM_PIXELS + 1, mode="edge")  # the border of the image is not a rim
    if padded.all():
        return RoughNormals(smooth, mask, np.zeros((*mask.shape, 2)))
    inner = slice(RIM_PIXELS + 1, -RIM_PIXELS - 1)
    rim = (mask & (distance_transform_edt(padded)[inner, inner] <= RIM_PIXELS))[..., None]
    outward = np.where(rim, outward_directions(padded, 2 * SMOOTHING)[inner, inner], 0.0)
    return RoughNormals(smooth, mask, outward)


def outward_directions(mask: Bools, sigma: float) -> Float64Array:
    """Return unit vectors (h, w, 2), x right and y up, out of a mask smoothed by `sigma` pixels; or
    zero.
    """
    from scipy.ndimage import gaussian_filter

    return unit(-np.stack(_derivatives(gaussian_filter(mask.astype(np.float64), sigma)), axis=2))


def _derivatives(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the derivatives to the right and upwards, which are zero along a side of one pixel."""
    downwards, right = (
        np.gradient(values, axis=axis) if values.shape[axis] > 1 else np.zeros_like(values)
        for axis in (0, 1)
    )
    return np.asarray(right), np.asarray(-downwards)


MISSING, MISSING_OF_OTHER = 0.02, 0.1
"""Lights are doubtful if more than the first share of the lit observations should be in cast shadow
but are not, and if this share is smaller by the second factor in the other reading."""


_MAX_PIXELS = 6000
# Shadows are judged where the shading exceeds the first share of the pixel's brightest one. A pixel
# is dark below the second share of its shading.
_LIT_SHARE, _DARK_SHARE = 0.25, 0.4
_MARGIN = 0.5  # smallest height of a surface above a ray that it blocks, in pixels


@dataclass(frozen=True, eq=False)
class Shadows:
    """How well the cast shadows of a surface agree with dark observations that should be lit."""

    agreement: float  # correlation, from -1 to 1; 0 if too few are dark
    missing: float  # share of the lit observations that should be in cast shadow, but are bright

    def evidence(self, other: Shadows) -> float:
        """Return the evidence for another reading against this one, as an advantage in
        light_check.py.
        """
        # The factor is relative to the weights in light_check.py. The agreement of synthetic bumps
        # is 0.2 to 0.9 under correct lights and below 0.02 under negated ones; for photographs of
        # statues, it is 0.07 to 0.3 and below 0.01.
        found = 5.0 * (other.agreement - self.agreement)
        if self.missing > MISSING and other.missing < MISSING_OF_OTHER * self.missing:
            return found + 1
        if other.missing > MISSING and self.missing < MISSING_OF_OTHER * other.missing:
            return found - 1
        return found

    def leaves_open(self, other: Shadows) -> bool:
        """Return whether this reading predicts more shadows that are missing than another one
        does.
        """
        # If both readings lack a similar number of shadows, the images were rendered without cast
        # shadows, which is not evidence against the lights.
        return self.missing > 0.01 and other.missing < 0.75 * self.missing


@dataclass(frozen=True, eq=False)
class ShadowCheck:
    """Dark observations of a sample, for comparison with the shadows of its surface under its
    lights.
    """

    normals: RoughNormals  # on a coarser grid
    lights: Float64Array  # (f, 3)
    lit: Bools  # (p, f), whether a matte pixel would be bright
    dark: Bools  # (p, f), whether the pixel is dark although it should be lit

    @classmethod
    def of(cls, observations: Floats, lights: Float64Array, normals: RoughNormals) -> ShadowCheck:
        """Return the check of observations (P, F) under lights (F, 3), with smoothed normals from
        these.
        """
        step = max(1, int(np.ceil(np.sqrt(len(observations) / _MAX_PIXELS))))
        part = slice(None, None, step), slice(None, None, step)
        rows = np.zeros(normals.mask.shape, np.intp)
        rows[normals.mask] = np.arange(len(observations))
        known = normals.normals[part].any(axis=2, keepdims=True)
        # Black pixels have no normal.
        facing = np.where(known, normals.normals[part], (0.0, 0.0, 1.0))
        coarse = RoughNormals(facing, normals.mask[part], normals.outward[part])
        chosen = np.linspace(0, len(lights) - 1, min(len(lights), 24)).astype(int)
        values = observations[rows[part][coarse.mask]].astype(np.float64)
        values /= np.maximum(values.max(axis=1, keepdims=True), 1e-12)
        shading = fit_robustly(values, shadow_weights(values), lights, _FITS)[0] @ lights[chosen].T
        lit = shading > _LIT_SHARE * shading.max(axis=1, keepdims=True).clip(min=1e-12)
        return cls(coarse, lights[chosen], lit, lit & (values[:, chosen] < _DARK_SHARE * shading))

    def shadows(self, matrix: Float64Array) -> tuple[Shadows, Shadows]:
        """Return the shadows under lights multiplied by a matrix (3, 3), and under the opposite
        lights.

        For opposite lights, x and y are negated, and the heights of the surface are inverted.
        """
        from splinecli.surface.integration import integrate_normals

        if not self.lit.any():
            return Shadows(0.0, 0.0), Shadows(0.0, 0.0)
        normals, lights = self.normals.transformed(matrix), self.lights @ matrix.T
        heights = integrate_normals(normals.normals, normals.mask, discontinuity=0)
        return self._shadows(heights, lights), self._shadows(-heights, lights * (-1, -1, 1))

    def _shadows(self, heights: Float64Array, lights: Float64Array) -> Shadows:
        cast = cast_shadows(heights, lights)[self.normals.mask][self.lit]
        dark = self.dark[self.lit]
        common = np.count_nonzero(cast & dark)
        agreement = 0.0
        # Fewer common shadows may be due to noise and highlights.
        if common >= max(20, 0.001 * len(dark)) and not cast.all() and not dark.all():
            agreement = float(np.corrcoef(cast, dark)[0, 1])
        return Shadows(agreement, float((cast & ~dark).mean()))


def cast_shadows(heights: Float64Array, lights: Float64Array) -> Bools:
    """Return where a surface casts shadows on itself (h, w, F) under lights (F, 3).

    The heights (h, w) are in pixels, NaN outside the object.
    """
    height, width = heights.shape
    relief = float(np.nanmax(heights) - np.nanmin(heights))
    padded = np.full((3 * height, 3 * width), -np.inf)
    padded[height : 2 * height, width : 2 * width] = np.where(
        np.isfinite(heights), heights, -np.inf
    )
    surface = np.where(np.isfinite(heights), heights, np.inf)
    cast = np.zeros((height, width, len(lights)), np.bool_)
    for place, (x, y, z) in enumerate(lights):
        level = float(np.hypot(x, y))
        # A ray that has risen above the whole relief can no longer be blocked.
        longest = (
            max(height, width) if z <= 0 else min(max(height, width), int(relief * level / z) + 1)
        )
        for step in range(2, longest if level > 0 else 0):
            down, right = round(-y / level * step), round(x / level * step)
            if abs(down) < height and abs(right) < width:
                rows, columns = (
                    slice(height + down, 2 * height + down),
                    slice(width + right, 2 * width + right),
                )
                cast[..., place] |= padded[rows, columns] > surface + z / level * step + _MARGIN
    return cast
