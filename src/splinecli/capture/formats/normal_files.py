"""Read normal maps and ground truth from .mat, .npy, text and picture files, and depth maps, for
example from scanners.

Frame: x right, y up, z to the camera. A file is one of

- MATLAB .mat, with the array Normal_gt or a single H x W x 3 array, or .npy. Unsigned integers are
  treated as the colours of a picture;
- .txt, for ground truth only, with H*W rows of x y z in row-major order;
- a picture with n = 2 v / full scale - 1 that is black or mid-gray where there is no normal; a
  floating-point TIFF contains n itself.

Vectors are scaled to unit length; zero and non-finite vectors are treated as missing. Depth maps
are floating-point .npy, TIFF and OpenEXR files.
"""

import io
import math
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from splinecli.capture.formats import images, mat
from splinecli.capture.formats.decoders import damage_as_input_error, native_stderr
from splinecli.capture.formats.facts import UnknownFormatError, read_header
from splinecli.capture.formats.numbers import (
    MOST_TEXT,
    check_text_length,
    read_number_rows,
)
from splinecli.errors import InputError
from splinecli.maths import Array, Bools, Float32Array, Float64Array
from splinecli.maths.normals import SHORTEST_IN_PICTURE, Convention, decode_picture, unit
from splinecli.maths.pixel_grid import slices
from splinecli.system.files import StrPath, check_file, utf8_name
from splinecli.system.machine import import_extra

_LARGEST = 1e100  # squares of larger values, which occur in damaged files, may overflow
_MOST_CHANNELS = 256  # in an EXR file; renderers write up to about a hundred
_BLOCK = 1 << 20  # pixels scaled at a time, because float64 takes much memory


class _Stored(NamedTuple):
    """Vectors as stored in a file."""

    values: Array  # (H, W, 3); of a picture, colours v with n = 2 v / full scale - 1
    alpha: Array | None  # (H, W), the alpha channel of a picture
    is_picture: bool


def read_normal_map(
    path: StrPath, mask: Bools | Path | None = None, *, convention: Convention = "opengl"
) -> Float32Array:
    """Return a normal map (H, W, 3) float32 of any size: unit vectors with y up, or zero where
    there is no normal.

    Raises InputError if the file cannot be read, does not contain a normal map, or differs from the
    mask in size.

    Args:
        path: any of the files above except text.
        mask: (H, W), True at the pixels whose normals are read; or the path of a mask image.
            Transparent pixels of a picture are also excluded.
        convention: whether green points up ("opengl") or down ("directx") in a picture.
    """
    path = Path(path)
    expected = None
    if mask is not None:
        # The sizes in both headers are compared before either file is decoded.
        shape = read_header(mask).size[0] if isinstance(mask, Path) else mask.shape
        expected = images.ExpectedSize(shape, "the mask", "a normal map")
    stored = _read_vectors(path, expected)
    if isinstance(mask, Path):
        mask = images.read_mask(mask, images.ExpectedSize(stored.values.shape, path.name, "a mask"))
    wanted = np.ones(stored.values.shape[:2], np.bool_) if mask is None else mask
    opaque = images.cut_out(stored.alpha)
    if opaque is not None:
        wanted = wanted & opaque
    normals = _to_normals(stored, wanted, path, check_floats=True)
    if stored.is_picture and convention == "directx":
        normals[..., 1] *= -1
    return normals


def read_ground_truth(path: StrPath, mask: Bools) -> tuple[Float32Array, bool]:
    """Return ground-truth normals (H, W, 3) float32, and whether they were flipped vertically.

    Vectors have unit length, or are zero outside the mask and in pixels without ground truth. A
    text file is flipped vertically if it then fits the mask clearly better, as the normal.txt of
    DiLiGenT's Harvest does. Raises InputError if the file cannot be read, differs from the mask in
    size, or contains no normal inside the mask.

    Args:
        path: any of the files above, but pictures only as PNG, TIFF or BMP.
        mask: (H, W), with the size of the images, True at the pixels whose normals are read.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".mat", ".npy", ".txt", ".png", ".tif", ".tiff", ".bmp"):
        raise InputError(
            f'found a ground truth of the type "{suffix}", expected .mat, .npy, .txt, .png, .tif or'
            " .bmp",
            path,
        )
    if suffix != ".txt":
        stored = _read_vectors(
            path, images.ExpectedSize(mask.shape, "the images", "a ground truth")
        )
        return _to_normals(stored, mask, path), False
    values = _read_text(path, *mask.shape)
    filled = (values != 0).any(axis=2)
    as_stored, turned = np.count_nonzero(filled & mask), np.count_nonzero(filled[::-1] & mask)
    upside_down = bool(turned - as_stored > 0.02 * np.count_nonzero(mask))
    stored = _Stored(values[::-1] if upside_down else values, None, False)
    return _to_normals(stored, mask, path), upside_down


def _read_vectors(path: Path, expected: images.ExpectedSize | None) -> _Stored:
    """Return the vectors in a file of normals. Its size is checked before its values are read.

    Raises InputError.
    """
    check_file(path, "a normal map")
    suffix, alpha = path.suffix.lower(), None
    if suffix == ".mat":
        with damage_as_input_error(path, "the MATLAB file is damaged and cannot be read"):
            values = read_mat(path, expected)
    elif suffix == ".npy":
        with damage_as_input_error(
            path, "the .npy file is damaged or does not contain an array of numbers"
        ):
            # Memory-mapping reads only the header, and rejects a file that is too short.
            array = np.lib.format.open_memmap(path, mode="r")
            images.check_vectors(array.shape, path)
            images.check_stored_size(array.shape, array.dtype.itemsize, path, expected)
            values = np.array(array)
    else:
        try:
            values, alpha = images.decode_with_alpha(path, expected)
        except UnknownFormatError as error:
            problem = error.problem.replace("neither", "neither .npy, .mat,")
            raise InputError(problem, path) from None
        images.check_vectors(values.shape, path)
    return _Stored(values, alpha, values.dtype.kind == "u")


def read_mat(path: Path, expected: images.ExpectedSize | None) -> Array:
    """Return the array Normal_gt of a file, or its only H x W x 3 array, in its MATLAB type.

    Sizes are checked before anything is read or decompressed. InputError: the array is missing, too
    large or not of the expected size. KeyError, ValueError, struct.error, zlib.error: the file is
    damaged.
    """
    with path.open("rb") as file:
        variables = list(mat.variables(file, path))
        variable = next((v for v in variables if v.name == "Normal_gt"), None)
        if variable is None:
            maps = {v.name: v for v in variables if len(v.shape) == 3 and v.shape[2] == 3}
            if len(maps) != 1:
                raise InputError(
                    "expected an array Normal_gt or a single array H x W x 3, found"
                    f" {', '.join(maps) or 'none'}",
                    path,
                )
            (variable,) = maps.values()
        images.check_vectors(variable.shape, path)
        images.check_stored_size(variable.shape, 8, path, expected)
        return mat.numbers_of(file, variable)


def _read_text(path: Path, height: int, width: int) -> Float64Array:
    """Return vectors (H, W, 3) from a file with one vector per line. Raises InputError."""
    # At most 32 characters per number, including the separator after it
    most = 3 * height * width * 32 + MOST_TEXT
    check_text_length(path, most, "a normal map")
    try:
        rows = np.loadtxt(path, np.float64, ndmin=2, encoding="utf-8-sig")
    except (ValueError, OSError):
        # This reader is slower, but it accepts commas and names the line of an error.
        rows = read_number_rows(path, most=most).as_array()
    if rows.shape != (height * width, 3):
        problem = (
            f"found {rows.shape[0]} rows of {rows.shape[1]}, expected {height * width} rows of 3,"
        )
        raise InputError(f"{problem} one for each pixel of {height} x {width}", path)
    return rows.reshape(height, width, 3)


def _to_normals(
    stored: _Stored, mask: Bools, path: Path, *, check_floats: bool = False
) -> Float32Array:
    """Return unit vectors (H, W, 3), zero outside the mask (H, W).

    Colours must decode to vectors of about unit length, and with check_floats, floating-point
    values must also have about unit length. Raises InputError for values that are not normals.
    """
    values = stored.values
    if values.dtype.kind not in "fiu":
        raise InputError(f"found normals of type {values.dtype}, expected real numbers", path)
    if stored.is_picture or check_floats:
        _check_lengths(values, mask, path)
    normals = np.zeros(values.shape, np.float32)
    rows, columns = np.nonzero(mask)
    for part in slices(len(rows), _BLOCK):
        block = rows[part], columns[part]
        if stored.is_picture:
            normals[block] = decode_picture(values[block])
        else:
            vectors = values[block].astype(np.float64)
            normals[block] = unit(
                np.where((np.abs(vectors) < _LARGEST).all(axis=1, keepdims=True), vectors, 0)
            )
    if not normals.any():
        raise InputError("found no normal inside the mask, expected at least one", path)
    return normals


def _check_lengths(stored: Array, mask: Bools, path: Path) -> None:
    """Raise InputError for an array (H, W, 3) that does not contain directions, such as a
    photograph.
    """
    vectors = stored[mask & stored.any(axis=2)][:: max(1, mask.sum() // _BLOCK)].astype(np.float64)
    if stored.dtype.kind == "u":
        vectors = vectors * (2 / np.iinfo(stored.dtype).max) - 1
    length = np.linalg.norm(vectors[(np.abs(vectors) < _LARGEST).all(axis=1)], axis=1)
    # Half of a picture may be a gray background, whose vectors have length 0.
    usable = length > SHORTEST_IN_PICTURE if stored.dtype.kind == "u" else length > 0
    if not usable.any():
        return
    # Rounding to 8 bits, resizing and JPEG compression change the length of unit vectors. In
    # photographs, a third of the colours have unit length by chance.
    share = float((np.abs(length[usable] - 1) < 0.1).mean())
    if share < 0.6:
        raise InputError(
            f"only {100 * share:.0f} % of the pixels are unit vectors (colour * 2 - 1 in a"
            " picture), so this is not a normal map",
            path,
            hint="If the background is not black, pass a mask",
        )


def read_depth(path: Path, expected: images.ExpectedSize) -> Float64Array:
    """Return a depth map (H, W) float64, with NaN where the stored depth is not finite.

    Raises:
        InputError: the file cannot be read, is not a map of floating-point numbers, or does not
            have the expected size.
        UsageError: the file is an EXR file, but OpenEXR is not installed.
    """
    check_file(path, "a depth map")
    suffix = path.suffix.lower()
    with damage_as_input_error(path, "the depth map is damaged and cannot be read"):
        if suffix == ".npy":
            stored: Array = np.lib.format.open_memmap(path, mode="r")
            images.check_stored_size(stored.shape, stored.dtype.itemsize, path, expected)
        else:
            stored = (_read_exr if suffix == ".exr" else images.decode_image)(path, expected)
    if stored.ndim == 3 and stored.shape[2] in (1, 3, 4):
        stored = stored[..., 0]
    if stored.ndim != 2 or stored.dtype.kind != "f":
        found = f"{stored.dtype} {' x '.join(map(str, stored.shape))}"
        raise InputError(
            f"found an array of {found}, expected floating-point numbers H x W",
            path,
            hint="Save the depth as .npy, floating-point TIFF or EXR",
        )
    depth = np.array(stored, np.float64)
    depth[~np.isfinite(depth)] = np.nan
    return depth


def _exr_size(header: Mapping[str, Any]) -> tuple[int, int]:
    """Return the height and width of a part of an EXR file."""
    low, high = header["dataWindow"]
    return int(high[1] - low[1] + 1), int(high[0] - low[0] + 1)


def _read_exr(path: Path, expected: images.ExpectedSize) -> Array:
    """Return the most likely depth channel of an EXR file."""
    library = import_extra("OpenEXR", "exr")
    with path.open("rb") as file:
        name = utf8_name(path, file)
        with native_stderr():
            headers = [part.header for part in library.File(name, header_only=True).parts]
        # The library reads all channels of all parts.
        sizes = [(*_exr_size(header), len(header["channels"])) for header in headers]
        (height, width, _), n_values = sizes[0], sum(map(math.prod, sizes))
        n_channels = -(-n_values // (height * width))  # or parts of this size
        images.check_stored_size((height, width, n_channels), 4, path, expected)
        if n_channels > _MOST_CHANNELS:
            raise InputError(
                f"found {n_channels} channels, expected at most {_MOST_CHANNELS}",
                path,
                hint="Save only the depth channel",
            )
        # If pixels are damaged, the library only prints a warning. It must not reach stdout, which
        # is reserved for results.
        with redirect_stdout(io.StringIO()) as printed, native_stderr():
            channels = library.File(name).channels()
    if printed.getvalue():
        raise InputError("the EXR file is damaged and cannot be read", path)
    # Try the usual names of depth channels first.
    for channel in ("Z", "Y", "R", "V", "depth.Z", "RGB", "RGBA", *channels):
        if channel in channels:
            return np.asarray(channels[channel].pixels)
    raise InputError("the EXR file has no channels", path)
