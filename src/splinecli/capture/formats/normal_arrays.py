"""Vectors (H, W, 3) as the files of normal maps store them: which file is read by which reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_with_alpha
from splinecli.capture.formats.image_size import ExpectedSize, check_stored_size
from splinecli.capture.formats.matlab import read_mat
from splinecli.capture.formats.text import MOST_TEXT, check_length, read_number_rows
from splinecli.capture.paths import check_file
from splinecli.errors import InputError, SplinecliError
from splinecli.system.memory import is_out_of_memory

PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
"""Pictures of normals."""

_LONGEST_NUMBER = 32  # characters of a number in a text, with what separates it from the next


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


def read_vectors(path: Path, expected: ExpectedSize | None = None, *, text: bool = False) -> StoredVectors:
    """Return the vectors of a file of normals.

    The suffix decides: .mat and .npy are arrays, .txt is text, all others are pictures. Unsigned integers in a .npy
    file are a picture, too. In a .mat file they are not, because MATLAB stores all whole numbers as bytes, such as the
    normals of a plane.

    Args:
        path: the file.
        expected: the size that the map must have, if it is known. It is compared before the values are read.
        text: whether to read text, which does not state its size, so that `expected` must give it.

    Raises:
        InputError: the file cannot be read, contains no array H x W x 3, or has not the expected size.
    """
    alpha = None
    suffix = path.suffix.lower()
    check_file(path, "a normal map")
    if suffix == ".mat":
        values = read_guarded(path, "the MATLAB file is damaged and cannot be read", read_mat, expected)
    elif suffix == ".npy":
        problem = "the .npy file is damaged, or contains no array of numbers"
        values = read_guarded(path, problem, _read_npy, expected)
    elif suffix == ".txt" and text and expected is not None:
        values = _read_text(path, expected.shape)
    else:
        values, alpha = decode_with_alpha(path, expected)
        check_vectors(values.shape, path)
    return StoredVectors(values, alpha, suffix != ".mat" and values.dtype.kind == "u")


def check_vectors(shape: tuple[int, ...], path: Path) -> None:
    """Raise InputError where an array is not H x W x 3."""
    if len(shape) != 3 or shape[2] != 3:
        raise InputError(
            f"found an array of {' x '.join(map(str, shape))}, expected a normal map, H x W x 3", path=path
        )


def read_guarded(
    path: Path,
    problem: str,
    read: Callable[[Path, ExpectedSize | None], NDArray[Any]],
    expected: ExpectedSize | None,
) -> NDArray[Any]:
    """Return what a reader returns. Whatever it raises for a damaged file becomes an InputError with this problem."""
    try:
        return read(path, expected)
    except SplinecliError:
        raise
    except PermissionError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    except Exception as error:  # the readers raise a dozen types
        if is_out_of_memory(error):
            raise
        raise InputError(problem, path=path) from error


def _read_npy(path: Path, expected: ExpectedSize | None) -> NDArray[Any]:
    # A map of the file, which reads the header alone. It refuses a file that is shorter than its header says.
    array = np.lib.format.open_memmap(path, mode="r")
    check_vectors(array.shape, path)
    check_stored_size(array.shape, array.dtype.itemsize, path, expected)
    return np.array(array)


def _read_text(path: Path, shape: tuple[int, ...]) -> NDArray[np.float64]:
    height, width = shape[:2]
    most = 3 * height * width * _LONGEST_NUMBER + MOST_TEXT
    check_length(path, most)
    try:
        rows = np.loadtxt(path, np.float64, ndmin=2, encoding="utf-8-sig")
    except (ValueError, OSError):
        # This reader is slower, but it reads commas and names the line of an error.
        rows = read_number_rows(path, most=most).as_array()
    expected = (height * width, 3)
    if rows.shape != expected:
        raise InputError(
            f"found {rows.shape[0]} rows of {rows.shape[1]}, expected {expected[0]} rows of 3,"
            f" one for each pixel of {height} x {width}",
            path=path,
        )
    return rows.reshape(height, width, 3)
