"""Vectors (H, W, 3) as the files of normal maps store them: which file is read by which reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_with_alpha
from splinecli.capture.formats.text import read_number_rows
from splinecli.errors import InputError

PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
"""Pictures of normals."""

_MAT_KEY = "Normal_gt"


class StoredVectors(NamedTuple):
    """What a file stores.

    Args:
        values: (H, W, 3).
        alpha: (H, W), the alpha channel of a picture; or None.
        is_picture: whether the values are colours, n = 2 v / full scale - 1.
    """

    values: NDArray[Any]
    alpha: NDArray[Any] | None
    is_picture: bool


def read_vectors(path: Path, *, text_shape: tuple[int, int] | None = None) -> StoredVectors:
    """Return the vectors of a file of normals.

    The suffix decides: .mat and .npy are arrays, .txt is text, all others are pictures. Unsigned integers in a .npy
    file are a picture, too. In a .mat file they are not, because MATLAB stores all whole numbers as bytes, such as the
    normals of a plane.

    Args:
        text_shape: (H, W), which text files do not state; None to take no text.

    Raises:
        InputError: the file cannot be read, or contains no array H x W x 3.
    """
    alpha = None
    suffix = path.suffix.lower()
    if suffix == ".mat":
        values = _read_file(path, _read_mat)
    elif suffix == ".npy":
        values = _read_file(path, _read_npy)
    elif suffix == ".txt" and text_shape is not None:
        values = _read_text(path, text_shape)
    else:
        values, alpha = decode_with_alpha(path)
    if values.ndim != 3 or values.shape[2] != 3:
        raise InputError(
            f"found an array of {_times(values.shape)}, expected a normal map, H x W x 3", path=path
        )
    return StoredVectors(values, alpha, suffix != ".mat" and values.dtype.kind == "u")


def _read_file(path: Path, read: Callable[[Any, Path], NDArray[Any]]) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            return read(file, path)
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None


def _read_mat(file: Any, path: Path) -> NDArray[Any]:
    from scipy.io import loadmat

    try:
        variables = loadmat(file)
    except NotImplementedError:
        raise InputError(
            "found a MATLAB 7.3 file, which is not supported",
            path=path,
            hint="Save it with MATLAB's option -v7",
        ) from None
    except Exception:  # a damaged file causes a dozen types of errors
        raise InputError("the MATLAB file is damaged and cannot be read", path=path) from None
    if isinstance(variables.get(_MAT_KEY), np.ndarray):
        return np.asarray(variables[_MAT_KEY])
    maps = {
        name: value
        for name, value in variables.items()
        if isinstance(value, np.ndarray) and value.ndim == 3 and value.shape[2] == 3
    }
    if len(maps) != 1:
        found = ", ".join(maps) if maps else "none"
        raise InputError(
            f"found no {_MAT_KEY}, and of other H x W x 3 arrays {found}, expected one", path=path
        )
    return next(iter(maps.values()))


def _read_npy(file: Any, path: Path) -> NDArray[Any]:
    try:
        # Not np.load, which also opens archives.
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    except Exception:  # the header is a Python literal: a damaged one fails in a dozen ways
        raise InputError("the .npy file is damaged, or contains no array of numbers", path=path) from None
    return array


def _read_text(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    try:
        rows = np.loadtxt(path, np.float64, ndmin=2, encoding="utf-8-sig")
    except (ValueError, OSError):
        # This reader is slower, but it reads commas and names the line of an error.
        rows = read_number_rows(path).as_array()
    expected = (shape[0] * shape[1], 3)
    if rows.shape != expected:
        raise InputError(
            f"found {rows.shape[0]} rows of {rows.shape[1]}, expected {expected[0]} rows of 3,"
            f" one for each pixel of {_times(shape)}",
            path=path,
        )
    return rows.reshape(*shape, 3)


def _times(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape)
