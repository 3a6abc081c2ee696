"""Find the outline of the object, and the common rotation of lights and normals that it reveals.

Where a smooth surface curves away from the camera, its normals are perpendicular to the viewing
direction and to the outline. If all lights are rotated, so are all estimated normals, including the
normals at the outline.
"""

from typing import NamedTuple

import numpy as np

from splinecli.lights.rough_normals import outward_directions
from splinecli.maths import Bools, Float64Array, Floats
from splinecli.maths.normals import unit
from splinecli.maths.robust import fit_robustly

DARK_SHARE = 0.02  # pixels below this share of the brightest hundredth are dark


class OutlineTurn(NamedTuple):
    """A rotation after which the normals at the outline point outwards."""

    rotation: Float64Array  # (3,), the rotation vector of lights and normals
    # median absolute residual of the normals' z; small if the outline is formed by a smooth surface
    spread: float

    @property
    def angle_deg(self) -> float:
        """The angle of the rotation."""
        return float(np.degrees(np.linalg.norm(self.rotation)))

    def share(self, part: float) -> Float64Array:
        """Return the matrix (3, 3) of a fraction of the rotation, from 0 to 1."""
        import cv2

        return np.asarray(cv2.Rodrigues(part * self.rotation)[0], np.float64)


def turn_at_outline(
    observations: Floats, mask: Bools, light_directions: Float64Array
) -> OutlineTurn | None:
    """Return the rotation of the lights that the outline reveals, or None if too few pixels show
    it.

    The border of the image is ignored. The observations (P, F) are linear, divided by the light
    intensities. The mask (H, W) has P true pixels, in row-major order, and the directions (F, 3)
    are unit.
    """
    import cv2  # scipy.spatial takes a third of a second to import

    normals, outwards = _rim(observations, mask, light_directions)
    if len(normals) < 20:  # too few lit pixels at the outline
        return None
    along = np.cross((0.0, 0.0, 1.0), outwards)
    turn = np.eye(3)
    for _ in range(25):
        turned = normals @ turn.T
        # A small rotation w adds w x n. The first residual is along the view axis, the second along
        # the outline. Normals within a pixel of the outline have a z of about 0.25, because pixels
        # have an extent and masks end inside the object.
        residuals = np.stack((turned[:, 2] - 0.25, (turned * along).sum(axis=1)))
        slopes = np.stack((np.cross(turned, (0.0, 0.0, 1.0)), np.cross(turned, along)))
        weights = 1 / (np.abs(residuals) + 0.1)
        curvature = np.einsum("kp,kpi,kpj->ij", weights, slopes, slopes) + 1e-3 * np.eye(3)
        step = np.linalg.solve(curvature, -np.einsum("kp,kpi,kp->i", weights, slopes, residuals))
        turn = np.asarray(cv2.Rodrigues(step)[0]) @ turn
        if np.abs(step).max() < 1e-4:
            break
    rotation = np.asarray(cv2.Rodrigues(turn)[0][:, 0], np.float64)
    return OutlineTurn(rotation, float(np.median(np.abs(residuals[0]))))


def is_outlined(mask: Bools) -> bool:
    """Return whether a mask (H, W) contains the outline of the object, so that the object fits into
    the image.
    """
    return outline_share(mask) >= 0.5


def outline_share(mask: Bools) -> float:
    """Return the share of a mask's (H, W) outer boundary that is not at the border of the image."""
    boundary = _boundary(mask)
    # Masks of objects that fill the image may leave out a border of this width
    rows, columns = (1 + round(0.01 * side) for side in mask.shape)
    inside = boundary[rows:-rows, columns:-columns]
    return int(np.count_nonzero(inside)) / max(int(np.count_nonzero(boundary)), 1)


def _boundary(mask: Bools) -> Bools:
    """Return the pixels of a mask (H, W) at its outer boundary, without its holes."""
    from scipy.ndimage import binary_erosion, binary_fill_holes

    filled = binary_fill_holes(mask)
    return np.asarray(mask & ~binary_erosion(filled, np.ones((3, 3))))


def _rim(
    observations: Floats, mask: Bools, light_directions: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the normals (p, 3) of lit pixels at the outline, and outward directions (p, 3) with z
    = 0.
    """
    rim = _boundary(mask)
    rim[[0, -1]] = rim[:, [0, -1]] = False
    # The filtered mask decreases outwards. The width of the Gaussian filter is a share of the
    # square root of the mask's area.
    width = max(1.5, 0.02 * float(np.sqrt(np.count_nonzero(mask))))
    outwards = np.pad(outward_directions(np.pad(mask, 1), width)[1:-1, 1:-1][rim], ((0, 0), (0, 1)))
    values = observations[rim[mask]].astype(np.float64)
    brightest = values.max(axis=1, keepdims=True, initial=0)
    values = values / np.maximum(brightest, 1e-12)
    lit = (values > 0.1).astype(np.float64)
    bright = brightest[:, 0] > DARK_SHARE * np.quantile(observations.max(axis=1), 0.99)
    seen = (lit.sum(axis=1) >= 4) & bright & outwards.any(axis=1)
    if not seen.any():
        return np.empty((0, 3)), np.empty((0, 3))
    fitted, _ = fit_robustly(values[seen], lit[seen] + 1e-3, light_directions, 6)
    return unit(fitted), outwards[seen]
