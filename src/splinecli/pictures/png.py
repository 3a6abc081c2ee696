"""PNG files of pictures."""

import struct
import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import OutputError

Picture = NDArray[np.uint8]  # an RGB picture (H, W, 3) or a gray picture (H, W) of 8 bits


_HEAD = 33  # bytes of the signature and of the header, which is the first chunk of a file


def encode_png(
    picture: NDArray[np.unsignedinteger], texts: Mapping[str, str] | None = None, *, film: bool = False
) -> bytes:
    """Return the PNG file of an RGB picture (H, W, 3) or a gray picture (H, W) of 8 or 16 bits.

    It has texts by keyword, in Latin-1 (PNG specification, tEXt). The values of a film have the primaries and the
    transfer curve of BT.709 (cICP). Raises OutputError if OpenCV cannot encode the picture.
    """
    import cv2

    done, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not done:
        raise OutputError("the picture cannot be encoded as PNG")
    file = encoded.tobytes()
    # Neither OpenCV nor Pillow writes both 16-bit colours and texts.
    chunks = [b"tEXt" + f"{keyword}\0{text}".encode("latin-1") for keyword, text in (texts or {}).items()]
    chunks += [b"cICP\x01\x01\x00\x01"] if film else []
    whole = [struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks]
    return file[:_HEAD] + b"".join(whole) + file[_HEAD:]
