"""Estimate a common tilt of all lights from the curl of the normals.

Rotating all lights rotates all normals with them and changes no residual. However, the normals of a
surface have no curl (Horn, "Shape from shading", 1970), whereas rotated normals do, unless they are
rotated by 180 degrees about the view axis. The rotation with the least curl therefore shows by how
much the lights are tilted, for example because they were measured in the frame of a table that the
camera looks down at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from splinecli.lights.least_curl import curl_terms, normal_derivatives
from splinecli.lights.rough_normals import fitted_normals
from splinecli.maths import Bools, Float64Array, Floats

_GRID_PIXELS, _MAX_PIXELS = 12_000, 1500  # on the grid, and the number of them that is used
_LEAST_Z = 0.34  # slants beyond 70 degrees are left out
_LEAST_SHARE = 0.6  # share of these pixels that must remain after a tilt
_TILTS_DEG, _AZIMUTHS_DEG = (4.0, 8.0, 13.0, 19.0, 26.0, 34.0), np.arange(0.0, 360.0, 20.0)


class Tilt(NamedTuple):
    """The common tilt of the lights, estimated by minimising the curl of the normals."""

    degrees: float  # angle by which the given lights are tilted
    towards_deg: float  # azimuth towards which they are tilted, counter-clockwise from the right
    curl: float  # of the normals under the given lights: mean |curl| over mean derivative
    left: float  # share of this curl that is left after the lights are tilted back
    # the decrease over its standard error, assuming that one pixel in nine is independent
    significance: float
    matrix: Float64Array  # (3, 3) M, where lights @ M' are tilted back

    @property
    def is_clear(self) -> bool:
        """Whether normals that a network estimated leave no doubt about the tilt. Under correct
        lights, rendered metals and hollows with the most interreflection do not reach these
        thresholds.
        """
        return 8 <= self.degrees <= 35 and self.left <= 0.84 and self.significance >= 2.2

    @property
    def cause(self) -> str:
        """The tilt and its evidence, as a sentence about lights."""
        return (
            f"look tilted together, by {self.degrees:.0f} degrees towards the azimuth of"
            f" {self.towards_deg:.0f} degrees, because the normals fit a surface better if the"
            f" lights are tilted back (curl {self.left * self.curl:.3f} instead of"
            f" {self.curl:.3f})."
        )


def find_tilt(normals: Floats, mask: Bools) -> Tilt | None:
    """Return the tilt of the lights that explains most of the curl of normals (H, W, 3) in a mask
    (H, W); None if too few pixels have neighbours.
    """
    vectors = _derivatives(normals, mask)
    if vectors is None:
        return None
    tilts = [np.zeros((1, 2)), *(_around_axis(degrees, _AZIMUTHS_DEG) for degrees in _TILTS_DEG)]
    tried = np.concatenate(tilts)
    least = _LEAST_SHARE * float((vectors[0, :, 2] > _LEAST_Z).mean())
    terms = _curls(vectors, tried, least)
    for reach in (3.0, 1.0):  # refine the search around the best one
        offsets = reach * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2)
        near = tried[terms.sum(axis=1).argmin()] + offsets
        tried = np.concatenate((tried, near))
        terms = np.concatenate((terms, _curls(vectors, near, least)))
    curls = terms.sum(axis=1)
    x, y = tried[curls.argmin()]
    fall = terms[0] - terms[curls.argmin()]
    significance = float(fall.sum() / max(3 * np.sqrt(len(fall)) * fall.std(), 1e-12))
    # The axis (x, y) is perpendicular to the azimuth of the tilt.
    towards = float(np.degrees(np.arctan2(-x, y)) % 360)
    left = float(curls.min() / max(curls[0], 1e-12))
    matrix = _rotations(tried[[curls.argmin()]])[0].T
    return Tilt(float(np.hypot(x, y)), towards, float(curls[0]), left, significance, matrix)


def curl_of(normals: Floats, mask: Bools) -> float:
    """Return the curl of normals (H, W, 3) in a mask (H, W), as in Tilt; NaN if there are too few
    pixels.
    """
    vectors = _derivatives(normals, mask)
    return float("nan") if vectors is None else float(_curls(vectors, np.zeros((1, 2)), 0.0).sum())


def fitted_map(observations: Floats, mask: Bools, light_directions: Float64Array) -> Floats:
    """Return the normals (H, W, 3) of a robust fit to observations (P, F), of the pixels in a mask
    (H, W), under lights (F, 3).
    """
    normals = np.zeros((*mask.shape, 3))
    normals[mask] = fitted_normals(observations, light_directions)
    return normals


def _derivatives(normals: Floats, mask: Bools) -> Float64Array | None:
    step = max(1, round(np.sqrt(np.count_nonzero(mask) / _GRID_PIXELS)))
    part = slice(None, None, step), slice(None, None, step)
    return normal_derivatives(normals[part], mask[part], most=_MAX_PIXELS)


def _around_axis(degrees: float, azimuths_deg: Float64Array) -> Float64Array:
    """Return the rotation vectors (n, 2) in degrees, in the image plane."""
    azimuths = np.radians(azimuths_deg)
    return degrees * np.stack((np.cos(azimuths), np.sin(azimuths)), axis=1)


def _rotations(vectors_deg: Float64Array) -> Float64Array:
    import cv2  # scipy.spatial takes a third of a second to import

    vectors = np.radians(np.pad(vectors_deg, ((0, 0), (0, 1))))
    return np.stack([np.asarray(cv2.Rodrigues(vector)[0], np.float64) for vector in vectors])


def _curls(vectors: Float64Array, tilts: Float64Array, least: float) -> Float64Array:
    """Return curl_terms (n, p) with the lights tilted back by rotation vectors (n, 2)."""
    back = _rotations(tilts).transpose(0, 2, 1)
    return curl_terms(vectors, back, least_z=_LEAST_Z, least_share=least)
