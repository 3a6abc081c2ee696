"""Numbers in text files, with any separator, byte order marks, comments and blank lines, and in
MATLAB's .mat files of version 5, 6 and 7 (MathWorks, "MAT-File Format").

We have our own .mat reader, only for arrays of real numbers, because SciPy's ends the process at
unknown types.
"""

import codecs
import math
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from splinecli.capture.formats.decoders import damage_as_input_error
from splinecli.capture.formats.facts import JPEG, PNG, TIFF
from splinecli.capture.formats.images import ExpectedSize, check_stored_size, check_vectors
from splinecli.errors import InputError
from splinecli.maths import Array, Float64Array
from splinecli.system.files import check_file, is_substitution, reading

_SEPARATORS = re.compile(r"[\s,;]+")
_SEPARATORS_BESIDE_COMMAS = re.compile(r"[\s;]+")
_NUMBER_WITH_COMMA = re.compile(r"(?=\D*\d)[+-]?\d*(,\d+)?([eE][+-]?\d+)?")

_FROM_PIPES: dict[Path, bytes] = {}

# The one-based line of a row in its file, this line without comments, and its words
WordRow = tuple[int, str, list[str]]

MOST_TEXT = 1_000_000
"""Bytes of the longest text file that is read, unless the number of images sets the limit: 14,000
lights.
"""

# Hint for a line with decimal commas
DECIMAL_POINT = "A comma separates columns; write decimals with a point"


class NumberRow(NamedTuple):
    """A row of numbers, its one-based line in the file, and this line as written,
    without comments.
    """

    numbers: tuple[float, ...]
    line: int | None  # None in a file without lines, such as JSON
    text: str = ""


@dataclass(frozen=True)
class NumberRows:
    """The rows of numbers of a text file, at least one, all finite; their lengths may differ."""

    path: Path
    rows: tuple[NumberRow, ...] = field(repr=False)
    # of each row's image, without folders; None if rows begin with numbers
    names: tuple[str, ...] | None = None
    intensities: Float64Array | None = None  # (R, 3), RGB, of the lights of a file that has them
    # whether each row is a vector x y z, because the format has nothing else
    are_vectors: bool = False

    def as_array(self) -> Float64Array:
        """Return the rows as (R, C) float64. Raises InputError at the first row that differs in
        length.
        """
        lengths = [len(row.numbers) for row in self.rows]
        usual = 3 if 3 in lengths and lengths.count(3) * 2 >= len(lengths) else lengths[0]
        for (_, line, text), length in zip(self.rows, lengths, strict=True):
            if length != usual:
                raise InputError(
                    f"found {columns(length)}, expected {usual} as in the other lines",
                    self.path,
                    line=line,
                    hint=DECIMAL_POINT if length > usual and has_decimal_commas(text) else None,
                )
        return np.array([row.numbers for row in self.rows], np.float64)


def columns(count: int) -> str:
    """Return "1 column", "2 columns" and so on."""
    return f"{count} column" + ("" if count == 1 else "s")


def has_decimal_commas(text: str) -> bool:
    """Return whether a line looks like numbers with decimal commas, such as "0,5 0,3 0,8"."""
    has_both = re.search(r"\d,\d", text) and re.search(r"[\s;]", text)
    return "." not in text and has_both is not None


def check_text_length(path: Path, most: int, expected: str = "a text file") -> None:
    """Raise InputError for a text file of more than `most` bytes, or for something that is not a
    file.
    """
    check_file(path, expected)
    length = path.stat().st_size
    if length > most:
        raise InputError(
            f"found {length / 1e6:.1f} MB, expected a text file of at most {most / 1e6:.1f} MB",
            path,
        )


def read_text(path: Path, *, most: int = MOST_TEXT, expected: str = "a text file") -> bytes:
    """Return the bytes of a text file, or of a pipe instead: the shell's `<(...)`, which can be
    read only once.

    Raises InputError if it is missing, not a file, or longer than `most` bytes. Messages name
    `expected` as the expected content.
    """
    check_file(path, expected, pipe=True)
    with reading(path):
        if not is_substitution(path):
            check_text_length(path, most)
            return path.read_bytes()
        if path not in _FROM_PIPES:
            with path.open("rb") as pipe:
                content = pipe.read(most + 1)
            if len(content) > most:
                size = f"{most / 1e6:.1f} MB"
                raise InputError(
                    f"found more than {size}, expected a text file of at most {size}", path
                )
            _FROM_PIPES[path] = content
        return _FROM_PIPES[path]


def read_lines(
    path: Path, *, else_latin_1: bool = False, expected: str = "a text file", most: int = MOST_TEXT
) -> list[str]:
    """Return the lines of a UTF-8 file, with or without a byte order mark, or of UTF-16 with one.
    Raises InputError.

    With else_latin_1, a file that is not UTF-8 is read as Latin-1, which older programs on Windows
    write. For the other arguments, see read_text.
    """
    content = read_text(path, most=most, expected=expected)
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf_16 else "utf-8-sig")
    except UnicodeDecodeError:
        if content.startswith((PNG, JPEG, *TIFF)):
            raise InputError(f"found an image, expected {expected}", path) from None
        if not else_latin_1:
            raise InputError(
                "the file is not UTF-8 text", path, hint="Save it as plain UTF-8 text"
            ) from None
        text = content.decode("latin-1")
    lines = re.split(r"\r\n|\r|\n", text)
    if len(lines) > most // 20:  # bytes of a line, on average: each line takes time and memory
        raise InputError(f"found {len(lines)} lines, expected at most {most // 20}", path)
    return lines


def read_number_rows(
    path: Path, *, expected: str = "a text file", most: int = MOST_TEXT
) -> NumberRows:
    """Return numbers separated by spaces, tabs, commas or semicolons; "#" comments and blank lines
    are skipped.

    For the arguments, see read_text. Raises InputError with the line for a word that is not a
    finite number; also for a file without numbers.
    """
    return parse_rows(read_rows_of_words(path, 3, expected=expected, most=most), path)


def read_rows_of_words(
    path: Path, n_numbers: int, *, expected: str, most: int = MOST_TEXT
) -> list[WordRow]:
    """Return the words of each line that has any, with points for decimal commas. Raises
    InputError.

    A line ends with n_numbers numbers. See read_text for the other arguments.
    """
    stored = enumerate(read_lines(path, expected=expected, most=most), start=1)
    content = [(line, text.partition("#")[0].strip()) for line, text in stored]
    content = [(line, text) for line, text in content if text.strip(" ,;")]
    if content and content[0][1][0] in "[(":  # a list as Python or NumPy prints it
        parts = [(line, part) for line, text in content for part in re.split(r"[\])]", text)]
        content = [(line, text) for line, part in parts if (text := part.strip(" \t,;[("))]
    commas = uses_decimal_commas([text for _, text in content], n_numbers)
    return [(line, text, split_words(text, decimal_commas=commas)) for line, text in content]


def parse_rows(rows: Sequence[WordRow], path: Path) -> NumberRows:
    """Return the numbers of rows of words. Raises InputError with the line for other words, and for
    no rows.
    """
    if not rows:
        raise InputError("the file contains no numbers", path)
    parsed = (
        NumberRow(tuple(parse_number(word, path, line) for word in words), line, text)
        for line, text, words in rows
    )
    return NumberRows(path, tuple(parsed))


def split_words(text: str, *, decimal_commas: bool = False) -> list[str]:
    """Return the words of a line, with points for decimal commas."""
    separators = _SEPARATORS_BESIDE_COMMAS if decimal_commas else _SEPARATORS
    words = [word for word in separators.split(text) if word]
    if decimal_commas:
        is_number = _NUMBER_WITH_COMMA.fullmatch
        return [word.replace(",", ".") if is_number(word) else word for word in words]
    return words


def uses_decimal_commas(texts: Sequence[str], n_numbers: int) -> bool:
    """Return whether the last numbers of lines have decimal commas and other separators, as in "0,5
    0,3 0,8".
    """
    tails = [_SEPARATORS_BESIDE_COMMAS.split(text)[-n_numbers:] for text in texts]
    is_match = _NUMBER_WITH_COMMA.fullmatch
    rows = [words for words in tails if len(words) == n_numbers and any(map(is_match, words))]
    words = [word for row in rows for word in row]
    return any("," in word for word in words) and all(map(is_match, words))


def to_number(word: str) -> float | None:
    """Return the number that a word represents, finite or not; None for another word."""
    try:
        # float() also takes Python's notation "1_000", but "2024_01" is the name of an image.
        return float(word) if "_" not in word else None
    except ValueError:
        return None


def parse_number(word: str, path: Path, line: int) -> float:
    """Return the finite number that a word of a text file represents. Raises InputError with the
    line.
    """
    value = to_number(word)
    if value is None or not np.isfinite(value):
        what = "a number" if value is None else "a finite number"
        raise InputError(f'found "{word[:40]}", expected {what}', path, line=line)
    return value


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
"""Classes of numeric arrays. MATLAB stores numbers in the smallest type that can represent them: a
double may be stored as bytes."""


class _Variable(NamedTuple):
    """A numeric variable of a file: its name, shape and type, and the place, length and byte order
    of its element.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    order: str
    start: int
    length: int
    compressed: bool


def read_mat(path: Path, expected: ExpectedSize | None) -> Array:
    """Return the array Normal_gt of a file, or else its only array H x W x 3, with the type that it
    has in MATLAB.

    Sizes are checked before anything is read or expanded.

    Raises:
        InputError: the array is missing, too large or not of the expected size.
        KeyError, ValueError, struct.error, zlib.error: the file is damaged.
    """
    with path.open("rb") as file:
        variables = list(_variables(file, path))
        variable = next((v for v in variables if v.name == "Normal_gt"), None)
        if variable is None:
            maps = {v.name: v for v in variables if len(v.shape) == 3 and v.shape[2] == 3}
            if len(maps) != 1:
                raise InputError(
                    "found no Normal_gt, and of other H x W x 3 arrays"
                    f" {', '.join(maps) or 'none'}, expected one",
                    path,
                )
            (variable,) = maps.values()
        check_vectors(variable.shape, path)
        check_stored_size(variable.shape, 8, path, expected)
        return _numbers(file, variable)


def read_matrix(path: Path, choose: Callable[[dict[str, tuple[int, ...]]], str]) -> Array:
    """Return the numeric matrix of a small file whose name is chosen from the shapes by name.

    Only this one is expanded. Raises InputError, also those of `choose`.
    """
    with (
        damage_as_input_error(path, "the .mat file is damaged", "Save it again"),
        path.open("rb") as file,
    ):
        found = {
            v.name: v
            for v in _variables(file, path)
            if len(v.shape) == 2 and 0 < math.prod(v.shape) <= 1 << 20
        }
        return _numbers(file, found[choose({name: v.shape for name, v in found.items()})])


def _numbers(file: BinaryIO, variable: _Variable) -> Array:
    most = 8 * math.prod(variable.shape) + (1 << 16)
    content = _read(file, variable.start, variable.length, most, compressed=variable.compressed)
    kind, numbers = next(islice(_parts(content, variable.order), 3, None))
    stored = np.frombuffer(numbers, variable.order + _NUMBERS[kind])
    return stored.astype(variable.dtype, copy=False).reshape(variable.shape, order="F")


def _variables(file: BinaryIO, path: Path) -> Iterator[_Variable]:
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
            # 4096 bytes are enough for its sizes and its name.
            parts = _parts(_read(file, start, length, 1 << 12, compressed=compressed), order)
            (flags, *_) = struct.unpack(order + "II", next(parts)[1])
            if flags & 0xFF in _CLASSES and not flags & (1 << 11):  # of complex numbers
                shape, name = next(parts)[1], next(parts)[1]
                sizes = struct.unpack(f"{order}{len(shape) // 4}I", shape)
                dtype = _CLASSES[flags & 0xFF]
                yield _Variable(
                    bytes(name).decode("latin-1"), sizes, dtype, order, start, length, compressed
                )
        file.seek(start + length)
    raise ValueError("the file has too many elements")


def _read(file: BinaryIO, start: int, length: int, most: int, *, compressed: bool) -> memoryview:
    """Return the content of a matrix, up to a number of bytes."""
    file.seek(start)
    content = file.read(min(length, most))
    if compressed:
        content = zlib.decompressobj().decompress(content, most)
    return memoryview(content)[_TAG_BYTES if compressed else 0 :]


def _parts(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield the type and bytes of each part of a matrix: flags, sizes, name, numbers. Parts are
    padded to 8 bytes.
    """
    place = 0
    while place + _TAG_BYTES <= len(content):
        kind, length = struct.unpack_from(order + "II", content, place)
        if kind >> 16:  # up to four bytes are stored in the tag
            yield kind & 0xFFFF, content[place + 4 : place + 4 + (kind >> 16)]
            length = 0
        else:
            yield kind, content[place + _TAG_BYTES : place + _TAG_BYTES + length]
        place += _TAG_BYTES + -(-length // 8) * 8
