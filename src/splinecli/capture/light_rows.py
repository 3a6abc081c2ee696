"""Rows of light files, which contain vectors or angles, and their frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from splinecli.capture.formats.numbers import (
    NumberRow,
    NumberRows,
    parse_rows,
    read_rows_of_words,
    to_number,
)
from splinecli.errors import InputError, UsageError, did_you_mean
from splinecli.maths import Bools, Float64Array

AXIS_WORDS = {
    "x-right": (0, 1),
    "x-left": (0, -1),
    "y-up": (1, 1),
    "y-down": (1, -1),
    "z-camera": (2, 1),
    "z-away": (2, -1),
}
"""The words of --light-frame, each with its axis in the file and the axis's sign in the usual
frame.
"""

_LEAST, _MOST = 1e-12, 1e12
INTENSITY_RANGE = f"from {_LEAST:g} to {_MOST:g}"
"""The range of light intensities. Within it, numbers and their inverses fit into float32."""

EXCHANGED = "swap-xy"  # the word for files whose first column is y and whose second column is x


@dataclass(frozen=True)
class LightFrame:
    """The frame of a light file."""

    # of x, y and z: 1 for right, up and towards the camera; -1 for left, down and away
    signs: tuple[int, int, int] = (1, 1, 1)
    # whether y precedes x in the file. The signs apply to x and y in either case
    exchanged: bool = False
    # position of the file's origin, for lamp positions
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def matrix(self) -> Float64Array:
        """The matrix M (3, 3) such that directions @ M' are in the usual frame."""
        order = [1, 0, 2] if self.exchanged else [0, 1, 2]
        return np.diag(self.signs).astype(np.float64)[:, order]

    def __str__(self) -> str:
        """Return the value of --light-frame, such as "x-left,y-down", which omits axes in their
        usual direction.
        """
        words = [EXCHANGED] if self.exchanged else []
        words += [word for word, (axis, sign) in AXIS_WORDS.items() if sign == self.signs[axis] < 0]
        return ",".join(words) or "x-right,y-up"

    def describe(self) -> str:
        """Return a description such as "x and y exchanged, y negated"; empty for the usual
        frame.
        """
        parts = ["x and y exchanged"] if self.exchanged else []
        if negated := [axis for axis, sign in zip("xyz", self.signs, strict=True) if sign < 0]:
            parts.append(f"{' and '.join(negated)} negated")
        return ", ".join(parts)

    def after(self, first: LightFrame) -> LightFrame:
        """Return the frame that results from applying `first` and then this frame."""
        x, y, z = (int(sign) for sign in (self.matrix @ first.matrix).sum(axis=1))
        return LightFrame((x, y, z), self.exchanged != first.exchanged)


USUAL_FRAME = LightFrame()  # x right, y up, z to the camera, as in docs/files-and-frames.md

BOTH_NEGATED = LightFrame((-1, -1, 1))

PLANE_FRAMES = tuple(
    LightFrame((x, y, 1), exchanged) for exchanged, x, y in product((False, True), (1, -1), (1, -1))
)
"""The eight frames in which z points to the camera, starting with the usual one."""


def parse_light_frame(text: str | None) -> LightFrame:
    """Return the frame described by a list such as "x-left,y-down,swap-xy"; None is the usual
    frame.

    Axes that are not listed keep their usual direction. Raises UsageError for an unknown word or a
    repeated axis.
    """
    if text is None:
        return USUAL_FRAME
    signs: dict[int, int] = {}
    exchanged = False
    for word in (item.strip() for item in text.split(",")):
        if word == EXCHANGED:
            exchanged = True
            continue
        if word not in AXIS_WORDS:
            words = ", ".join((*AXIS_WORDS, EXCHANGED))
            raise UsageError(
                f"--light-frame is {text!r}; expected one or more of {words}, separated by commas",
                hint=did_you_mean(word, (*AXIS_WORDS, EXCHANGED)),
            )
        axis, sign = AXIS_WORDS[word]
        if axis in signs:
            raise UsageError(
                f"--light-frame is {text!r}, where {'xyz'[axis]} is listed twice",
                hint="Remove one of them",
            )
        signs[axis] = sign
    return LightFrame((signs.get(0, 1), signs.get(1, 1), signs.get(2, 1)), exchanged)


LightForm = Literal["xyz", "azel", "slant-tilt"]
"""The numbers that define a light: a vector, azimuth and elevation, or slant and tilt (HALCON).
Angles are in degrees.
"""

RowForm = LightForm | Literal["positions"]  # the numbers in a row of a light file

COLUMNS: dict[RowForm, dict[int, str]] = {
    "xyz": {3: "x y z"},
    "azel": {2: "azimuth elevation"},
    "slant-tilt": {2: "slant tilt"},
    "positions": {3: "x y z"},
}
"""The number of columns of each form and their meaning."""

AZEL_HINT = "If they are azimuth and elevation in degrees, add --light-format azel"


def directions_from_angles(angles_deg: Float64Array, form: RowForm) -> Float64Array:
    """Return unit vectors (F, 3) from azimuth and elevation, or from slant and tilt (F, 2), in
    degrees.

    Azimuth and tilt are measured from x (right) towards y (up), elevation from the image plane
    towards the camera, and slant from the camera axis.
    """
    azimuth, elevation = np.radians(
        [_azimuth_elevation(row, form) for row in angles_deg.tolist()]
    ).T
    level = np.cos(elevation)
    return np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)


def _azimuth_elevation(row: Sequence[float], form: RowForm) -> tuple[float, float]:
    first, second = row[-2:]
    return (second, 90 - first) if form == "slant-tilt" else (first, second)


def check_angles(table: NumberRows, form: RowForm) -> None:
    """Raise InputError, with the line, for rows whose last two columns are not valid angles."""
    for row in table.rows:
        first, second = row.numbers[-2:]
        azimuth, elevation = _azimuth_elevation(row.numbers, form)
        if not (0 < elevation <= 90 and abs(azimuth) <= 360):
            if form == "slant-tilt":
                problem = (
                    f"found slant {first:g} and tilt {second:g}, expected slants from 0 to below 90"
                    " and tilts from -360 to 360 degrees"
                )
                hint = "The slant is measured from the camera axis"
            else:
                problem = (
                    f"found azimuth {first:g} and elevation {second:g}, expected azimuths from -360"
                    " to 360 and elevations from above 0 to 90 degrees"
                )
                hint = "Elevation is measured from the image plane, so 90 points towards the camera"
            raise InputError(problem, table.path, line=row.line, hint=hint)
    if np.abs([row.numbers[-2:] for row in table.rows]).max() < 2 * np.pi:
        raise InputError(
            "found no angle above 2 pi, which suggests radians, expected degrees",
            table.path,
            line=table.rows[0].line,
            hint="Multiply them by 180 / pi = 57.2958",
        )


def zenith_as_elevation(light_directions: Float64Array) -> Float64Array:
    """Return lights (..., 3) as they would be if their angle from the camera axis had been read as
    elevation.
    """
    level = np.linalg.norm(light_directions[..., :2], axis=-1, keepdims=True)
    across = light_directions[..., :2] / np.maximum(level, 1e-9) * light_directions[..., 2:]
    return np.concatenate((across, level), axis=-1)


def lights_of_half_vectors(half_vectors: Float64Array) -> Float64Array:
    """Return the directions (..., 3) of lights that mirrors with these unit normals reflect towards
    the camera.
    """
    return 2 * half_vectors[..., 2:] * half_vectors - (0.0, 0.0, 1.0)


def refuse_angles(table: NumberRows) -> None:
    """Raise InputError for rows that clearly contain angles.

    Such rows have two columns, or a third column that numbers them or repeats the same radius.
    """
    rows = [row.numbers for row in table.rows]
    lengths = {len(row) for row in rows}
    if len(rows) <= 3 or lengths not in ({2}, {3}):
        return
    numbered = lengths == {3} and counts_rows([row[0] for row in rows]) is not None
    found, hint = "", AZEL_HINT
    if max(abs(value) for row in rows for value in row[-2:]) > 2 and (lengths == {2} or numbered):
        found = (
            f"{'a number and two angles' if numbered else '2 columns of angles'}, expected 3"
            " columns (x y z)"
        )
    elif lengths == {3} and not numbered:
        # Vectors of lights from all sides would include some with y < 0.
        azimuth, elevation, radius = np.array(rows).T
        in_range = (np.abs(azimuth) <= 360).all() and ((elevation > 0) & (elevation <= 90)).all()
        if np.ptp(radius) == 0 and in_range and elevation.max() > 2 and np.abs(azimuth).max() > 90:
            found, hint = (
                f"azimuth, elevation and {radius[0]:g}, expected x y z",
                f"Remove the third column. {hint}",
            )
    if found:
        raise InputError(f"found {found}", table.path, line=table.rows[0].line, hint=hint)


def counts_rows(column: list[float]) -> int | None:
    """Return the first number, 0 or 1, if a column numbers the rows in any order, or None for any
    other column.
    """
    first = min(column)
    counts = first in (0, 1) and sorted(column) == [first + place for place in range(len(column))]
    return int(first) if counts else None


_AXIS = re.compile(r"(?:.*[^a-z]|[lnd]|light|pos|position|dir|direction)?([xyz])")
_ANGLE = re.compile(r"(az|el|alt|slant|tilt)")
_AXES, _ANGLES, _SLANTS = ("x", "y", "z"), ("az", "el"), ("slant", "tilt")


def read_light_rows(path: Path, *, expected: str, n_numbers: int) -> NumberRows:
    """Return the rows of a text file without "#" comments, blank lines or a header.

    A first row without numbers is a header. If it names the columns, as in "z y x" or "elevation
    azimuth", they are reordered. Rows that begin with a word name their image: in "img 1.png 0 0
    1", the last three numbers are the light.

    Args:
        n_numbers: the number of values that follow a name.

    Raises:
        InputError: with the line, for a word that is not a finite number; also for a file without
            rows, and if the header or rows clearly contain angles although vectors are expected.
    """
    rows = read_rows_of_words(path, n_numbers, expected=expected)
    order = list(range(n_numbers))
    if len(rows) > 1 and all(to_number(word) is None for word in rows[0][2]):
        line, _, header = rows.pop(0)
        order = _order_of(header[-n_numbers:])
        zenith = ("zen", "polar", "incl", "colat", "coelev")
        found = next((word for word in header if word.lower().startswith(zenith)), None)
        if found is not None and n_numbers == len(_ANGLES):
            raise InputError(
                f'found the column "{found[:40]}", expected azimuth and elevation',
                path,
                line=line,
                hint="The elevation is 90 minus the angle from the camera axis",
            )
    # Rows with names may be preceded by a count.
    body = rows[1:] if len(rows) > 1 and len(rows[0][2]) == 1 else rows
    if body and all(to_number(words[0]) is None for *_, words in body):
        if all(len(words) > n_numbers for *_, words in body):
            names = tuple(image_name(text, words[-n_numbers:]) for _, text, words in body)
            without_names = [(line, text, words[-n_numbers:]) for line, text, words in body]
            return replace(_reordered(parse_rows(without_names, path), order), names=names)
        angles = [words[1:] for *_, words in body if None not in map(to_number, words[1:])]
        if n_numbers == len(_AXES) and [len(words) for words in angles] == len(body) * [
            len(_ANGLES)
        ]:
            raise InputError(
                "found a name and 2 numbers, expected a name and 3 (x y z)",
                path,
                line=body[0][0],
                hint=AZEL_HINT,
            )
    return _reordered(parse_rows(rows, path), order)


def _order_of(header: list[str]) -> list[int]:
    """Return the positions of x, y and z, azimuth and elevation, or slant and tilt in a header.

    Return the usual order for any other header.
    """
    words = [word.lower().strip("\"'") for word in header]
    for pattern, wanted in (
        (_AXIS.fullmatch, _AXES),
        (_ANGLE.match, _ANGLES),
        (_ANGLE.match, _SLANTS),
    ):
        found = [match[1].replace("alt", "el") for word in words if (match := pattern(word))]
        if len(words) == len(wanted) and sorted(found) == sorted(wanted):
            return [found.index(name) for name in wanted]
    return list(range(len(header)))


def _reordered(table: NumberRows, order: list[int]) -> NumberRows:
    first = -len(order)

    def reorder(row: NumberRow) -> NumberRow:
        last = row.numbers[first:]
        if len(last) < len(order):
            return row
        return row._replace(numbers=(*row.numbers[:first], *(last[i] for i in order)))

    return replace(table, rows=tuple(map(reorder, table.rows)))


def image_name(text: str, numbers: list[str]) -> str:
    """Return the image name in a row that ends with numbers, without folders, quotes or
    separators.
    """
    for word in reversed(numbers):
        text = text.rstrip(" \t,;")[: -len(word)]
    return re.split(r"[/\\]", text.strip(" \t,;\"'"))[-1]


def usable_intensities(values: Float64Array) -> Bools:
    """Return which values are within INTENSITY_RANGE, as booleans of the same shape."""
    return (values >= _LEAST) & (values <= _MOST)
