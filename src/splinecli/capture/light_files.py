"""Light directions and intensities from files: N x 3 or 3 x N, with or without a count line, or with names of images.

Frame: x right, y up, z to the camera; a direction points from the object to the light.

Light files that name the image of each light: RTI's .lp, the JSON of AliceVision (Meshroom), and text. The names often
come from another machine, with folders that do not exist here, or are only numbers. So the images of the folder are
matched to them by base name, then by name without suffix, then by order.
"""

import io
import json
import reprlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.formats.numbers import (
    DECIMAL_POINT,
    NumberRows,
    columns,
    has_decimal_commas,
    parse_number,
    read_lines,
    read_number_rows,
    split_words,
    uses_decimal_commas,
)
from splinecli.capture.light_rows import (
    ARRAY_SUFFIXES,
    COLUMNS,
    USUAL_FRAME,
    LightFrame,
    RowForm,
    check_angles,
    counts_rows,
    directions_from_angles,
    image_name,
    read_array_file,
    read_light_rows,
    refuse_angles,
)
from splinecli.errors import InputError, UsageError
from splinecli.maths import Doubles
from splinecli.maths.normals import unit
from splinecli.system.files import StrPath, parse_json

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
    if path.suffix.lower() in ARRAY_SUFFIXES:
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


NAMED_SUFFIXES = (".lp", ".json")
_MOST_DIGITS = 9  # of the number of lights


@dataclass(frozen=True, eq=False)
class NamedLights:
    """F lights, each with the name of its image."""

    path: Path
    names: tuple[str, ...]  # names of the images, without folders
    lines: tuple[int | None, ...]  # the line of each light in the file; None for each where the file has no lines
    directions: Doubles  # (F, 3) float64, unit; x right, y up, z to the camera
    intensities: Doubles | None = None  # (F, 3) float64, RGB, or None where the file has none

    def match(self, images: Sequence[Path]) -> tuple[tuple[Path, ...], str]:
        """Return the image of each light, and how it was matched: "name", "name without suffix" or "order".

        Images that no light names are left out, unless they are matched by order. Raises InputError where two lights
        have one name, or neither the names nor the number of images fit.
        """
        lines: dict[str, int | None] = {}
        for name, line in zip(self.names, self.lines, strict=True):
            if name.casefold() in lines:
                raise InputError(f'a second light for the image "{name}"', path=self.path, line=line)
            lines[name.casefold()] = line
        for how, part in (("name", "name"), ("name without suffix", "stem")):
            by_key = {getattr(image, part).casefold(): image for image in reversed(images)}
            wanted = [getattr(Path(name), part).casefold() for name in self.names]
            if len(set(wanted)) == len(wanted) and all(name in by_key for name in wanted):
                return tuple(by_key[name] for name in wanted), how
        if len(images) == len(self.names):
            return tuple(images), "order"
        present = {image.name.casefold() for image in images}
        missing = next((i for i, name in enumerate(self.names) if name.casefold() not in present), 0)
        raise InputError(
            f"found {len(self.names)} lights but {len(images)} images;"
            f' the image "{self.names[missing]}" is not among them',
            path=self.path,
            line=self.lines[missing],
            hint="Correct the names in the file, or give as many images as lights, in the same order",
        )


def read_lights(
    path: Path, n_images: int, frame: LightFrame = USUAL_FRAME, form: RowForm = "xyz"
) -> NamedLights | Doubles:
    """Return the lights of any light file: directions (F, 3) in the order of the images, or lights that name theirs.

    The frame of a JSON file is relative to AliceVision's, which has y down and z away. Raises InputError; see
    read_light_directions.
    """
    if path.suffix.lower() in NAMED_SUFFIXES:
        return _read_json(path, frame) if path.suffix.lower() == ".json" else _read_lp(path, frame)
    table = read_light_table(path, n_images, form)
    _, directions = lights_of(table, n_images if table.names is None else None, frame, form)
    if table.names is None:
        return directions
    return NamedLights(path, table.names, tuple(row.line for row in table.rows), directions)


def check_writable(path: Path) -> None:
    """Raise UsageError for a light file whose format is only read."""
    suffix = path.suffix.lower()
    if suffix not in (".lp", ".npy") and suffix in (*NAMED_SUFFIXES, *ARRAY_SUFFIXES):
        raise UsageError(f"{path}: light files of the type {suffix} are only read", hint="Write .txt, .lp or .npy")


def encode_lights(path: Path, directions: Doubles, images: Sequence[Path]) -> bytes:
    """Return a light file of directions (F, 3) of images, in the format that its suffix names; see check_writable."""
    suffix, text = path.suffix.lower(), rows_text(directions)
    if suffix == ".npy":
        np.save(file := io.BytesIO(), directions)
        return file.getvalue()
    if suffix == ".lp":
        rows = zip(images, text.splitlines(), strict=True)
        text = f"{len(images)}\n" + "".join(f"{image.name} {row}\n" for image, row in rows)
    return text.encode(errors="surrogateescape")


def _read_lp(path: Path, frame: LightFrame) -> NamedLights:
    """Read RTI's format: the number of lights, then a line `file name x y z` for each. Names may contain spaces."""
    stored = read_lines(path, else_latin_1=True)
    content = [(line, text.strip()) for line, text in enumerate(stored, start=1) if text.strip()]
    if not content:
        raise InputError("the file is empty, expected the number of lights on the first line", path=path)
    (first, count), *rows = content
    if not count.isdecimal():
        raise InputError(f'found "{count[:40]}", expected the number of lights', path=path, line=first)
    if int(count[:_MOST_DIGITS]) != len(rows):
        problem = f"the first line says {count[:40]} lights, but {len(rows)} lines follow"
        raise InputError(problem, path=path, line=first, hint="Correct the number, or restore the missing lines")
    if not rows:
        raise InputError("the file contains no lights", path=path, line=first)
    names, vectors = [], []
    commas = uses_decimal_commas([text for _, text in rows], 3)
    for line, text in rows:
        words = text.rsplit(maxsplit=3)
        if len(words) < 4:
            raise InputError(f'found "{text[:40]}", expected a file name and x y z', path=path, line=line)
        names.append(image_name(words[0], []))
        numbers = split_words(" ".join(words[1:]), decimal_commas=commas)
        vectors.append([parse_number(word, path, line) for word in numbers[:3]])
    lines = tuple(line for line, _ in rows)
    directions = unit_directions(np.array(vectors) @ frame.matrix.T + 0.0, path, lines, [""] * len(lines))
    return NamedLights(path, tuple(names), lines, directions)


def _read_json(path: Path, frame: LightFrame) -> NamedLights:
    """Read AliceVision's lights: objects with viewId, type (directional), direction [x, y, z], intensity [r, g, b]."""
    try:
        document = parse_json("\n".join(read_lines(path)))
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON ({error.msg})", path=path, line=error.lineno) from None
    except ValueError as error:
        raise InputError(f"cannot be read as JSON ({error})", path=path) from None
    lights = document.get("lights") if isinstance(document, dict) else None
    if not isinstance(lights, list) or not lights:
        raise InputError('found no list "lights", expected lights as AliceVision writes them', path=path)
    names, vectors, intensities = [], [], []
    for number, light in enumerate(lights, start=1):
        if not isinstance(light, dict):
            raise InputError(f"light {number} is not an object", path=path)
        kind = light.get("type", "directional")
        if kind != "directional":
            problem = f"light {number} is of type {reprlib.repr(kind)}, expected 'directional'"
            raise InputError(problem, path=path, hint="Calibrate for distant lights, one direction a light")
        names.append(image_name(str(light.get("viewId", number)), []))
        vectors.append(_three_numbers(light, "direction", number, path))
        if "intensity" in light:
            intensities.append(_three_numbers(light, "intensity", number, path))
            if (least := min(intensities[-1])) <= 0:
                raise InputError(f"light {number} has the intensity {least:g}, expected above 0", path=path)
    if intensities and len(intensities) != len(lights):
        problem = f"{len(intensities)} of {len(lights)} lights have an intensity, expected all or none"
        raise InputError(problem, path=path)
    turned = np.array(vectors) * (1.0, -1.0, -1.0) @ frame.matrix.T + 0.0  # no -0
    lines, places = (None,) * len(lights), [f" as light {number}" for number in range(1, len(lights) + 1)]
    directions = unit_directions(turned, path, lines, places)
    return NamedLights(path, tuple(names), lines, directions, np.array(intensities) if intensities else None)


def _three_numbers(light: dict[str, Any], key: str, number: int, path: Path) -> list[float]:
    values = light.get(key)
    numbers = [
        float(value)
        for value in (values if isinstance(values, list) else ())
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    ]
    if len(numbers) != 3 or len(values or ()) != 3:
        raise InputError(f"light {number} has {key!r} {reprlib.repr(values)}, expected three numbers", path=path)
    return numbers
