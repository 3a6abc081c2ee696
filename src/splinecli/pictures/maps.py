"""Pictures of the maps of one capture: albedo, confidence, and a preview of the surface."""

import numpy as np
from numpy.typing import NDArray

from splinecli.maths.normals import unit
from splinecli.maths.transfer import encode_srgb
from splinecli.pictures.png import Picture

PREVIEW_LIGHT = (-0.72, 0.48, 0.5)  # direction: low, from the upper left, which shows relief best
WHITE_QUANTILE = 0.99  # of the largest channel: this albedo is white in a picture


def albedo_picture(albedo: NDArray[np.float32], mask: NDArray[np.bool_]) -> Picture:
    """Return an albedo map as an sRGB picture (H, W, 3), scaled so that the brightest 1 % of the pixels are white.

    Args:
        albedo: (H, W, 3), linear.
        mask: (H, W), not empty; the scale depends on these pixels alone.
    """
    white = max(float(np.quantile(albedo[mask].max(axis=1), WHITE_QUANTILE)), 1e-12)
    return encode_srgb(albedo / white)


def confidence_picture(confidence_map: NDArray[np.float32]) -> Picture:
    """Return a map of probabilities (H, W) as a gray picture (H, W): 0 is black, 1 is white."""
    return np.rint(255 * confidence_map).astype(np.uint8)


def preview_picture(normal_map: NDArray[np.float32], mask: NDArray[np.bool_]) -> Picture:
    """Return an sRGB picture (H, W, 3) of the surface, matte white under PREVIEW_LIGHT.

    It is black outside the mask (H, W).
    """
    shading = (normal_map @ unit(np.array(PREVIEW_LIGHT, np.float32))) * mask
    return np.repeat(encode_srgb(shading)[..., None], 3, axis=2)


CURVATURE_SCALE, RELIEF_SCALE = 0.05, 1.0  # by default white in a picture: mean curvature in 1/pixel, relief in pixels


def signed_picture(values: NDArray[np.float32], scale: float) -> Picture:
    """Return values (H, W) as a gray picture (H, W): 0 and NaN are gray, -scale is black, scale is white."""
    share = np.nan_to_num(values / scale).clip(-1, 1)
    return np.asarray(np.rint(127.5 + 127.5 * share), np.uint8)
