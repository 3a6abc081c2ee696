"""PNG files of pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import OutputError

Picture = NDArray[np.uint8]
"""An RGB picture (H, W, 3) or a gray picture (H, W) of 8 bits."""


def encode_png(picture: NDArray[np.unsignedinteger]) -> bytes:
    """Return the PNG file of an RGB picture (H, W, 3) or a gray picture (H, W) of 8 or 16 bits.

    Raises:
        OutputError: OpenCV cannot encode the picture.
    """
    import cv2

    done, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not done:
        raise OutputError("the picture cannot be encoded as PNG")
    return encoded.tobytes()
