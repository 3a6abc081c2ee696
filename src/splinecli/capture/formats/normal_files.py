"""Ground-truth normal maps from .mat, .npy, text and picture files."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.decoding import decode_image, decode_with_alpha
from splinecli.capture.formats.text import read_number_rows
from splinecli.capture.paths import find_mode
from splinecli.errors import InputError
from splinecli.normals import SHORTEST_IN_PICTURE, decode_picture

StrPath = str | os.PathLike[str]

_CLEARLY_BETTER = 0.02  # of the mask's pixels
_LENGTH_TOLERANCE = 0.1  # of unit vectors that went through 8 bits, resizing or JPEG
_FEWEST_UNIT = 0.6  # of a picture of normals; of photographs a third are of such length by chance

_MAT_KEY = "Normal_gt"
_PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
# Not .mat: MATLAB stores whole numbers, such as those of a plane's normals, as bytes whatever their type.
_MAY_HOLD_PICTURE = (*_PICTURE_SUFFIXES, ".npy")
# Pixels normalised at a time: in float64, but not all of a large picture at once.
_BLOCK = 1 << 20


def read_normals(path: StrPath, shape: tuple[int, int], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The normal map of read_ground_truth."""
    return read_ground_truth(path, shape, mask)[0]


def read_normal_map(path: StrPath, mask: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """A normal map (H, W, 3) of any size, in one of the forms of read_ground_truth but text; zero where there is none.

    Args:
        mask: (H, W), true where normals are wanted. Where a picture's alpha channel cuts something out, that is left
            out, too.

    Raises:
        InputError: the file cannot be read, holds no normal map, or is not of the mask's size.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    mode = find_mode(path)
    if mode is None or not stat.S_ISREG(mode):
        raise InputError("the normal map does not exist or is no file", path=path)
    alpha = None
    if suffix == ".mat":
        stored = _read_mat(path)
    elif suffix == ".npy":
        stored = _read_npy(path)
    else:
        stored, alpha = decode_with_alpha(path)
    if stored.ndim != 3 or stored.shape[2] != 3:
        raise InputError(
            f"found an array of {_times(stored.shape)}, expected a normal map, H x W x 3", path=path
        )
    wanted = np.ones(stored.shape[:2], np.bool_) if mask is None else mask
    if wanted.shape != stored.shape[:2]:
        raise InputError(
            f"found a normal map of {stored.shape[1]} x {stored.shape[0]} pixels,"
            f" expected {wanted.shape[1]} x {wanted.shape[0]} as the mask",
            path=path,
        )
    if alpha is not None:
        wanted = wanted & (alpha > alpha.max() / 2)
    return _to_normals(stored, wanted, path, is_picture=suffix != ".mat", check=True)


def read_ground_truth(
    path: StrPath, shape: tuple[int, int], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], bool]:
    """A normal map (H, W, 3) float32: unit vectors, zero outside the mask and where there is no ground truth.

    Frame: x right, y up, z to the camera. The file is one of

    - MATLAB .mat: the array Normal_gt, or else the only H x W x 3 array;
    - .npy; unsigned integers are a picture;
    - .txt: H*W rows of x y z in row-major order;
    - .png or .tif: n = 2 v / full range - 1, black or mid-gray for no ground truth; floating-point TIFF as it is.

    Vectors are normalised; zero and non-finite ones are no ground truth. Text whose rows are in the wrong order, as in
    the normal.txt of DiLiGenT's Harvest, is turned over: it leaves more of the mask empty than upside down.

    Args:
        path: the file.
        shape: (H, W) of the images.
        mask: (H, W), true where normals are wanted.

    Returns:
        The map, and whether it was turned over.

    Raises:
        InputError: the file cannot be read, has another size, or has no normal inside the mask.
    """
    path = Path(path)
    mode = find_mode(path)
    if mode is None or not stat.S_ISREG(mode):
        raise InputError("the ground truth does not exist or is no file", path=path)
    suffix = path.suffix.lower()
    if suffix == ".mat":
        stored = _read_mat(path)
    elif suffix == ".npy":
        stored = _read_npy(path)
    elif suffix == ".txt":
        stored = _read_text(path, shape)
    elif suffix in _PICTURE_SUFFIXES:
        stored = decode_image(path)
    else:
        raise InputError(
            f'found a ground truth of the type "{suffix}", expected .mat, .npy, .txt, .png or .tif', path=path
        )
    if stored.shape != (*shape, 3):
        raise InputError(
            f"found ground truth of {_times(stored.shape)}, expected {_times((*shape, 3))} like the images",
            path=path,
        )
    upside_down = suffix == ".txt" and _is_upside_down(stored, mask)
    if upside_down:
        stored = stored[::-1]
    return _to_normals(stored, mask, path, is_picture=suffix in _MAY_HOLD_PICTURE), upside_down


def _to_normals(
    stored: NDArray[Any], mask: NDArray[np.bool_], path: Path, *, is_picture: bool, check: bool = False
) -> NDArray[np.float32]:
    """What a file stores (H, W, 3) as unit vectors, zero outside the mask (H, W).

    Args:
        is_picture: whether unsigned integers are a picture's colours.
        check: whether floating-point values must be of about unit length, too, as colours must be.

    Raises InputError.
    """
    if stored.dtype.kind not in "fiu":
        raise InputError(f"found normals of type {stored.dtype}, expected real numbers", path=path)
    is_picture = is_picture and stored.dtype.kind == "u"
    if is_picture or check:
        _check_lengths(stored, mask, path)
    normals = np.zeros(stored.shape, np.float32)
    rows, columns = np.nonzero(mask)
    for start in range(0, len(rows), _BLOCK):
        place = rows[start : start + _BLOCK], columns[start : start + _BLOCK]
        normals[place] = decode_picture(stored[place]) if is_picture else _unit_or_zero(stored[place])
    if not normals.any():
        raise InputError("found no normal inside the mask, expected at least one", path=path)
    return normals


def _check_lengths(stored: NDArray[Any], mask: NDArray[np.bool_], path: Path) -> None:
    """Raise InputError for colours or vectors (H, W, 3) that are no directions, such as those of a photograph."""
    vectors = stored[mask & stored.any(axis=2)][:: max(1, mask.sum() // _BLOCK)].astype(np.float32)
    if stored.dtype.kind == "u":
        vectors = vectors * (2 / np.iinfo(stored.dtype).max) - 1
    length = np.linalg.norm(vectors[np.isfinite(vectors).all(axis=1)], axis=1)
    # Half of a picture may be gray background, whose length is 0.
    usable = length > SHORTEST_IN_PICTURE if stored.dtype.kind == "u" else length > 0
    if not usable.any():
        return
    share = float((np.abs(length[usable] - 1) < _LENGTH_TOLERANCE).mean())
    if share < _FEWEST_UNIT:
        raise InputError(
            f"found {100 * share:.0f} % of the pixels to be unit vectors (of a picture colour * 2 - 1), expected nearly"
            " all: these are no normals",
            path=path,
            hint="Where the background is not black, a mask says so",
        )


def _is_upside_down(stored: NDArray[Any], mask: NDArray[np.bool_]) -> bool:
    """Whether vectors (H, W, 3) fill the mask clearly better when their rows are taken from the bottom up."""
    filled = (stored != 0).any(axis=2)
    as_it_is, turned = np.count_nonzero(filled & mask), np.count_nonzero(filled[::-1] & mask)
    return bool(turned - as_it_is > _CLEARLY_BETTER * np.count_nonzero(mask))


def _unit_or_zero(stored: NDArray[Any]) -> NDArray[np.float64]:
    """Vectors (P, 3) at unit length; zero where they are zero or not finite."""
    vectors = stored.astype(np.float64)
    # Not NaN, not infinite, and nothing (of a damaged file) whose square would be.
    usable = (np.abs(vectors) < 1e100).all(axis=1, keepdims=True)
    length = np.linalg.norm(np.where(usable, vectors, 0), axis=1, keepdims=True)
    scaled: NDArray[np.float64] = np.divide(
        vectors, length, out=np.zeros_like(vectors), where=usable & (length > 0)
    )
    return scaled


def _read_mat(path: Path) -> NDArray[Any]:
    from scipy.io import loadmat

    try:
        variables = loadmat(path)
    except NotImplementedError:
        raise InputError(
            "found a MATLAB 7.3 file, which is not supported",
            path=path,
            hint="Save it with MATLAB's option -v7",
        ) from None
    except Exception:  # a damaged file surfaces as any of a dozen types
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


def _read_npy(path: Path) -> NDArray[Any]:
    try:
        with path.open("rb") as file:
            # Not np.load: that would also open archives, and pickles where it is told to.
            array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    except Exception:  # the header is a Python literal: a damaged one fails in a dozen ways
        raise InputError("the .npy file is damaged, or holds no array of numbers", path=path) from None
    return array


def _read_text(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    try:
        rows = np.loadtxt(path, np.float64, ndmin=2, encoding="utf-8-sig")
    except (ValueError, OSError):
        # Slower, but it knows commas and names the line at fault.
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
