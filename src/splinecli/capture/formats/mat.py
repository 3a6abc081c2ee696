"""Arrays of real numbers in MATLAB's .mat files of version 5, 6 and 7 (MathWorks, "MAT-File
Format"), and photographs stored in such arrays.

This reader exists because SciPy's reader ends the process when it encounters an unknown type.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from splinecli.capture.formats.decoders import MASK_PAGE, damage_as_input_error, page_of
from splinecli.errors import InputError
from splinecli.maths import Array
from splinecli.system.files import reading

_DAMAGED = "the .mat file is damaged", "Save it again"
_TAG_BYTES = 8
_COMPRESSED, _MATRIX = 15, 14  # types of elements
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
"""Classes of numeric arrays. MATLAB stores numbers in the smallest type that can represent them, so
an array of doubles may be stored as bytes.
"""


class Variable(NamedTuple):
    """A numeric variable: its name, shape and type, and the position, length and byte order of its
    data.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    order: str
    start: int
    length: int
    compressed: bool


def names(path: Path) -> set[str]:
    """Return the names of the arrays in a file. Raises InputError."""
    with damage_as_input_error(path, *_DAMAGED), path.open("rb") as file:
        return {variable.name for variable in variables(file, path)}


def read_matrix(path: Path, choose: Callable[[dict[str, tuple[int, ...]]], str]) -> Array:
    """Return the numeric matrix that `choose` selects from a mapping of names to shapes.

    Only small matrices are offered. Vectors with numbered names, such as l1 and l2, also form a
    matrix, with one vector per row. Only the selected matrix is decompressed. Raises InputError,
    including the errors of `choose`.
    """
    with damage_as_input_error(path, *_DAMAGED), path.open("rb") as file:
        found = {
            v.name: [v]
            for v in variables(file, path)
            if len(v.shape) == 2 and 0 < math.prod(v.shape) <= 1 << 20
        }
        for (stem, shape), group in _numbered(v for (v,) in found.values()).items():
            if min(shape) == 1:
                found[f"{stem}1..{len(group)}"] = group
        shapes = {
            name: group[0].shape if len(group) == 1 else (len(group), max(group[0].shape))
            for name, group in found.items()
        }
        chosen = [numbers_of(file, variable) for variable in found[choose(shapes)]]
        return chosen[0] if len(chosen) == 1 else np.stack([vector.ravel() for vector in chosen])


def _numbered(found: Iterable[Variable]) -> dict[tuple[str, tuple[int, ...]], list[Variable]]:
    """Return groups of at least three variables with equal shapes and numbered names, in order.

    The keys are the stem of the names and the shape.
    """
    groups = defaultdict(list)
    for variable in found:
        if name := re.fullmatch(r"(\D*)(\d{1,4})", variable.name):
            groups[name[1], variable.shape].append((int(name[2]), variable))
    return {
        key: [variable for _, variable in sorted(group)]
        for key, group in groups.items()
        if len(group) >= 3
    }


def numbers_of(file: BinaryIO, variable: Variable) -> Array:
    """Return the array of a variable in its MATLAB type.

    Raises KeyError, ValueError, struct.error or zlib.error for a damaged file.
    """
    most = 8 * math.prod(variable.shape) + (1 << 16)
    content = _read(file, variable.start, variable.length, most, compressed=variable.compressed)
    kind, numbers = next(islice(_parts(content, variable.order), 3, None))
    stored = np.frombuffer(numbers, variable.order + _NUMBERS[kind])
    return stored.astype(variable.dtype, copy=False).reshape(variable.shape, order="F")


def variables(file: BinaryIO, path: Path) -> Iterator[Variable]:
    """Yield the arrays of real numbers in an open file, without reading the numbers.

    Raises InputError for MATLAB 7.3, which is a different format, and the errors of numbers_of.
    """
    header = file.read(128)
    if header.startswith(b"MATLAB 7.3"):
        raise InputError(
            "found a MATLAB 7.3 file, which is not supported",
            path,
            hint="Save it with MATLAB's option -v7",
        )
    order = "<" if header[126:] == b"IM" else ">"
    for _ in range(10_000):
        if len(tag := file.read(_TAG_BYTES)) < _TAG_BYTES:
            return
        kind, length = struct.unpack(order + "II", tag)
        start, compressed = file.tell(), kind == _COMPRESSED
        if kind in (_COMPRESSED, _MATRIX):
            # The first 4096 bytes contain the sizes and the name.
            parts = _parts(_read(file, start, length, 1 << 12, compressed=compressed), order)
            (flags, *_) = struct.unpack(order + "II", next(parts)[1])
            if flags & 0xFF in _CLASSES and not flags & (1 << 11):  # the flag of complex numbers
                shape, name = next(parts)[1], next(parts)[1]
                sizes = struct.unpack(f"{order}{len(shape) // 4}I", shape)
                dtype = _CLASSES[flags & 0xFF]
                yield Variable(
                    bytes(name).decode("latin-1"), sizes, dtype, order, start, length, compressed
                )
        file.seek(start + length)
    raise ValueError("the file has too many elements")


def _read(file: BinaryIO, start: int, length: int, most: int, *, compressed: bool) -> memoryview:
    """Return the content of a matrix, limited to a number of bytes."""
    file.seek(start)
    content = file.read(min(length, most))
    if compressed:
        content = zlib.decompressobj().decompress(content, most)
    return memoryview(content)[_TAG_BYTES if compressed else 0 :]


def _parts(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield the type and bytes of each part of a matrix: flags, sizes, name and numbers.

    Parts are padded to 8 bytes.
    """
    place = 0
    while place + _TAG_BYTES <= len(content):
        kind, length = struct.unpack_from(order + "II", content, place)
        if kind >> 16:  # up to four bytes of data are stored in the tag itself
            yield kind & 0xFFFF, content[place + 4 : place + 4 + (kind >> 16)]
            length = 0
        else:
            yield kind, content[place + _TAG_BYTES : place + _TAG_BYTES + length]
        place += _TAG_BYTES + -(-length // 8) * 8


_PICTURES = ("i", "im", "ims", "img", "imgs", "image", "images", "photos", "stack", "data")
_MASKS = ("mask", "m", "msk")
_MOST_FILES = 4  # number of files whose contents are cached
_MOST_PICTURES = 9_999  # the largest number that page_of accepts


@dataclass(frozen=True)
class Stack:
    """The photographs in a .mat file, and their mask.

    Letters stand for the axes of each array: F images, H rows, W columns and C channels.
    """

    arrays: tuple[Variable, ...]  # one array for all photographs, or one for each of them
    axes: str  # such as "HWF", or "HW" if each photograph is a separate array
    mask: Variable | None

    @property
    def count(self) -> int:
        """The number of photographs."""
        if "F" not in self.axes:
            return len(self.arrays)
        return self.arrays[0].shape[self.axes.index("F")]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape (H, W, C) of each photograph."""
        sizes = dict(zip(self.axes, self.arrays[0].shape, strict=True))
        return sizes["H"], sizes["W"], sizes.get("C", 1)


def find_stack(path: Path) -> Stack | None:
    """Return the photographs in a .mat file without reading them, or None if there are none.

    They form one array H x W x F or H x W x C x F, an array with F first, as is usual with NumPy,
    or several arrays with numbered names. If several arrays are possible, one with a usual name is
    chosen. Raises InputError.
    """
    with reading(path):
        stamp = path.stat()
    return _find_stack(path, stamp.st_size, stamp.st_mtime_ns)


@lru_cache(_MOST_FILES)
def _find_stack(path: Path, *_: int) -> Stack | None:
    with damage_as_input_error(path, *_DAMAGED), path.open("rb") as file:
        found = [v for v in variables(file, path) if len(v.shape) in (2, 3, 4) and all(v.shape)]
    counts = {n for v in found if len(v.shape) == 2 and 3 in v.shape for n in v.shape}
    masks = [v for v in found if len(v.shape) == 2 and v.name.lower() in _MASKS]
    size = masks[0].shape if len(masks) == 1 else None
    stacks: list[tuple[bool, Stack]] = []  # true if the name is unusual
    for variable in found:
        axes = _axes(variable.shape, counts, size)
        usual = variable.name.lower() in _PICTURES
        if axes is not None and (usual or variable.shape[2:] != (3,)):  # may be normals
            stacks.append((not usual, Stack((variable,), axes, None)))
    for key, group in _numbered(found).items():
        shape = key[1]
        if min(shape[:2]) > 3 and (len(shape) == 2 or shape[2:] == (3,)):
            stacks.append((False, Stack(tuple(group), "HWC"[: len(shape)], None)))
    stacks = [each for each in stacks if each[1].count <= _MOST_PICTURES]
    likely = [stack for unusual, stack in stacks if unusual == all(each for each, _ in stacks)]
    if len(likely) != 1:
        return None
    (stack,) = likely
    return Stack(stack.arrays, stack.axes, masks[0] if size == stack.shape[:2] else None)


def _axes(shape: tuple[int, ...], counts: set[int], size: tuple[int, ...] | None) -> str | None:
    """Return the axes of an array of photographs, or None for any other array.

    Args: counts: possible numbers of lights. size: the mask's (H, W), or None.
    """
    possible = ["HWF", "FHW"] if len(shape) == 3 else []
    if len(shape) == 4:
        possible = [axes for axes in ("HWCF", "FHWC", "HWFC") if shape[axes.index("C")] in (1, 3)]
    if not possible:
        return None

    def fit(axes: str) -> tuple[bool, bool, bool]:
        sizes = dict(zip(axes, shape, strict=True))
        is_size = size == (sizes["H"], sizes["W"])
        return is_size, sizes["F"] in counts, sizes["F"] < min(sizes["H"], sizes["W"])

    return max(possible, key=fit)  # the first one if several fit equally


def picture_size(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the shape (H, W, C) of a photograph or mask in a .mat file, and the bytes per value.

    The path ends with its place in the file, as in a.mat[0] or a.mat[mask]. Raises InputError.
    """
    stack, _, (variable, *_) = _place(path)
    is_mask = page_of(path)[1] == MASK_PAGE
    shape = (*variable.shape, 1) if is_mask else stack.shape
    return shape, np.dtype(variable.dtype).itemsize


def stack_bytes(path: Path) -> int:
    """Return the memory in bytes that reading a photograph takes, which requires the whole array.

    Raises InputError.
    """
    return 2 * 8 * math.prod(_place(path)[2][0].shape)


def read_picture(path: Path) -> Array:
    """Return a photograph or mask in a .mat file as stored, (H, W) or (H, W, C). Raises
    InputError.
    """
    stack, number, (variable, *_) = _place(path)
    stored, _ = page_of(path)
    stamp = stored.stat()
    array = _read_array(stored, variable, stamp.st_size, stamp.st_mtime_ns)
    if array.ndim == 2 or "F" not in stack.axes:
        return np.ascontiguousarray(array)
    return np.ascontiguousarray(array.take(number, stack.axes.index("F")))


def _place(path: Path) -> tuple[Stack, int, tuple[Variable, ...]]:
    """Return the stack, the number of a picture in it, and the arrays from the picture's own array
    on.
    """
    stored, number = page_of(path)
    stack = find_stack(stored)
    arrays: tuple[Variable, ...] = ()
    if stack is not None and number == MASK_PAGE:
        arrays = () if stack.mask is None else (stack.mask,)
    elif stack is not None and number < stack.count:
        arrays = stack.arrays if "F" in stack.axes else stack.arrays[number:]
    if stack is None or not arrays:
        raise InputError("the file has no such picture", path)
    return stack, number, arrays


@lru_cache(1)  # otherwise, a compressed array would be decompressed for each photograph
def _read_array(path: Path, variable: Variable, *_: int) -> Array:
    with damage_as_input_error(path, *_DAMAGED), path.open("rb") as file:
        return numbers_of(file, variable)
