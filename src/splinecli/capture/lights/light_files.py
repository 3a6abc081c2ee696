"""Light directions and intensities from text and .npy files: N x 3 or 3 x N, with or without a count line.

Frame: x right, y up, z to the camera; a direction points from the object to the light.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splinecli.capture.formats.text import DECIMAL_POINT, NumberRows, columns, has_decimal_commas, read_number_rows
from splinecli.capture.lights.array_files import SUFFIXES, read_array_file
from splinecli.capture.lights.light_frames import USUAL_FRAME, LightFrame
from splinecli.capture.lights.light_rows import (
    COLUMNS,
    RowForm,
    check_angles,
    counts_rows,
    directions_from_angles,
    read_light_rows,
    refuse_angles,
)
from splinecli.errors import InputError
from splinecli.maths import Doubles
from splinecli.maths.normals import unit
from splinecli.system.files import StrPath

_STRONGEST = 1e12  # intensity; float32 computes with it and its inverse
_FILE = "a text file with a line {} for each image"


def read_light_directions(
    path: StrPath, n_images: int | None = None, frame: LightFrame = USUAL_FRAME, form: RowForm = "xyz"
) -> Doubles:
    """Return unit light directions (F, 3) float64 from a text file or an .npy file, in the order of the file.

    A row is x y z, separated by spaces, tabs, commas or semicolons. A header, which may name the columns in another
    order, and a first line with only the number of lights, are accepted (the University of Washington's lights.txt). If
    N x 3 does not fit, 3 x N is read (PSBox); 3 x 3 is read as rows. A first column that counts the rows, from 0 or 1,
    gives their order. Vectors may have any length above zero.

    Args:
        n_images: the number of lights that is expected, if it is known.
        form: whether a row is a vector, two angles, or the position of a lamp.

    Raises:
        InputError: with the line, for a wrong number of columns, a word that is no finite number, a zero
            vector or a light below the horizon; also where the count disagrees with the count line or with
            n_images, and for angles that are read as vectors.
    """
    return lights_of(read_light_table(Path(path), n_images, form), n_images, frame, form)[1]


def read_light_table(path: Path, n_images: int | None, form: RowForm) -> NumberRows:
    """Return the rows of a text file or of a file of matrices. Raises InputError; see read_light_directions."""
    if path.suffix.lower() in SUFFIXES:
        return read_array_file(path, n_images)
    meaning = COLUMNS[form]
    return read_light_rows(path, expected=_FILE.format(*meaning.values()), n_numbers=min(meaning))


def read_light_positions(path: StrPath, n_images: int, frame: LightFrame = USUAL_FRAME) -> Doubles:
    """Return the positions of lamps (F, 3) float64 from a file, which has the form of light directions.

    Raises InputError as read_light_directions, which checks the same numbers as directions from the origin; also for
    rows that name their images.
    """
    table = read_light_table(Path(path), n_images, "positions")
    positions, _ = lights_of(table, n_images, frame, "positions")
    if table.names is not None:
        problem = f"found the name {table.names[0]!r}, expected x y z"
        hint = "Positions have a line for each image, in the order of the images"
        raise InputError(problem, path=table.path, line=table.rows[0].line, hint=hint)
    return positions


def lights_of(table: NumberRows, n_images: int | None, frame: LightFrame, form: RowForm) -> tuple[Doubles, Doubles]:
    """Return vectors (F, 3) of any length in the usual frame, and the same at unit length."""
    table = _sort_by_count(_drop_count_line(table, n_images), min(COLUMNS[form]), n_images)
    if form == "xyz":
        refuse_angles(table)
    what = {"xyz": "light directions", "positions": "lamp positions"}.get(form, "lights")
    vectors, transposed = _one_light_a_row(table, COLUMNS[form], what, n_images)
    if form in ("azel", "slant-tilt"):
        check_angles(table, form)
        vectors = directions_from_angles(vectors, form)
    vectors = vectors @ frame.matrix.T + 0.0  # no -0
    lines = [table.rows[2 if transposed else light].line for light in range(len(vectors))]
    places = [f" in column {light + 1}" if transposed else "" for light in range(len(vectors))]
    return vectors, unit_directions(vectors, table.path, lines, places, lamps=form == "positions")


def unit_directions(
    vectors: Doubles, path: Path, lines: Sequence[int | None], places: Sequence[str], lamps: bool = False
) -> Doubles:
    """Return vectors (F, 3) at unit length.

    Args:
        vectors: of any length.
        places: words for the place of each vector on its line.
        lamps: whether the vectors are positions of lamps, for messages.

    Raises:
        InputError: a zero vector, or a light that is not above the horizon.
    """
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    # First divide by the largest component, because squares of very large or small ones leave float64's range.
    scaled = np.divide(vectors, largest, out=np.zeros_like(vectors), where=largest > 0)
    directions = unit(scaled)
    for vector, z, line, place in zip(vectors, directions[:, 2], lines, places, strict=True):
        if not vector.any():
            problem = f"found a zero vector{place}, expected a {'lamp position' if lamps else 'light direction'}"
            hint = "Write x y z towards the light, or remove the line and its image"
            raise InputError(problem, path=path, line=line, hint=hint)
        if z <= 0:
            raise InputError(
                f"found a {'lamp behind the object' if lamps else 'light below the horizon'}{place}"
                f" (z = {vector[2]:g}), expected z > 0",
                path=path,
                line=line,
                hint="z points away from the camera in this file: add --light-frame z-away"
                if (directions[:, 2] < 0).all()
                else "z points to the camera; the file may be in another frame",
            )
    return directions


def read_light_intensities(path: StrPath, n_images: int) -> Doubles:
    """Return light intensities (F, 3) float64 in RGB order from a text file, N x 3 or 3 x N.

    A single number for each light is used for all three channels. Raises InputError as read_light_directions; also
    with the line for an intensity that is no usable number.
    """
    table = _drop_count_line(read_number_rows(Path(path), expected=_FILE.format("r g b")), n_images)
    names = {3: "R G B", 1: "gray"}
    intensities, transposed = _one_light_a_row(table, names, "light intensities", n_images)
    for light, channel in np.argwhere((intensities < 1 / _STRONGEST) | (intensities > _STRONGEST)):
        value = intensities[light, channel]
        place = f" in column {light + 1}" if transposed else ""
        raise InputError(
            f"found the intensity {value:g}{place}, expected a number"
            f" {'above 0' if value <= 0 else f'from {1 / _STRONGEST:g} to {_STRONGEST:g}'}",
            path=table.path,
            line=table.rows[channel if transposed else light].line,
        )
    return np.broadcast_to(intensities, (n_images, 3)).copy()


def _sort_by_count(table: NumberRows, n_columns: int, n_images: int | None) -> NumberRows:
    """Return the table in the order of a first column that counts the lights, and without that column."""
    rows = table.rows
    fits = {len(row.numbers) for row in rows} == {n_columns + 1} and n_images in (None, len(rows))
    in_columns = n_images is None and len(rows) == n_columns  # one light in each
    if not fits or in_columns or counts_rows([row.numbers[0] for row in rows]) is None:
        return table
    ordered = sorted(rows, key=lambda row: row.numbers[0])
    return replace(table, rows=tuple(row._replace(numbers=row.numbers[1:]) for row in ordered))


def _drop_count_line(table: NumberRows, n_images: int | None) -> NumberRows:
    """Return the table without a first line that only counts the lights."""
    first, *following = table.rows
    if len(first.numbers) != 1 or not following:
        return table
    without, count = replace(table, rows=tuple(following)), first.numbers[0]
    if all(len(row.numbers) == 1 for row in following):
        # In a single column, the first number is a count only if the rest then fits.
        return without if len(following) == count == n_images else table
    if count in (len(following), len(following[0].numbers)):
        return without
    if not count.is_integer():
        expected = columns(len(following[0].numbers))
        raise InputError(f"found 1 column, expected {expected} or a count", path=table.path, line=first.line)
    problem = f"the count line says {count:.0f}, but {len(following)} rows follow"
    raise InputError(problem, path=table.path, line=first.line, hint="Correct the count or leave it out")


def _one_light_a_row(table: NumberRows, names: dict[int, str], what: str, n_images: int | None) -> tuple[Doubles, bool]:
    """Return the numbers with one light in each row, and whether the file has one light in each column.

    `names` has the possible counts of numbers for a light, each with its meaning.
    """
    values = table.as_array()
    n_columns = values.shape[1]
    readings = [(lights, lights is not values) for lights in (values, values.T) if lights.shape[1] in names]
    if not readings:
        expected = " or ".join(f"{count} ({meaning})" for count, meaning in names.items())
        text = table.rows[0].text
        decimal_commas = n_columns > 3 and (has_decimal_commas(text) or (n_columns == 6 and text.count(",") >= 3))
        problem = f"found {columns(n_columns)}, expected {expected}"
        hint = DECIMAL_POINT if decimal_commas else None
        raise InputError(problem, path=table.path, line=table.rows[0].line, hint=hint)
    for lights, transposed in readings:
        if n_images is None or len(lights) == n_images:
            return lights, transposed
    problem = f"found {len(readings[0][0])} {what}, expected {n_images}, one for each image"
    hint = "The file needs one line for each image, in the order of the images"
    raise InputError(problem, path=table.path, hint=hint)


def rows_text(values: Doubles) -> str:
    """Return rows of numbers (F, C) as the lines of a light file."""
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in values)
