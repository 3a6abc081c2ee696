"""Functions of unit normals: length, angles and errors in degrees, pictures, slopes and curvatures.

Frame: x right, y up, z to the camera (docs/files-and-frames.md).

Slopes and curvatures are computed without integration, so they are not affected by drift or tears.
For a surface z(x, y) with unit normals n = (-p, -q, 1) / sqrt(1 + p^2 + q^2), let J be the matrix
of the derivatives of (nx, ny) with respect to x and y. Its determinant is the Gaussian curvature,
because normals rotate as much as the surface does (Gauss), and half its trace is the mean curvature
(do Carmo, Differential Geometry of Curves and Surfaces, 1976, 3-3).
"""

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from splinecli.maths import Bools, Float32Array, Float64Array, Floats

Convention = Literal["opengl", "directx"]

# Shortest vector of a normal in a picture, whose background may be gray, which represents the zero
# vector
SHORTEST_IN_PICTURE = 0.5
_Float = TypeVar("_Float", bound=np.floating)


def unit(vectors: NDArray[_Float]) -> NDArray[_Float]:
    """Return vectors (..., 3) scaled to unit length. Zero vectors remain zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    scaled: NDArray[_Float] = np.divide(
        vectors, length, out=np.zeros_like(vectors), where=length > 0
    )
    return scaled


def spread_of(normals: Floats) -> float:
    """Return the second largest standard deviation of unit normals (P, 3), which is small for a
    flat object.
    """
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(normals.T))[1]))


def angle_between_deg(a: Floats, b: Floats) -> Float64Array:
    """Return the angles (...) in degrees between unit vectors a and b (..., 3), float64.

    The computation uses atan2 of the cross and the dot product, which is accurate near 0 and 180
    degrees, where acos loses half of its digits.
    """
    a64, b64 = np.asarray(a, np.float64), np.asarray(b, np.float64)
    sine = np.linalg.norm(np.cross(a64, b64), axis=-1)
    cosine = np.einsum("...i,...i->...", a64, b64)
    degrees: Float64Array = np.degrees(np.arctan2(sine, cosine))
    return degrees


def encode_picture(
    normals: Floats,
    mask: Bools,
    *,
    bits: int = 16,
    convention: Convention = "opengl",
) -> NDArray[np.unsignedinteger]:
    """Return a normal map (H, W, 3) as an 8- or 16-bit RGB image, black outside the mask (H, W).

    A component n becomes (n + 1) / 2 of full scale. Green points up with "opengl" and down with
    "directx".
    """
    signs = np.array([1.0, 1.0 if convention == "opengl" else -1.0, 1.0])
    top = 2**bits - 1
    picture = np.empty(normals.shape, np.uint8 if bits == 8 else np.uint16)
    # Row by row, to avoid several float64 copies of an image with many megapixels.
    for row, row_normals, row_mask in zip(picture, normals, mask, strict=True):
        row[:] = np.rint((row_normals * signs + 1) / 2 * top) * row_mask[:, None]
    return picture


def describe(convention: Convention) -> str:
    """Return the description stored in normal map files: the frame, and the direction of green."""
    green = "up" if convention == "opengl" else "down"
    return f"x right, y up, z to the camera; green is y {green}"


def decode_picture(picture: NDArray[np.unsignedinteger]) -> Float64Array:
    """Return unit normals from an 8- or 16-bit RGB image (..., 3) whose green points up.

    Black and middle gray become zero vectors.
    """
    vectors = picture.astype(np.float64) * 2 / np.iinfo(picture.dtype).max - 1
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    is_normal = picture.any(axis=-1, keepdims=True) & (length > SHORTEST_IN_PICTURE)
    decoded: Float64Array = np.divide(vectors, length, out=np.zeros_like(vectors), where=is_normal)
    return decoded


@dataclass(frozen=True)
class AngularErrors:
    """Statistics of the angular error over the pixels with ground truth."""

    # mean (MAE), median and 90th percentile in degrees
    mean: float
    median: float
    p90: float
    # shares of the pixels, 0 to 1, with an error below 5 and below 10 degrees
    under_5: float
    under_10: float


def angular_error_map_deg(normals: Floats, ground_truth: Floats, mask: Bools) -> Float32Array:
    """Return the angular errors (H, W) of a normal map (H, W, 3) in degrees.

    They are NaN outside the mask (H, W) and where the ground truth (H, W, 3) is zero. The sign of a
    normal matters: a normal in the opposite direction has an error of 180 degrees, not 0.
    """
    scored = mask & ground_truth.any(axis=-1)
    errors = np.full(mask.shape, np.nan, np.float32)
    # Row by row, because a float64 map with many megapixels would need several gigabytes.
    for row, chosen in enumerate(scored):
        errors[row, chosen] = angle_between_deg(normals[row, chosen], ground_truth[row, chosen])
    return errors


def summarise_errors(errors_deg: Floats) -> AngularErrors | None:
    """Return the statistics of angular errors in degrees of any shape, ignoring NaN, or None if all
    are NaN.
    """
    errors = errors_deg[np.isfinite(errors_deg)].astype(np.float64)
    if not errors.size:
        return None
    return AngularErrors(
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        p90=float(np.percentile(errors, 90)),
        under_5=float((errors < 5).mean()),
        under_10=float((errors < 10).mean()),
    )


def gradient_of_normals(normal_map: Float32Array, mask: Bools) -> Float32Array:
    """Return the slopes p = dz/dx and q = dz/dy, (H, W, 2).

    They are NaN outside the mask (H, W) and where the surface is too steep. The normals (H, W, 3)
    are unit in the mask; x right, y up, z to the camera.
    """
    # Normals beyond 87 degrees from the camera axis have no usable slope.
    z = np.where(mask & (normal_map[..., 2] >= 0.05), normal_map[..., 2], np.nan)
    return np.asarray(-normal_map[..., :2] / z[..., None], np.float32)


def curvature_of_normals(normal_map: Float32Array, mask: Bools, sigma: float = 2.0) -> Float32Array:
    """Return mean and Gaussian curvature (H, W, 2), in 1/pixel and 1/pixel^2; NaN outside the mask.

    Both are positive on a bump: for a sphere of radius R, they are 1/R and 1/R^2. A hollow has a
    negative mean curvature. The normals are filtered with a standard deviation of `sigma` pixels,
    which reduces noise by its square.
    """
    (xx, xy), (yx, yy) = (
        _derivatives(normal_map[..., component], mask, sigma) for component in (0, 1)
    )
    curvatures = np.stack(((xx + yy) / 2, xx * yy - xy * yx), axis=-1)
    return np.where(mask[..., None], curvatures, np.nan).astype(np.float32)


def _derivatives(
    values: Float32Array, mask: Bools, sigma: float
) -> tuple[Float64Array, Float64Array]:
    """Return the derivatives (H, W) of values with respect to x (right) and y (up).

    They are the slopes of planes fitted to the values in the mask with Gaussian weights, computed
    from moments, which are derivatives of Gaussians. Away from the edge of the mask, they equal the
    derivatives of the filtered values, which would be too small at the edge.
    """
    from scipy.ndimage import gaussian_filter

    def moment(of: Float64Array, down: int, right: int) -> Float64Array:
        """Return the weighted sum of `of` times offsets to these powers."""
        found = sigma ** (2 * (down + right)) * gaussian_filter(
            of, sigma, order=(down, right), mode="constant"
        )
        return np.asarray(found + (sigma**2 * moment(of, 0, 0) if 2 in (down, right) else 0))

    inside = mask.astype(np.float64)
    inner = np.where(mask, values, 0).astype(np.float64)
    weight = np.maximum(moment(inside, 0, 0), 1e-9)
    right, down, value = (
        moment(*m) / weight for m in ((inside, 0, 1), (inside, 1, 0), (inner, 0, 0))
    )
    least = 1e-3 * sigma**2  # for masks one pixel wide
    rr = moment(inside, 0, 2) / weight - right**2 + least
    dd = moment(inside, 2, 0) / weight - down**2 + least
    rd = moment(inside, 1, 1) / weight - right * down
    of_right = moment(inner, 0, 1) / weight - value * right
    of_down = moment(inner, 1, 0) / weight - value * down
    determinant = np.maximum(rr * dd - rd**2, least**2)
    to_right, to_down = dd * of_right - rd * of_down, rr * of_down - rd * of_right
    return to_right / determinant, -to_down / determinant
