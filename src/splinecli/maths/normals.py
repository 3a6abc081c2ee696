"""Unit normals: length, angles, and their encoding as RGB images.

Frame: x right, y up, z to the camera (docs/files-and-frames.md).
"""

from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

Convention = Literal["opengl", "directx"]

# The background of an encoded image may be gray, which stands for the zero vector. No real normal is this short.
SHORTEST_IN_PICTURE = 0.5

_Float = TypeVar("_Float", bound=np.floating)


def unit(vectors: NDArray[_Float]) -> NDArray[_Float]:
    """Scale vectors (..., 3) to unit length. Zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    scaled: NDArray[_Float] = np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
    return scaled


def spread_of(normals: NDArray[np.floating]) -> float:
    """Return the second largest standard deviation of unit normals (P, 3): small for a flat object."""
    return float(np.sqrt(np.linalg.eigvalsh(np.cov(normals.T))[1]))


def angle_between_deg(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the angles (...) in degrees between unit vectors a and b (..., 3), float64.

    Uses atan2 of the cross and the dot product, which is accurate near 0 and 180 degrees, where acos loses half its
    digits.
    """
    a64, b64 = np.asarray(a, np.float64), np.asarray(b, np.float64)
    sine = np.linalg.norm(np.cross(a64, b64), axis=-1)
    cosine = np.einsum("...i,...i->...", a64, b64)
    degrees: NDArray[np.float64] = np.degrees(np.arctan2(sine, cosine))
    return degrees


def encode_picture(
    normals: NDArray[np.floating],
    mask: NDArray[np.bool_],
    *,
    bits: int = 16,
    convention: Convention = "opengl",
) -> NDArray[np.unsignedinteger]:
    """Encode a normal map (H, W, 3) as an RGB image of 8 or 16 bits, black outside the mask (H, W).

    A component n becomes (n + 1) / 2 of full scale. Green points up with "opengl" and down with "directx".
    """
    signs = np.array([1.0, 1.0 if convention == "opengl" else -1.0, 1.0])
    top = 2**bits - 1
    picture = np.empty(normals.shape, np.uint8 if bits == 8 else np.uint16)
    # Row by row, so that an image of many megapixels does not need several copies in float64.
    for row, row_normals, row_mask in zip(picture, normals, mask, strict=True):
        row[:] = np.rint((row_normals * signs + 1) / 2 * top) * row_mask[:, None]
    return picture


def describe(convention: Convention) -> str:
    """Return the text that stands in files of normal maps: the frame, and where green points."""
    return f"x right, y up, z to the camera; green is y {'up' if convention == 'opengl' else 'down'}"


def decode_picture(picture: NDArray[np.unsignedinteger]) -> NDArray[np.float64]:
    """Decode an RGB image (..., 3) of 8 or 16 bits, green up, to unit normals.

    Black and middle gray become zero vectors.
    """
    vectors = picture.astype(np.float64) * 2 / np.iinfo(picture.dtype).max - 1
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    is_normal = picture.any(axis=-1, keepdims=True) & (length > SHORTEST_IN_PICTURE)
    decoded: NDArray[np.float64] = np.divide(vectors, length, out=np.zeros_like(vectors), where=is_normal)
    return decoded
