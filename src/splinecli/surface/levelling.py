"""Level a surface by removing the slope of its main plane, or of a plane through given points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splinecli.errors import UsageError
from splinecli.maths import Bools, Float32Array, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.pixel_grid import on_map

_FITS = 50
_CUT = 2.5  # robust standard deviations at which the weight of a residual is halved
_AROUND = 2  # distance in pixels around a given point within which the median height is used


def plane_slopes(
    heights: Floats, points: Sequence[tuple[int, int]] = (), *, aspect: float = 1.0
) -> tuple[float, float]:
    """Return the slopes (dz/dx, dz/dy) of a plane in a height map (H, W), y up.

    The map is NaN outside the object.

    Args:
        points: columns and rows of at least three points on the plane, or () for the dominant plane
            of the surface (iteratively reweighted least squares with Cauchy's weights).
        aspect: height of a pixel relative to its width, which is the unit of the heights.

    Raises:
        UsageError: a point is not on the object, or the points or pixels are on one line.
    """
    if points:
        values = []
        for x, y in points:
            inside = 0 <= y < heights.shape[0] and 0 <= x < heights.shape[1]
            if not inside or not np.isfinite(heights[y, x]):
                raise UsageError(f"the point {x},{y} of --level is not on the object")
            window = tuple(slice(max(0, at - _AROUND), at + _AROUND + 1) for at in (y, x))
            values.append(float(np.nanmedian(heights[window])))
        columns, rows = np.array(points, np.float64).T
        z = np.array(values)
    else:
        rows, columns = np.nonzero(np.isfinite(heights))
        z = heights[rows, columns].astype(np.float64)
    x, y = columns - columns.mean(), (rows.mean() - rows) * aspect
    terms = np.stack((x, y, np.ones(len(z))), axis=1)
    sizes = np.linalg.svd(terms[:, :2], compute_uv=False)
    if sizes[-1] <= 1e-2 * sizes[0]:  # both are 0 for a single point
        given = "points of --level" if points else "pixels of the object"
        hint = "Choose points that span a plane" if points else "Omit --level"
        raise UsageError(f"the {given} are on one line", hint=hint)
    weights, plane = np.ones(len(z)), np.zeros(3)
    for _ in range(1 if points else _FITS):
        weighted = terms * weights[:, None]
        plane = np.linalg.inv(weighted.T @ terms) @ (weighted.T @ z)
        left = np.abs(z - terms @ plane)
        weights = 1 / (1 + (left / max(_CUT * 1.4826 * float(np.median(left)), 1e-9)) ** 2)
    return float(plane[0]), float(plane[1])


def level_heights(
    heights: Floats, slopes: tuple[float, float], *, aspect: float = 1.0
) -> Float64Array:
    """Return heights (H, W) after subtracting a plane with these slopes and a mean of 0 on the
    object.
    """
    rows, columns = np.indices(heights.shape)
    plane = np.asarray(slopes[0] * columns - slopes[1] * aspect * rows, np.float64)
    return np.asarray(heights - (plane - plane[np.isfinite(heights)].mean()), np.float64)


def level_normals(normal_map: Floats, mask: Bools, slopes: tuple[float, float]) -> Float32Array:
    """Return the normals (H, W, 3) of the levelled surface; zero outside the mask."""
    x, y, z = normal_map[mask].astype(np.float64).T
    levelled = unit(np.stack((x + slopes[0] * z, y + slopes[1] * z, z), axis=1))
    return on_map(levelled.astype(np.float32), mask)
