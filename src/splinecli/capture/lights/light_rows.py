"""Rows of light files as text, with or without a header, and with a column that tells the image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from splinecli.capture.formats.text import NumberRows, is_number, read_lines, split_words, uses_decimal_commas

_FOLDERS = re.compile(r"[/\\]")


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

    Rows that begin with a word belong to named images, as "img 1.png 0 0 1": the last numbers are the light.

    Args:
        expected: what the file should be, for messages.
        n_numbers: the number of numbers that follow a name.

    Raises:
        InputError: with the line, for a word that is no finite number; also for a file without rows.
    """
    numbered = enumerate(read_lines(path, expected=expected), start=1)
    content = [(line, text.partition("#")[0].strip()) for line, text in numbered]
    content = [(line, text) for line, text in content if text.strip(" ,;")]
    commas = uses_decimal_commas([text for _, text in content], n_numbers)
    rows = [(line, text, split_words(text, decimal_commas=commas)) for line, text in content]
    if len(rows) > 1 and not any(is_number(word) for word in rows[0][2]):
        rows = rows[1:]
    # A count may stand before rows with names.
    body = rows[1:] if len(rows) > 1 and len(rows[0][2]) == 1 else rows
    if body and all(len(words) > n_numbers and not is_number(words[0]) for _, _, words in body):
        names = tuple(image_name(text, words[-n_numbers:]) for _, text, words in body)
        without_names = [(line, text, words[-n_numbers:]) for line, text, words in body]
        return LightRows(NumberRows.from_words(path, without_names), names)
    return LightRows(NumberRows.from_words(path, rows))


def image_name(text: str, numbers: list[str]) -> str:
    """Return what stands before the last numbers of a row, without folders, quotes and separators."""
    for word in reversed(numbers):
        text = text.rstrip(" \t,;")[: -len(word)]
    return _FOLDERS.split(text.strip(" \t,;\"'"))[-1]
