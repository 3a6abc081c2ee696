"""The common rotation of lights and normals that the outline of the object shows.

Where a smooth surface turns away from the camera, its normals are perpendicular to the view and to the outline. Lights
that were turned together turn all normals with them, also those at the outline.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.diagnosis.frame_evidence import outward_directions
from splinecli.fits.robust import fit_robustly
from splinecli.maths.normals import unit

Array = NDArray[np.float64]

MIN_PIXELS = 20  # fewer lit pixels at the outline show no rotation

_SMOOTHING = 0.02
"""Width of the Gaussian filter of the mask, as a share of the root of its area. The filtered mask falls outwards."""

_BORDER = 0.01  # masks of objects that fill the image may leave out a border of this share of its sides

_RIM_Z = 0.25
"""Typical z of normals within a pixel of the outline: pixels have a size, and masks are drawn inside the object."""

_LIT_SHARE, _DARK_SHARE, _MIN_LIT, _FITS = 0.1, 0.02, 4, 6
_EQUAL_WEIGHT_BELOW, _PRIOR = 0.1, 1e-3
_ROUNDS, _CONVERGED = 25, 1e-4


class OutlineTurn(NamedTuple):
    """A rotation that turns the normals at the outline outwards."""

    rotation: Array  # (3,), the rotation vector of lights and normals
    # the median of what remains of the z of these normals; small where the outline is that of a smooth surface
    spread: float

    @property
    def angle_deg(self) -> float:
        """The angle of the rotation."""
        return float(np.degrees(np.linalg.norm(self.rotation)))

    def share(self, part: float) -> Array:
        """Return a part of the rotation (3, 3), from 0 to 1."""
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_rotvec(part * self.rotation).as_matrix())


def turn_at_outline(
    observations: NDArray[np.float32], mask: NDArray[np.bool_], light_directions: Array
) -> OutlineTurn | None:
    """Return the rotation of the lights that the outline shows, or None. The border of the image is no outline.

    Args:
        observations: (P, F), linear, divided by the light intensities.
        mask: (H, W) with P true pixels, in row-major order.
        light_directions: (F, 3), unit.
    """
    from scipy.spatial.transform import Rotation

    normals, outwards = _rim(observations, mask, light_directions)
    if len(normals) < MIN_PIXELS:
        return None
    along = np.cross((0.0, 0.0, 1.0), outwards)
    turn = Rotation.identity()
    for _ in range(_ROUNDS):
        turned = turn.apply(normals)
        # A small turn w adds w x n. The first residual is along the view axis, the second along the outline.
        residuals = np.stack((turned[:, 2] - _RIM_Z, (turned * along).sum(axis=1)))
        slopes = np.stack((np.cross(turned, (0.0, 0.0, 1.0)), np.cross(turned, along)))
        weights = 1 / (np.abs(residuals) + _EQUAL_WEIGHT_BELOW)
        curvature = np.einsum("kp,kpi,kpj->ij", weights, slopes, slopes) + _PRIOR * np.eye(3)
        step = np.linalg.solve(curvature, -np.einsum("kp,kpi,kp->i", weights, slopes, residuals))
        turn = Rotation.from_rotvec(step) * turn
        if np.abs(step).max() < _CONVERGED:
            break
    return OutlineTurn(np.asarray(turn.as_rotvec()), float(np.median(np.abs(residuals[0]))))


def outline_share(mask: NDArray[np.bool_]) -> float:
    """Return the share of the outer boundary of a mask (H, W) that is not at or near the border of the image."""
    boundary = _boundary(mask)
    rows, columns = (1 + round(_BORDER * side) for side in mask.shape)
    inside = boundary[rows:-rows, columns:-columns]
    return int(np.count_nonzero(inside)) / max(int(np.count_nonzero(boundary)), 1)


def _boundary(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels of a mask (H, W) at its outer boundary; holes have none."""
    from scipy.ndimage import binary_erosion, binary_fill_holes

    filled = binary_fill_holes(mask)
    return np.asarray(mask & ~binary_erosion(filled, np.ones((3, 3))))


def _rim(observations: NDArray[np.float32], mask: NDArray[np.bool_], light_directions: Array) -> tuple[Array, Array]:
    """Return the normals (p, 3) of lit pixels at the outline, and the directions (p, 3) outwards, with z = 0."""
    rim = _boundary(mask)
    rim[[0, -1]] = rim[:, [0, -1]] = False
    width = max(1.5, _SMOOTHING * float(np.sqrt(np.count_nonzero(mask))))
    outwards = np.pad(outward_directions(np.pad(mask, 1), width)[1:-1, 1:-1][rim], ((0, 0), (0, 1)))
    values = observations[rim[mask]].astype(np.float64)
    brightest = values.max(axis=1, keepdims=True, initial=0)
    values = values / np.maximum(brightest, 1e-12)
    lit = (values > _LIT_SHARE).astype(np.float64)
    bright = brightest[:, 0] > _DARK_SHARE * np.quantile(observations.max(axis=1), 0.99)
    seen = (lit.sum(axis=1) >= _MIN_LIT) & bright & outwards.any(axis=1)
    if not seen.any():
        return np.empty((0, 3)), np.empty((0, 3))
    fitted, _ = fit_robustly(values[seen], lit[seen] + 1e-3, light_directions, _FITS)
    return unit(fitted), outwards[seen]
