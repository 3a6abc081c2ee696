"""Rows of light files as text, with or without a header, and with a column that tells the image."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from splinecli.capture.formats.text import NumberRows, is_number, read_lines, split_words, uses_decimal_commas
from splinecli.capture.lights.light_angles import AZEL_HINT, refuse_zenith
from splinecli.errors import InputError

_FOLDERS = re.compile(r"[/\\]")
_AXIS = re.compile(r"(?:.*[^a-z]|[lnd]|light|pos|position|dir|direction)?([xyz])")
_ANGLE = re.compile(r"(az|el|alt)")
_AXES, _ANGLES = ("x", "y", "z"), ("az", "el")


@dataclass(frozen=True)
class LightRows:
    """The rows of a light file.

    Args:
        numbers: without a header and without names.
        names: the name of each row's image, without folders; None where the rows begin with numbers.
    """

    numbers: NumberRows
    names: tuple[str, ...] | None = None


def read_light_rows(path: Path, *, expected: str, n_numbers: int) -> LightRows:
    """Return the rows of a text file, without "#" comments, blank lines and a header (a first row without numbers).

    Rows that begin with a word belong to named images, as "img 1.png 0 0 1": the last numbers are the light. A header
    that names them, as "z y x" or "elevation azimuth", gives their order.

    Args:
        expected: what the file should be, for messages.
        n_numbers: the number of numbers that follow a name.

    Raises:
        InputError: with the line, for a word that is no finite number; also for a file without rows, and for a header
            or rows that are plainly other angles than expected.
    """
    numbered = enumerate(read_lines(path, expected=expected), start=1)
    content = [(line, text.partition("#")[0].strip()) for line, text in numbered]
    content = [(line, text) for line, text in content if text.strip(" ,;")]
    commas = uses_decimal_commas([text for _, text in content], n_numbers)
    rows = [(line, text, split_words(text, decimal_commas=commas)) for line, text in content]
    order = list(range(n_numbers))
    if len(rows) > 1 and not any(is_number(word) for word in rows[0][2]):
        line, _, header = rows.pop(0)
        order = _order_of(header[-n_numbers:])
        if n_numbers == len(_ANGLES):
            refuse_zenith(header, path, line)
    # A count may stand before rows with names.
    body = rows[1:] if len(rows) > 1 and len(rows[0][2]) == 1 else rows
    if body and all(len(words) > n_numbers and not is_number(words[0]) for _, _, words in body):
        names = tuple(image_name(text, words[-n_numbers:]) for _, text, words in body)
        without_names = [(line, text, words[-n_numbers:]) for line, text, words in body]
        return LightRows(_reordered(NumberRows.from_words(path, without_names), order), names)
    if n_numbers == len(_AXES) and body and all(_is_named_angles(words) for *_, words in body):
        raise InputError(
            "found a name and 2 numbers, expected a name and 3 (x y z)",
            path=path,
            line=body[0][0],
            hint=AZEL_HINT,
        )
    return LightRows(_reordered(NumberRows.from_words(path, rows), order))


def _order_of(header: list[str]) -> list[int]:
    """Return the places of x, y and z, or of azimuth and elevation, in a header; their usual places in any other."""
    words = [word.lower().strip("\"'") for word in header]
    for pattern, wanted in ((_AXIS.fullmatch, _AXES), (_ANGLE.match, _ANGLES)):
        found = [match[1].replace("alt", "el") for word in words if (match := pattern(word))]
        if len(words) == len(wanted) and sorted(found) == sorted(wanted):
            return [found.index(name) for name in wanted]
    return list(range(len(header)))


def _reordered(numbers: NumberRows, order: list[int]) -> NumberRows:
    """Return rows whose last numbers are in the order given."""
    first = -len(order)
    rows = tuple(
        (*row[:first], *(row[first:][i] for i in order)) if len(row) >= len(order) else row for row in numbers.rows
    )
    return replace(numbers, rows=rows)


def _is_named_angles(words: list[str]) -> bool:
    name, *numbers = words
    return not is_number(name) and len(numbers) == len(_ANGLES) and all(map(is_number, numbers))


def image_name(text: str, numbers: list[str]) -> str:
    """Return what stands before the last numbers of a row, without folders, quotes and separators."""
    for word in reversed(numbers):
        text = text.rstrip(" \t,;")[: -len(word)]
    return _FOLDERS.split(text.strip(" \t,;\"'"))[-1]
