"""Pictures of maps, and PNG files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import OutputError
from splinecli.maths import Bools, Float32Array, Floats, Picture
from splinecli.maths.normals import unit
from splinecli.maths.transfer import encode_srgb


def encode_png(
    picture: NDArray[np.unsignedinteger],
    texts: Mapping[str, str] | None = None,
    *,
    film: bool = False,
) -> bytes:
    """Return the PNG file of an RGB picture (H, W, 3) or a gray picture (H, W) with 8 or 16 bits.

    `texts` are stored by keyword in Latin-1 (PNG specification, tEXt). With `film`, the file states
    the primaries and the transfer curve of BT.709 (cICP). Raises OutputError if OpenCV cannot
    encode the picture.
    """
    import cv2

    done, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not done:
        raise OutputError("the picture cannot be encoded as PNG")
    file = encoded.tobytes()
    # Neither OpenCV nor Pillow writes both 16-bit colours and texts.
    chunks = [f"tEXt{key}\0{text}".encode("latin-1") for key, text in (texts or {}).items()]
    chunks += [b"cICP\x01\x01\x00\x01"] if film else []
    added = b""
    for chunk in chunks:
        added += struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return file[:33] + added + file[33:]  # after the header, which is the first chunk


PREVIEW_LIGHT = (-0.72, 0.48, 0.5)  # a low direction from the upper left, which emphasises relief
# end of the colour scale, chosen to show small errors; larger errors have the last colour
TOP_DEG = 30.0
TICKS = {TOP_DEG * third / 3: f"{TOP_DEG * third / 3:g}" + "+" * (third == 3) for third in range(4)}
TITLE = "angular error (deg)"


def albedo_picture(albedo: Float32Array, mask: Bools) -> Picture:
    """Return a linear albedo map (H, W, 3) as an sRGB picture.

    The brightest 1 % of the pixels are white. The scale depends only on the pixels of the mask (H,
    W), which is not empty.
    """
    white = max(float(np.quantile(albedo[mask].max(axis=1), 0.99)), 1e-12)
    return encode_srgb(albedo / white)


def confidence_picture(confidence_map: Float32Array, _: Bools | None = None) -> Picture:
    """Return a map of probabilities (H, W) as a gray picture (H, W), where 0 is black and 1 is
    white.
    """
    return np.rint(255 * confidence_map).astype(np.uint8)


def preview_picture(normal_map: Float32Array, mask: Bools) -> Picture:
    """Return an sRGB picture (H, W, 3) of the surface in matte white under PREVIEW_LIGHT.

    It is black outside the mask.
    """
    shading = (normal_map @ unit(np.array(PREVIEW_LIGHT, np.float32))) * mask
    return np.repeat(encode_srgb(shading)[..., None], 3, axis=2)


def signed_picture(values: Float32Array, _: Bools, scale: float) -> Picture:
    """Return values (H, W), or the first channel of (H, W, C), as a gray picture.

    0 and NaN are gray, -scale is black, and scale is white.
    """
    first = values if values.ndim == 2 else values[..., 0]
    share = np.nan_to_num(first / scale).clip(-1, 1)
    return np.asarray(np.rint(127.5 + 127.5 * share), np.uint8)


def colour_errors(error_map_deg: Floats) -> Picture:
    """Return the colours (H, W, 3) of errors (H, W) in degrees, white for NaN.

    The scale is viridis, from violet for 0 to yellow.
    """
    import cv2

    known = np.isfinite(error_map_deg)
    shares = np.where(known, error_map_deg, 0) / TOP_DEG
    levels = np.rint(shares.clip(0, 1) * 255).astype(np.uint8)
    picture: Picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[~known] = 255
    return picture


def bounding_box(mask: Bools) -> tuple[slice, slice]:
    """Return the rows and the columns of the bounding box of a mask (H, W)."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
