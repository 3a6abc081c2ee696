"""Depth maps from elsewhere, such as those of scanners: floating-point .npy, TIFF and OpenEXR files."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.damage import damage_as_input_error
from splinecli.capture.formats.decoding import decode_image
from splinecli.capture.formats.image_size import ExpectedSize, check_stored_size
from splinecli.capture.formats.native_stderr import native_stderr
from splinecli.capture.paths import check_file
from splinecli.errors import InputError
from splinecli.system.extras import import_extra

_EXR_CHANNELS = ("Z", "Y", "R", "V", "depth.Z", "RGB", "RGBA")


def read_depth(path: Path, expected: ExpectedSize) -> NDArray[np.float64]:
    """Return a depth map (H, W) float64, NaN where it is not finite: there, nothing is known.

    Raises:
        InputError: the file cannot be read, is no map of floating-point numbers, or has another size.
        UsageError: the file is an EXR file, and OpenEXR is not installed.
    """
    check_file(path, "a depth map")
    suffix = path.suffix.lower()
    with damage_as_input_error(path, "the depth map is damaged and cannot be read"):
        if suffix == ".npy":
            stored: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
            check_stored_size(stored.shape, stored.dtype.itemsize, path, expected)
        else:
            stored = (_read_exr if suffix == ".exr" else decode_image)(path, expected)
    if stored.ndim == 3 and stored.shape[2] in (1, 3, 4):
        stored = stored[..., 0]
    if stored.ndim != 2 or stored.dtype.kind != "f":
        found = f"{stored.dtype} {' x '.join(map(str, stored.shape))}"
        raise InputError(
            f"found an array of {found}, expected floating-point numbers H x W",
            path=path,
            hint="Save the depth as .npy, floating-point TIFF or EXR",
        )
    depth = np.array(stored, np.float64)
    depth[~np.isfinite(depth)] = np.nan
    return depth


def _read_exr(path: Path, expected: ExpectedSize) -> NDArray[Any]:
    """Return the first channel of an EXR file that may hold a depth."""
    library = import_extra("OpenEXR", "exr")
    with native_stderr():
        low, high = library.File(str(path), header_only=True).header()["dataWindow"]
    shape = int(high[1] - low[1] + 1), int(high[0] - low[0] + 1)
    check_stored_size(shape, 4, path, expected)
    # Of damaged pixels, the library only prints a warning; stdout belongs to the product of a command.
    with redirect_stdout(io.StringIO()) as printed, native_stderr():
        channels = library.File(str(path)).channels()
    if printed.getvalue():
        raise InputError("the EXR file is damaged and cannot be read", path=path)
    for name in (*_EXR_CHANNELS, *channels):
        if name in channels:
            return np.asarray(channels[name].pixels)
    raise InputError("the EXR file has no channel", path=path)
