"""OpenEXR files of maps, for renderers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from splinecli.errors import OutputError
from splinecli.system.extras import import_extra


def encode_exr(pixels: NDArray[np.floating], attributes: Mapping[str, str]) -> bytes:
    """Return the file of a map of float16 or float32, without loss (ZIP), with texts by name in its header.

    The map is (H, W, 3), the channels R, G and B, or (H, W), the channel Y. Blender reads these names. Raises
    UsageError if OpenEXR is not installed, or OutputError if the folder for temporary files cannot be written.
    """
    library = import_extra("OpenEXR", "exr")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage, **attributes}
    channels = {"Y" if pixels.ndim == 2 else "RGB": np.ascontiguousarray(pixels)}
    # The library writes files only.
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        try:
            library.File(header, channels).write(str(path))
            return path.read_bytes()
        except (OSError, RuntimeError) as error:
            raise OutputError(f"cannot be written ({error})", path=path) from error


def check_exr(formats: Sequence[str]) -> None:
    """Raise UsageError, before the work, if EXR files are to be written and the library is not installed."""
    if "exr" in formats:
        import_extra("OpenEXR", "exr")
