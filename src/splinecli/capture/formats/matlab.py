"""Normal maps and matrices in MATLAB's .mat files of version 5, 6 and 7 (MathWorks, "MAT-File Format").

A reader of its own, for arrays of real numbers alone: SciPy's ends the process at types that it does not know.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from splinecli.capture.formats.damage import damage_as_input_error
from splinecli.capture.formats.image_size import ExpectedSize, check_stored_size, check_vectors
from splinecli.errors import InputError
from splinecli.maths import Array

KEY = "Normal_gt"

_TAG_BYTES = 8
_COMPRESSED, _MATRIX = 15, 14  # types of elements
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
"""Classes of numeric arrays. MATLAB stores numbers in the smallest type that has them: a double may lie as bytes."""
_COMPLEX = 1 << 11  # a flag of an array
_START_BYTES = 1 << 12  # of a variable: enough for its sizes and its name
_MOST_OVERHEAD = 1 << 16  # bytes of a variable beside its numbers
_MOST_ELEMENTS = 10_000
_MOST_NUMBERS = 1 << 20  # of a matrix of a small file


class _Variable(NamedTuple):
    """A numeric variable of a file: its name, shape and type, and the place, length and byte order of its element."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    order: str
    start: int
    length: int
    compressed: bool


def read_mat(path: Path, expected: ExpectedSize | None) -> Array:
    """Return the array Normal_gt of a file, or else its only array H x W x 3, with the type that it has in MATLAB.

    Sizes are checked before anything is read or expanded.

    Raises:
        InputError: there is no such array, or it is too large or not of the expected size.
        KeyError, ValueError, struct.error, zlib.error: the file is damaged.
    """
    with path.open("rb") as file:
        variables = list(_variables(file, path))
        variable = next((v for v in variables if v.name == KEY), None)
        if variable is None:
            maps = {v.name: v for v in variables if len(v.shape) == 3 and v.shape[2] == 3}
            if len(maps) != 1:
                found = ", ".join(maps) or "none"
                raise InputError(f"found no {KEY}, and of other H x W x 3 arrays {found}, expected one", path=path)
            (variable,) = maps.values()
        check_vectors(variable.shape, path)
        check_stored_size(variable.shape, 8, path, expected)
        return _numbers(file, variable)


def read_matrices(path: Path) -> dict[str, Array]:
    """Return the numeric matrices of a small file by name. Raises InputError."""
    with damage_as_input_error(path, "the .mat file is damaged", "Save it again"), path.open("rb") as file:
        return {
            v.name: _numbers(file, v)
            for v in list(_variables(file, path))
            if len(v.shape) == 2 and 0 < math.prod(v.shape) <= _MOST_NUMBERS
        }


def _numbers(file: BinaryIO, variable: _Variable) -> Array:
    most = 8 * math.prod(variable.shape) + _MOST_OVERHEAD
    content = _read(file, variable.start, variable.length, most, compressed=variable.compressed)
    kind, numbers = next(islice(_parts(content, variable.order), 3, None))
    stored = np.frombuffer(numbers, variable.order + _NUMBERS[kind])
    return stored.astype(variable.dtype, copy=False).reshape(variable.shape, order="F")


def _variables(file: BinaryIO, path: Path) -> Iterator[_Variable]:
    header = file.read(128)
    if header.startswith(b"MATLAB 7.3"):
        hint = "Save it with MATLAB's option -v7"
        raise InputError("found a MATLAB 7.3 file, which is not supported", path=path, hint=hint)
    order = "<" if header[126:] == b"IM" else ">"
    for _ in range(_MOST_ELEMENTS):
        if len(tag := file.read(_TAG_BYTES)) < _TAG_BYTES:
            return
        kind, length = struct.unpack(order + "II", tag)
        start, compressed = file.tell(), kind == _COMPRESSED
        if kind in (_COMPRESSED, _MATRIX):
            parts = _parts(_read(file, start, length, _START_BYTES, compressed=compressed), order)
            (flags, *_) = struct.unpack(order + "II", next(parts)[1])
            if flags & 0xFF in _CLASSES and not flags & _COMPLEX:
                shape, name = next(parts)[1], next(parts)[1]
                sizes = struct.unpack(f"{order}{len(shape) // 4}I", shape)
                dtype = _CLASSES[flags & 0xFF]
                yield _Variable(bytes(name).decode("latin-1"), sizes, dtype, order, start, length, compressed)
        file.seek(start + length)
    raise ValueError("the file has too many elements")


def _read(file: BinaryIO, start: int, length: int, most: int, *, compressed: bool) -> memoryview:
    """Return the content of a matrix, at most so many bytes of it."""
    file.seek(start)
    content = file.read(min(length, most))
    if compressed:
        content = zlib.decompressobj().decompress(content, most)
    return memoryview(content)[_TAG_BYTES if compressed else 0 :]


def _parts(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and bytes of the parts of a matrix: flags, sizes, name, numbers. Each is filled up to 8 bytes."""
    place = 0
    while place + _TAG_BYTES <= len(content):
        kind, length = struct.unpack_from(order + "II", content, place)
        if kind >> 16:  # up to four bytes stand in the tag
            yield kind & 0xFFFF, content[place + 4 : place + 4 + (kind >> 16)]
            length = 0
        else:
            yield kind, content[place + _TAG_BYTES : place + _TAG_BYTES + length]
        place += _TAG_BYTES + -(-length // 8) * 8
