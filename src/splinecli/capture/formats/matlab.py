"""Normal maps in MATLAB's .mat files. Sizes are checked before anything is read or expanded."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.image_size import ExpectedSize, check_stored_size
from splinecli.errors import InputError

KEY = "Normal_gt"

_HEADER_BYTES, _TAG_BYTES = 128, 8
_COMPRESSED, _MATRIX = 15, 14  # types of elements
_ITEM_BYTES = 16  # of a complex number, the largest
_START_BYTES = 1 << 12  # of a variable: enough for its sizes and its name
_MOST_OVERHEAD = 1 << 16  # bytes of a variable beside its numbers
_MOST_ELEMENTS = 10_000
_CHUNK = 1 << 20

Order = Literal["little", "big"]


class _Variable(NamedTuple):
    """A variable of a file: its name, its shape, and the bytes of its element."""

    name: str
    shape: tuple[int, ...]
    start: int
    length: int
    compressed: bool


def read_mat(path: Path, expected: ExpectedSize | None) -> NDArray[Any]:
    """Return the array Normal_gt of a file of version 5, 6 or 7, or else its only array H x W x 3.

    Raises:
        InputError: there is no such array, or it is too large or not of the expected size.
        Exception: SciPy raises a dozen types for damaged files.
    """
    from scipy.io import loadmat

    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        if header.startswith(b"MATLAB 7.3"):
            raise InputError(
                "found a MATLAB 7.3 file, which is not supported",
                path=path,
                hint="Save it with MATLAB's option -v7",
            )
        variable = _choose(list(_variables(file, "little" if header[126:] == b"IM" else "big")), path)
        check_stored_size(variable.shape, 8, path, expected)
        element = _read_element(file, variable)
    # SciPy sees this variable alone. Those before it might expand to any size.
    return np.asarray(loadmat(io.BytesIO(header + element))[variable.name])


def _choose(variables: list[_Variable], path: Path) -> _Variable:
    """Return the variable that is the normal map. Raises InputError."""
    maps = {v.name: v for v in variables if len(v.shape) == 3 and v.shape[2] == 3}
    named = next((v for v in variables if v.name == KEY), None)
    if named is None and len(maps) != 1:
        found = ", ".join(maps) or "none"
        raise InputError(f"found no {KEY}, and of other H x W x 3 arrays {found}, expected one", path=path)
    chosen = named or next(iter(maps.values()))
    if chosen.name not in maps:
        size = " x ".join(map(str, chosen.shape))
        raise InputError(f"found an array of {size}, expected a normal map, H x W x 3", path=path)
    return chosen


def _variables(file: BinaryIO, order: Order) -> Iterator[_Variable]:
    """Yield the variables of a file that is positioned behind its header. Raises ValueError for too many elements."""
    for _ in range(_MOST_ELEMENTS):
        if len(tag := file.read(_TAG_BYTES)) < _TAG_BYTES:
            return
        kind, length = _integers(tag, order)
        start = file.tell()
        content = file.read(min(length, _START_BYTES))
        if kind == _COMPRESSED:
            content = zlib.decompressobj().decompress(content, _START_BYTES)[_TAG_BYTES:]
        if kind in (_COMPRESSED, _MATRIX):
            yield _Variable(*_name_and_shape(content, order), start, length, kind == _COMPRESSED)
        file.seek(start + length)
    raise ValueError("the file has too many elements")


def _name_and_shape(content: bytes, order: Order) -> tuple[str, tuple[int, ...]]:
    """Return what the start of a matrix says: flags, sizes, name, each with a tag and filled up to 8 bytes."""
    place = 2 * _TAG_BYTES  # behind the flags
    length = _integers(content[place : place + _TAG_BYTES], order)[1]
    place += _TAG_BYTES
    shape = _integers(content[place : place + length], order)
    place += -(-length // 8) * 8
    kind, length = _integers(content[place : place + _TAG_BYTES], order)
    if kind >> 16:  # a name of up to four letters stands in the tag
        name = content[place + 4 : place + 4 + (kind >> 16)]
    else:
        name = content[place + _TAG_BYTES : place + _TAG_BYTES + length]
    return name.decode("latin-1"), shape


def _integers(content: bytes, order: Order) -> tuple[int, ...]:
    return tuple(int.from_bytes(content[place : place + 4], order) for place in range(0, len(content), 4))


def _read_element(file: BinaryIO, variable: _Variable) -> bytes:
    """Return the bytes of a variable. Raises ValueError if it is longer, or expands to more, than its shape allows."""
    most = math.prod(variable.shape) * _ITEM_BYTES + _MOST_OVERHEAD
    if variable.length > most:
        raise ValueError("the variable is longer than its shape allows")
    file.seek(variable.start - _TAG_BYTES)
    element = file.read(_TAG_BYTES + variable.length)
    decoder, expanded = zlib.decompressobj(), 0
    pending = element[_TAG_BYTES:] if variable.compressed else b""
    while pending:
        expanded += len(decoder.decompress(pending, _CHUNK))
        if expanded > most:
            raise ValueError("the variable expands to more than its shape allows")
        pending = decoder.unconsumed_tail
    return element
