"""Light files: the table of their formats, and readers of light directions and intensities for the
images of a capture.

Frame: x right, y up, z to the camera; a direction points from the object to the light.

Image names in a light file are often just numbers, or contain folders of another machine.
Therefore, the images in the folder are matched by base name, then by name without suffix, then by
order.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splinecli.capture import light_formats as readers
from splinecli.capture import light_rows
from splinecli.capture.formats import numbers
from splinecli.capture.formats.numbers import NumberRows
from splinecli.capture.light_rows import USUAL_FRAME, LightFrame, RowForm
from splinecli.capture.lights_in_names import read_names
from splinecli.errors import InputError, UsageError
from splinecli.maths import Bools, Float64Array
from splinecli.maths.normals import unit
from splinecli.system.files import StrPath, is_folder

_FILE = "a text file with one line {} for each image"


class WrongCountError(InputError):
    """A light file contains n_found lights, but the number of images differs."""

    n_found = 0

    def with_hint(self, hint: str) -> "WrongCountError":
        """Return the same error with another hint."""
        error = WrongCountError(self.problem, self.path, hint=hint)
        error.n_found = self.n_found
        return error


def _read_text(path: Path, n_images: int | None, form: RowForm) -> NumberRows:
    meaning = light_rows.COLUMNS[form]
    return light_rows.read_light_rows(
        path, expected=_FILE.format(*meaning.values()), n_numbers=min(meaning)
    )


def _encode_lp(directions: Float64Array, images: Sequence[Path]) -> bytes:
    rows = zip(images, rows_text(directions).splitlines(), strict=True)
    text = f"{len(images)}\n" + "".join(f"{image.name} {row}\n" for image, row in rows)
    return text.encode(errors="surrogateescape")


def _encode_npy(directions: Float64Array, images: Sequence[Path]) -> bytes:
    np.save(file := io.BytesIO(), directions)
    return file.getvalue()


@dataclass(frozen=True)
class LightFormat:
    """A format of light files. To add a format, write a reader and add a row to FORMATS."""

    name: str  # for messages
    # in lower case; empty for the format used for all other suffixes
    suffixes: tuple[str, ...]
    read: Callable[[Path, int | None, RowForm], NumberRows]  # see light_formats
    # names by which a light file is found in a folder, ignoring case; "*" stands for any text
    found: tuple[str, ...]
    # Lower ranks take precedence. Within rank 0, the first name wins; within any other rank, two
    # files are an error
    rank: int = 0
    # from directions (F, 3); None for a format that is only read
    encode: Callable[[Float64Array, Sequence[Path]], bytes] | None = None


FORMATS = (
    LightFormat(
        "text",
        (),
        _read_text,
        ("light_directions.txt", "lights.txt"),
        encode=lambda directions, _: rows_text(directions).encode(),
    ),
    LightFormat(
        "NumPy",
        (".npy",),
        readers.read_matrix,
        ("light_directions.npy", "lights.npy"),
        encode=_encode_npy,
    ),
    LightFormat("RTI", (".lp",), readers.read_lp, ("*.lp",), 1, encode=_encode_lp),
    LightFormat("Relight", (".dome", ".json"), readers.read_json_lights, ("*.dome",), 2),
    LightFormat("JSON list", (".json",), readers.read_json_lights, ("light_directions.json",), 2),
    LightFormat("AliceVision", (".json",), readers.read_json_lights, ("*lights.json",), 1),
    LightFormat(
        "CSV",
        (".csv",),
        _read_text,
        ("light_directions.csv", "lights.csv"),
        2,
        encode=lambda directions, _: f"x,y,z\n{rows_text(directions)}".replace(" ", ",").encode(),
    ),
    LightFormat(
        "MATLAB", (".mat",), readers.read_matrix, ("light_directions.mat", "lights.mat"), 2
    ),
    LightFormat(
        "OpenCV",
        (".yml", ".yaml", ".xml"),
        readers.read_matrix,
        ("*LightMatrix.yml", "lights.yml"),
        2,
    ),
)
"""All formats of light files, with the names by which they are found, and how to read and write
them.
"""


def format_of(path: Path) -> LightFormat:
    """Return the format of a light file from its suffix; an unknown suffix means text."""
    return next((each for each in FORMATS if path.suffix.lower() in each.suffixes), FORMATS[0])


def light_suffixes() -> str:
    """Return the suffixes of light files, for help texts."""
    suffixes = (suffix for each in FORMATS for suffix in each.suffixes)
    return ", ".join(dict.fromkeys(("text", *suffixes)))


def read_light_directions(
    path: StrPath,
    n_images: int | None = None,
    frame: LightFrame = USUAL_FRAME,
    form: RowForm = "xyz",
) -> Float64Array:
    """Return unit light directions (F, 3) float64 from a light file, in the order of the file.

    Each row contains x y z, separated by spaces, tabs, commas or semicolons. The rows may be
    preceded by a header, which may name the columns in another order, or by a line with only the
    number of lights (as in the University of Washington's lights.txt). If the file is not N x 3, it
    is read as 3 x N (PSBox); 3 x 3 is read as rows. If the first column numbers the rows from 0 or
    1, it determines their order. Vectors may have any length above zero.

    Args:
        n_images: the expected number of lights, if it is known.
        form: whether a row is a vector, two angles, or the position of a lamp.

    Raises:
        InputError: with the line, for a wrong number of columns, a word that is not a finite
            number, a zero vector or a light below the horizon; also if the number of lights differs
            from the count line or n_images, and for angles that would be read as vectors.
    """
    path = Path(path)
    return lights_of(format_of(path).read(path, n_images, form), n_images, frame, form)[1]


def read_light_positions(
    path: StrPath, n_images: int, frame: LightFrame = USUAL_FRAME
) -> Float64Array:
    """Return lamp positions (F, 3) float64 from a file in any format for light directions.

    Raises InputError as read_light_directions does, treating positions as directions from the
    origin, and for rows that name their images.
    """
    path = Path(path)
    table = format_of(path).read(path, n_images, "positions")
    positions, _ = lights_of(table, n_images, frame, "positions")
    if table.names is not None:
        raise InputError(
            f"found the name {table.names[0]!r}, expected x y z",
            table.path,
            line=table.rows[0].line,
            hint="A file of positions has one line for each image, in the order of the images",
        )
    return positions


def lights_of(
    table: NumberRows,
    n_images: int | None,
    frame: LightFrame,
    form: RowForm,
    *,
    leave_bad: bool = False,
) -> tuple[Float64Array, Float64Array]:
    """Return the table's vectors (F, 3) in the usual frame, unscaled and scaled to unit length.

    See unit_directions for the errors.
    """
    if table.are_vectors:
        form = "positions" if form == "positions" else "xyz"
    else:
        table = _sort_by_count(
            _drop_count_line(table, n_images), min(light_rows.COLUMNS[form]), n_images
        )
        if form == "xyz":
            light_rows.refuse_angles(table)
    meaning = {"xyz": "light directions", "positions": "lamp positions"}.get(form, "lights")
    vectors, transposed = _one_light_a_row(table, light_rows.COLUMNS[form], meaning, n_images)
    if form in ("azel", "slant-tilt"):
        light_rows.check_angles(table, form)
        vectors = light_rows.directions_from_angles(vectors, form)
    vectors = vectors @ frame.matrix.T + frame.origin  # which also turns -0 into 0
    lines = [table.rows[2 if transposed else light].line for light in range(len(vectors))]
    place = " in column " if transposed else " as light "
    places = [
        f"{place}{light}" if transposed or line is None else ""
        for light, line in enumerate(lines, start=1)
    ]
    lamps = form == "positions"
    return vectors, unit_directions(
        vectors, table.path, lines, places, lamps=lamps, leave_bad=leave_bad
    )


_ENOUGH_ABOVE = 6  # if this many lights are above the image plane, lights below it are ignored
_LOWEST_Z = 1e-6  # of a light above the plane; smaller values are rounding errors of 90 degrees


def above_plane(directions: Float64Array) -> Bools:
    """Return which of the unit directions (F, 3) are above the image plane, as booleans (F,)."""
    return np.asarray(directions[:, 2] > _LOWEST_Z)


def unit_directions(
    vectors: Float64Array,
    path: Path,
    lines: Sequence[int | None],
    places: Sequence[str],
    *,
    lamps: bool = False,
    leave_bad: bool = False,
) -> Float64Array:
    """Return vectors (F, 3) of any length, scaled to unit length.

    Raises InputError for a zero vector and for a light that is not above the horizon.

    Args:
        places: a description of each vector's place on its line.
        lamps: whether messages should call the vectors lamp positions.
        leave_bad: whether to return zero vectors and lights below the horizon for the caller to
            drop, instead of raising an error, if enough other lights remain.
    """
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    # Dividing by the largest component first keeps all squares within float64's range.
    scaled = np.divide(vectors, largest, out=np.zeros_like(vectors), where=largest > 0)
    directions = unit(scaled)
    if leave_bad and np.count_nonzero(above_plane(directions)) >= _ENOUGH_ABOVE:
        return directions
    for vector, z, line, place in zip(vectors, directions[:, 2], lines, places, strict=True):
        if not vector.any():
            raise InputError(
                f"found a zero vector{place}, expected a"
                f" {'lamp position' if lamps else 'light direction'}",
                path,
                line=line,
                hint="Write x y z towards the light, or remove the line and its image",
            )
        if z <= 0:
            found = "lamp behind the object" if lamps else "light below the horizon"
            hint = "z points towards the camera; the file may use another frame"
            if (directions[:, 2] < 0).all():
                hint = "z points away from the camera in this file, so add --light-frame z-away"
            raise InputError(
                f"found a {found}{place} (z = {vector[2]:g}), expected z > 0",
                path,
                line=line,
                hint=hint,
            )
    return directions


def read_light_intensities(path: StrPath, n_images: int) -> Float64Array:
    """Return light intensities (F, 3) float64 in RGB order from a text file, N x 3 or 3 x N.

    If there is one number per light, it applies to all three channels. Raises InputError as
    read_light_directions does, and with the line for an intensity outside the valid range.
    """
    table = _drop_count_line(
        numbers.read_number_rows(Path(path), expected=_FILE.format("r g b")), n_images
    )
    names = {3: "R G B", 1: "gray"}
    intensities, transposed = _one_light_a_row(table, names, "light intensities", n_images)
    for light, channel in np.argwhere(~light_rows.usable_intensities(intensities)):
        value, line = intensities[light, channel], table.rows[channel if transposed else light].line
        place = f" in column {light + 1}" if transposed else ""
        expected = "above 0" if value <= 0 else light_rows.INTENSITY_RANGE
        raise InputError(
            f"found the intensity {value:g}{place}, expected a number {expected}",
            table.path,
            line=line,
        )
    return np.broadcast_to(intensities, (n_images, 3)).copy()


def _sort_by_count(table: NumberRows, n_columns: int, n_images: int | None) -> NumberRows:
    """Return the table sorted by its first column, without this column, if it numbers the
    lights.
    """
    rows = table.rows
    fits = {len(row.numbers) for row in rows} == {n_columns + 1} and n_images in (None, len(rows))
    in_columns = n_images is None and len(rows) == n_columns  # each column is a light
    if not fits or in_columns or light_rows.counts_rows([row.numbers[0] for row in rows]) is None:
        return table
    ordered = sorted(rows, key=lambda row: row.numbers[0])
    return replace(table, rows=tuple(row._replace(numbers=row.numbers[1:]) for row in ordered))


def _drop_count_line(table: NumberRows, n_images: int | None) -> NumberRows:
    """Return the table without a first line that contains only the number of lights."""
    first, *following = table.rows
    if len(first.numbers) != 1 or not following:
        return table
    without, count = replace(table, rows=tuple(following)), first.numbers[0]
    if all(len(row.numbers) == 1 for row in following):
        # In a single column, the first number is a count only if it matches the number of rows
        # below.
        return without if len(following) == count == n_images else table
    if count in (len(following), len(following[0].numbers)):
        return without
    if not count.is_integer():
        expected = numbers.columns(len(following[0].numbers))
        raise InputError(
            f"found 1 column, expected {expected} or a count", table.path, line=first.line
        )
    raise InputError(
        f"the count line states {count:.0f}, but {len(following)} rows follow",
        table.path,
        line=first.line,
        hint="Correct the count or remove the line",
    )


def _one_light_a_row(
    table: NumberRows, names: dict[int, str], meaning: str, n_images: int | None
) -> tuple[Float64Array, bool]:
    """Return the numbers with one light per row, and whether they had to be transposed.

    `names` maps each possible number of values per light to their meaning.
    """
    values = table.as_array()
    n_columns = values.shape[1]
    readings = [
        (lights, lights is not values) for lights in (values, values.T) if lights.shape[1] in names
    ]
    if not readings:
        expected = " or ".join(f"{count} ({name})" for count, name in names.items())
        text = table.rows[0].text
        decimal_commas = n_columns > 3 and (
            numbers.has_decimal_commas(text) or (n_columns == 6 and text.count(",") >= 3)
        )
        raise InputError(
            f"found {numbers.columns(n_columns)}, expected {expected}",
            table.path,
            line=table.rows[0].line,
            hint=numbers.DECIMAL_POINT if decimal_commas else None,
        )
    for lights, transposed in readings:
        if n_images is None or len(lights) == n_images:
            return lights, transposed
    count = len(readings[0][0])
    if count == 1 and not meaning.endswith("ies"):
        meaning = meaning[:-1]
    problem = f"found {count} {meaning}, expected {n_images}, one for each image"
    hint = "Write one line for each image, in the order of the images"
    error = WrongCountError(problem, table.path, hint=hint)
    error.n_found = count
    raise error


def rows_text(values: Float64Array) -> str:
    """Return rows of numbers (F, C) as the text of a light file."""
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in values)


def match_images(table: NumberRows, images: Sequence[Path]) -> tuple[tuple[Path, ...], str]:
    """Return the image of each row, and how the images were matched: "name", "name without suffix"
    or "order".

    Images without a row are left out. Raises InputError if two rows have the same name, or if
    neither the names nor the number of images match.
    """
    names = table.names or ()
    seen = set()
    for name, row in zip(names, table.rows, strict=True):
        if name.casefold() in seen:
            raise InputError(
                f'found a second light for the image "{name}"', table.path, line=row.line
            )
        seen.add(name.casefold())
    for how, part in (("name", "name"), ("name without suffix", "stem")):
        by_key = {getattr(image, part).casefold(): image for image in reversed(images)}
        wanted = [getattr(Path(name), part).casefold() for name in names]
        if len(set(wanted)) == len(wanted) and all(name in by_key for name in wanted):
            return tuple(by_key[name] for name in wanted), how
    if len(images) == len(names):
        return tuple(images), "order"
    present = {image.name.casefold() for image in images}
    missing = next((i for i, name in enumerate(names) if name.casefold() not in present), 0)
    raise InputError(
        f"found {len(names)} lights but {len(images)} images, which do not include"
        f' "{names[missing]}"',
        table.path,
        line=table.rows[missing].line,
        hint="Correct the names in the file, or provide as many images as lights, in the same"
        " order",
    )


def read_lights(
    path: Path, n_images: int, frame: LightFrame = USUAL_FRAME, form: RowForm = "xyz"
) -> tuple[NumberRows, Float64Array]:
    """Return the rows of a light file, which may name their images, and the light directions (F,
    3).

    If the path is a folder of images, the lights are read from the image names. For AliceVision
    files, whose own frame has y down and z away, `frame` is applied on top of that frame. Lights
    below the horizon are returned unchanged if enough other lights remain. Raises InputError; see
    read_light_directions and match_images.
    """
    read = read_names if is_folder(path) else format_of(path).read
    table = read(path, n_images, form)
    n_rows = n_images if table.names is None else None
    return table, lights_of(table, n_rows, frame, form, leave_bad=form != "positions")[1]


def light_encoder(path: Path) -> Callable[[Float64Array, Sequence[Path]], bytes]:
    """Return the encoder for the format of a file's suffix. Raises UsageError if the format can
    only be read.
    """
    encode = format_of(path).encode
    if encode is None:
        suffixes = (each.suffixes[0] for each in FORMATS if each.encode and each.suffixes)
        *most, last = ".txt", *suffixes
        raise UsageError(
            f"{path}: {path.suffix.lower()} light files can be read but not written",
            hint=f"Write {', '.join(most)} or {last}",
        )
    return encode


def encode_lights(path: Path, directions: Float64Array, images: Sequence[Path]) -> bytes:
    """Return the content of a light file with the light directions (F, 3) of images; see
    light_encoder.
    """
    return light_encoder(path)(directions, images)
