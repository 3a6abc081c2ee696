"""Read numbers from text files with any separator, byte order marks, comments and blank lines."""

import codecs
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splinecli.capture.formats.facts import JPEG, PNG, TIFF
from splinecli.errors import InputError
from splinecli.maths import Float64Array
from splinecli.system.files import check_file, is_substitution, reading

_SEPARATORS = re.compile(r"[\s,;]+")
_SEPARATORS_BESIDE_COMMAS = re.compile(r"[\s;]+")
_NUMBER_WITH_COMMA = re.compile(r"(?=\D*\d)[+-]?\d*(,\d+)?([eE][+-]?\d+)?")

_FROM_PIPES: dict[Path, bytes] = {}

# A row's one-based line number, its text without comments, and its words
WordRow = tuple[int, str, list[str]]

MOST_TEXT = 1_000_000
"""Size limit of text files in bytes if the number of images is unknown; enough for 14,000
lights.
"""

# Hint for a line with decimal commas
DECIMAL_POINT = "Commas separate columns, so use a point as the decimal separator"


class NumberRow(NamedTuple):
    """A row of numbers, its one-based line number, and its text without comments."""

    numbers: tuple[float, ...]
    line: int | None  # None in a file without lines, such as JSON
    text: str = ""


@dataclass(frozen=True)
class NumberRows:
    """The rows of numbers in a text file. There is at least one row. All numbers are finite, and
    rows may differ in length.
    """

    path: Path
    rows: tuple[NumberRow, ...] = field(repr=False)
    # image names of the rows, without folders; None if rows begin with numbers
    names: tuple[str, ...] | None = None
    intensities: Float64Array | None = None  # (R, 3) RGB light intensities, if the file has them
    # whether each row is a vector x y z, because the format has no other rows
    are_vectors: bool = False

    def as_array(self) -> Float64Array:
        """Return the rows as an array (R, C) float64. Raises InputError for the first row whose
        length differs.
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
    """Return whether a line seems to contain decimal commas, as in "0,5 0,3 0,8"."""
    has_both = re.search(r"\d,\d", text) and re.search(r"[\s;]", text)
    return "." not in text and has_both is not None


def check_text_length(path: Path, most: int, expected: str = "a text file") -> None:
    """Raise InputError for a text file longer than `most` bytes, and for a path that is not a
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
    """Return the bytes of a text file, or of a pipe such as the shell's `<(...)`.

    The content of a pipe is cached, because it can be read only once. Raises InputError if the path
    does not exist, is not a file, or has more than `most` bytes. `expected` describes the expected
    content in messages.
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
    """Return the lines of a file in UTF-8, or in UTF-16 with a byte order mark. Raises InputError.

    With else_latin_1, a file that is not UTF-8 is read as Latin-1, as written by older Windows
    programs. For the other arguments, see read_text.
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
    if len(lines) > most // 20:  # 20 bytes per line, because lines take time and memory
        raise InputError(f"found {len(lines)} lines, expected at most {most // 20}", path)
    return lines


def read_number_rows(
    path: Path, *, expected: str = "a text file", most: int = MOST_TEXT
) -> NumberRows:
    """Return the rows of numbers in a text file, without "#" comments and blank lines.

    Numbers are separated by spaces, tabs, commas or semicolons. For the arguments, see read_text.
    Raises InputError with the line for a word that is not a finite number, and for a file without
    numbers.
    """
    return parse_rows(read_rows_of_words(path, 3, expected=expected, most=most), path)


def read_rows_of_words(
    path: Path, n_numbers: int, *, expected: str, most: int = MOST_TEXT
) -> list[WordRow]:
    """Return the words of each non-empty line, with decimal commas converted to points.

    Each line ends with n_numbers numbers. For the other arguments, see read_text. Raises
    InputError.
    """
    stored = enumerate(read_lines(path, expected=expected, most=most), start=1)
    content = [(line, text.partition("#")[0].strip()) for line, text in stored]
    content = [(line, text) for line, text in content if text.strip(" ,;")]
    if content and content[0][1][0] in "[(":  # a list as printed by Python or NumPy
        parts = [(line, part) for line, text in content for part in re.split(r"[\])]", text)]
        content = [(line, text) for line, part in parts if (text := part.strip(" \t,;[("))]
    commas = uses_decimal_commas([text for _, text in content], n_numbers)
    return [(line, text, split_words(text, decimal_commas=commas)) for line, text in content]


def parse_rows(rows: Sequence[WordRow], path: Path) -> NumberRows:
    """Return the numbers in rows of words.

    Raises InputError, with the line, for a word that is not a finite number, and for an empty list.
    """
    if not rows:
        raise InputError("the file contains no numbers", path)
    parsed = (
        NumberRow(tuple(parse_number(word, path, line) for word in words), line, text)
        for line, text, words in rows
    )
    return NumberRows(path, tuple(parsed))


def split_words(text: str, *, decimal_commas: bool = False) -> list[str]:
    """Return the words of a line, with decimal commas converted to points."""
    separators = _SEPARATORS_BESIDE_COMMAS if decimal_commas else _SEPARATORS
    words = [word for word in separators.split(text) if word]
    if decimal_commas:
        is_number = _NUMBER_WITH_COMMA.fullmatch
        return [word.replace(",", ".") if is_number(word) else word for word in words]
    return words


def uses_decimal_commas(texts: Sequence[str], n_numbers: int) -> bool:
    """Return whether the last numbers of the lines have decimal commas, as in "0,5 0,3 0,8"."""
    tails = [_SEPARATORS_BESIDE_COMMAS.split(text)[-n_numbers:] for text in texts]
    is_match = _NUMBER_WITH_COMMA.fullmatch
    rows = [words for words in tails if len(words) == n_numbers and any(map(is_match, words))]
    words = [word for row in rows for word in row]
    return any("," in word for word in words) and all(map(is_match, words))


def to_number(word: str) -> float | None:
    """Return the number that a word represents, which may not be finite, or None for any other
    word.
    """
    try:
        # float() also accepts "1_000", but "2024_01" may be the name of an image.
        return float(word) if "_" not in word else None
    except ValueError:
        return None


def parse_number(word: str, path: Path, line: int) -> float:
    """Return the finite number that a word represents. Raises InputError, with the line, for other
    words.
    """
    value = to_number(word)
    if value is None or not np.isfinite(value):
        expected = "a number" if value is None else "a finite number"
        raise InputError(f'found "{word[:40]}", expected {expected}', path, line=line)
    return value
