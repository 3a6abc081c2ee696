"""The relief of a surface: its heights without the shape in the large, which shows dents, scratches and tool marks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.surface.integration import integrate_normals

RELIEF_WIDTH = 64.0
"""Waves of this width in pixels keep half of their height; the normals' small errors over wider ones do not count."""


def relief_of_normals(
    normal_map: NDArray[np.float32], mask: NDArray[np.bool_], width: float = RELIEF_WIDTH
) -> NDArray[np.float32]:
    """Return the relief (H, W) in pixels, positive towards the camera; NaN outside the mask.

    It is the surface of the normals, pulled to height zero. Of a wave of k radians per pixel, this share is kept:
    k^2 / (k^2 + (2 pi / width)^2).

    Args:
        normal_map: (H, W, 3), unit in the mask; x right, y up, z to the camera.
        mask: (H, W).
        width: see RELIEF_WIDTH.

    Raises:
        InputError: the mask is empty.
    """
    flat = np.zeros(mask.shape)
    return integrate_normals(normal_map, mask, stiffness=0, prior=flat, prior_detail=width).astype(np.float32)
