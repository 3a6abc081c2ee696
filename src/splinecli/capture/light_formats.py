"""Readers of light files other than lines of numbers: RTI's .lp, AliceVision's JSON, Relight's
.dome, other JSON, and matrices from NumPy, MATLAB and OpenCV.

A reader takes the path, the number of images if known, and the meaning of a row. It returns rows of
numbers, which may name their images, and raises InputError if it cannot read the file. In a file
with several matrices, the lights are the only N x 3 or 3 x N matrix that fits the number of images.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import Struct, ValidationError, convert, field
from numpy.typing import NDArray

from splinecli.capture.formats import mat, numbers
from splinecli.capture.formats.numbers import NumberRow, NumberRows, to_number
from splinecli.capture.light_rows import (
    INTENSITY_RANGE,
    RowForm,
    directions_from_angles,
    image_name,
    usable_intensities,
)
from splinecli.errors import InputError
from splinecli.maths import Float64Array
from splinecli.records.base import Positive
from splinecli.system.files import parse_json


def read_lp(path: Path, n_images: int | None, form: RowForm) -> NumberRows:
    """Read RTI's format: the number of lights, followed by one line `file name x y z` for each.

    Names may contain spaces. The number of lights is optional, because some programs omit it.
    """
    stored = numbers.read_lines(path, else_latin_1=True)
    content = [(line, text.strip()) for line, text in enumerate(stored, start=1) if text.strip()]
    if not content:
        raise InputError("the file is empty, expected the number of lights on the first line", path)
    (first, count), *rows = content
    words = count.split()
    if len(words) > 3 and None not in map(to_number, words[-3:]):
        rows = content
    elif not count.isdecimal():
        raise InputError(f'found "{count[:40]}", expected the number of lights', path, line=first)
    elif int(count[:9]) != len(rows):
        raise InputError(
            f"the first line states {count[:40]} lights, but {len(rows)} lines follow",
            path,
            line=first,
            hint="Correct the number or add the missing lines",
        )
    if not rows:
        raise InputError("the file contains no lights", path, line=first)
    names, vectors = [], []
    commas = numbers.uses_decimal_commas([text for _, text in rows], 3)
    for line, text in rows:
        words = text.rsplit(maxsplit=3)
        if len(words) < 4:
            raise InputError(
                f'found "{text[:40]}", expected a file name and x y z', path, line=line
            )
        names.append(image_name(words[0], []))
        words = numbers.split_words(" ".join(words[1:]), decimal_commas=commas)[:3]
        vectors.append(
            NumberRow(tuple(numbers.parse_number(word, path, line) for word in words), line, text)
        )
    return NumberRows(path, tuple(vectors), tuple(names), are_vectors=True)


def read_json_lights(path: Path, n_images: int | None, form: RowForm) -> NumberRows:
    """Read lights from JSON: a dome of Relight, a list of x y z, or the format of AliceVision."""
    try:
        document = parse_json("\n".join(numbers.read_lines(path)))
    except json.JSONDecodeError as error:
        raise InputError(f"the file is not JSON ({error.msg})", path, line=error.lineno) from None
    except ValueError as error:
        raise InputError(f"the file cannot be read as JSON ({error})", path) from None
    named = isinstance(document, dict) and not {"directions", *_DOME_POSITIONS}.isdisjoint(document)
    if named or path.suffix.lower() == ".dome":
        return _read_dome(document, path, form)
    listed = _listed(document)
    if listed is None:
        return _read_alicevision(document, path)
    rows = tuple(NumberRow(tuple(vector), line) for line, vector in enumerate(listed[1], start=1))
    return NumberRows(path, rows, listed[0])


class _Light(Struct):
    """A light of AliceVision."""

    direction: tuple[float, float, float]
    type: Literal["directional"] = "directional"
    view: str | int | None = field(default=None, name="viewId")
    intensity: tuple[Positive, Positive, Positive] | None = None


def _read_alicevision(document: Any, path: Path) -> NumberRows:
    listed = document.get("lights") if isinstance(document, dict) else None
    if not isinstance(listed, list) or not listed:
        raise InputError(
            'found no list "lights", expected the format of AliceVision or a list of x y z',
            path,
        )
    names, vectors, intensities = [], [], []
    for number, values in enumerate(listed, start=1):
        try:
            light = convert(values, _Light)
        except ValidationError as error:
            raise InputError(
                f"light {number}: {error}",
                path,
                hint="Calibrate for distant lights, with one direction for each light",
            ) from None
        names.append(image_name(str(number if light.view is None else light.view), []))
        x, y, z = light.direction
        vectors.append((x, -y, -z))
        intensities += [] if light.intensity is None else [light.intensity]
    if intensities and len(intensities) != len(listed):
        raise InputError(
            f"{len(intensities)} of {len(listed)} lights have an intensity, expected all or none",
            path,
        )
    return _unnumbered(path, vectors, names, intensities)


_DOME_POSITIONS = ("positions3d", "positionsSphere", "positions")


def _read_dome(document: Any, path: Path, form: RowForm) -> NumberRows:
    """Read a dome of Relight: lights in the order of the images, with x right, y up and z to the
    camera.

    Its positions are lamp positions. Intensities are derived from ledAdjust, the factors by which
    Relight multiplies the images.
    """
    if not isinstance(document, dict):
        raise InputError("found no JSON object, expected a dome written by Relight", path)
    positions = _DOME_POSITIONS
    if document.get("lightConfiguration") == "spherical":
        positions = ("positionsSphere", "positions3d", "positions")
    keys = positions if form == "positions" else ("directions", *positions)
    key = next((key for key in keys if document.get(key)), None)
    if key is None:
        raise InputError(
            f"found no list of {' or '.join(keys)}, expected a dome written by Relight", path
        )
    vectors = _vectors(document[key])
    factors = _vectors(document.get("ledAdjust"), "rgb") or []
    if vectors is None or any(len(vector) != 3 for vector in vectors):
        raise InputError(f'the list "{key}" does not give x, y and z for each light', path)
    usable = all(usable_intensities(np.array(light)).all() for light in factors)
    if factors and not (usable and len(factors) == len(vectors)):
        problem = f'the list "ledAdjust" has {len(factors)} factors for {len(vectors)} lights'
        raise InputError(
            problem if usable else f'a factor in "ledAdjust" is not {INTENSITY_RANGE}', path
        )
    return _unnumbered(path, vectors, None, [[1 / factor for factor in light] for light in factors])


def _listed(document: Any) -> tuple[tuple[str, ...] | None, list[list[float]]] | None:
    """Return the names and vectors in a list [[x, y, z], ...], a list of objects, or a mapping from
    image names.
    """
    if isinstance(document, dict):
        lists = [values for values in document.values() if _vectors(values) or _objects(values)]
        # Lights without names are in AliceVision's format, which has its own frame.
        if len(lists) == 1 and (_vectors(lists[0]) or "lights" not in document):
            (document,) = lists
        elif len(lists) == 1 and (objects := _objects(lists[0])) and objects[0] is not None:
            return objects
    if (objects := _objects(document)) is not None:
        return objects
    names = tuple(image_name(name, []) for name in document) if isinstance(document, dict) else None
    vectors = _vectors(document if names is None else list(document.values()))
    return None if vectors is None else (names, vectors)


def _objects(values: Any) -> tuple[tuple[str, ...] | None, list[list[float]]] | None:
    """Return the names and vectors in a list such as [{"file": "a.png", "light_dir": [x, y, z]}].

    Return None for anything else.
    """
    if isinstance(values, dict) and all(isinstance(each, dict) for each in values.values()):
        values = [{"file": name, **each} for name, each in values.items()]
    objects = values if isinstance(values, list) else []
    lights = [_light_of(each) if isinstance(each, dict) else None for each in objects]
    if not lights or None in lights:
        return None
    names = []
    for each in objects:
        words = (each[key] for key in each if re.match("file|im|name|path|photo", key, re.I))
        names += [image_name(word, []) for word in words if isinstance(word, str)][:1]
    if len(names) not in (0, len(lights)):
        return None
    return tuple(names) if names else None, [light for light in lights if light is not None]


def _light_of(values: dict[str, Any]) -> list[float] | None:
    """Return the light vector in an object, or None if it is ambiguous or missing.

    It is the only vector, or else the only one whose name contains light or direction, or else x, y
    and z, or azimuth and elevation.
    """
    found = {key: read[0] for key, value in values.items() if (read := _vectors([value]))}
    vectors = {key: vector for key, vector in found.items() if len(vector) == 3}
    for word in ("", "light", "dir"):
        chosen = [vector for key, vector in vectors.items() if re.search(word, key, re.I)]
        if len(chosen) == 1:
            return chosen[0]
    angles = _vectors([values], ("azimuth", "elevation"))
    if angles is not None:
        ((x, y, z),) = directions_from_angles(np.array(angles), "azel").tolist()
        return [x, y, z]
    own = _vectors([values])
    return None if own is None or vectors else own[0]


def _vectors(values: Any, keys: Sequence[str] = "xyz") -> list[list[float]] | None:
    """Return lists of at least two numbers, or objects with these keys, as lists of numbers.

    Return None for anything else.
    """
    vectors = []
    for each in values if isinstance(values, list) else []:
        vector = [each.get(key) for key in keys] if isinstance(each, dict) else each
        if not isinstance(vector, list) or len(vector) < 2:
            return None
        if any(type(number) not in (int, float) for number in vector):
            return None
        vectors.append([float(number) for number in vector])
    return vectors or None


def _unnumbered(
    path: Path,
    vectors: Iterable[Sequence[float]],
    names: Sequence[str] | None,
    intensities: Sequence[Sequence[float]],
) -> NumberRows:
    """Return vectors as rows without line numbers."""
    rows = tuple(NumberRow(tuple(vector), None) for vector in vectors)
    given = np.array(intensities, np.float64) if intensities else None
    return NumberRows(path, rows, None if names is None else tuple(names), given, are_vectors=True)


# OpenCV's FileStorage, whose own C++ reader was made for trusted files. No part of a pattern may
# match the start of the next part, because backtracking would take minutes for a file of 1 MB.
_YAML = re.compile(
    r"^[ \t]*([\w.-]+):\s*!!opencv-matrix\s+rows:\s*(\d{1,9})\s+cols:\s*(\d{1,9})\s+dt:\s*\"?\w+\"?"
    r"\s+data:\s*\[([^][:]*)\]",
    re.MULTILINE,
)
_XML = re.compile(
    r"<([\w.-]+)\s+type_id=\"opencv-matrix\"\s*>\s*<rows>\s*(\d{1,9})\s*</rows>\s*<cols>\s*(\d{1,9})\s*</cols>"
    r"\s*<dt>[^<]*</dt>\s*<data>([^<]*)</data>"
)


NEAR_PS = frozenset({"S", "Dir"})  # lamp positions and axes in a light.mat of near_ps
_MOST_NAMED = 6  # most matrices that a message lists
# Usual names of the matrix of lights, the most likely first
_LIGHT_NAMES = ("light_directions", "lightdirs", "light_dirs", "lights", "light", "l", "s")


def read_matrix(path: Path, n_images: int | None, form: RowForm) -> NumberRows:
    """Return the rows of the light matrix in a NumPy, MATLAB or OpenCV file."""
    suffix = path.suffix.lower()
    if suffix != ".mat":  # of a .mat file, only the matrix is read
        numbers.check_text_length(path, numbers.MOST_TEXT)
    if suffix == ".npy":
        array = _read_npy(path)
    elif suffix == ".mat":
        array = mat.read_matrix(path, lambda shapes: _choose(shapes, path, n_images, form))
    else:
        matrices = _read_opencv(path)
        shapes = {name: matrix.shape for name, matrix in matrices.items()}
        array = matrices[_choose(shapes, path, n_images, form)]
    is_matrix = array.ndim == 2 and array.dtype.kind in "fiu" and array.size
    if not is_matrix or not np.isfinite(array).all():
        raise InputError(
            f"found an array of shape {array.shape} and type {array.dtype}, expected finite"
            " numbers N x 3",
            path,
        )
    rows = enumerate(array.astype(np.float64).tolist(), start=1)
    return NumberRows(path, tuple(NumberRow(tuple(row), line) for line, row in rows))


def _choose(
    shapes: Mapping[str, tuple[int, ...]], path: Path, n_images: int | None, form: RowForm
) -> str:
    """Return the name of the only N x 3 or 3 x N matrix, or of the one that fits the number of
    images.
    """
    lights = {name: shape for name, shape in shapes.items() if len(shape) == 2 and 3 in shape}
    if len(lights) > 1:
        usual = (n_images, 3), (3, n_images)
        lights = {name: shape for name, shape in lights.items() if shape in usual} or lights
    usual_names = [name for name in lights if name.lower() in _LIGHT_NAMES]
    if set(lights) >= NEAR_PS and form == "positions":
        return "S"
    if len(lights) > 1 and usual_names and not set(lights) >= NEAR_PS:
        return min(usual_names, key=lambda name: _LIGHT_NAMES.index(name.lower()))
    if len(lights) == 1:
        return next(iter(lights))
    sizes = [
        f"{name} ({' x '.join(map(str, shape))})" for name, shape in (lights or shapes).items()
    ]
    named = ", ".join(sizes[:_MOST_NAMED])
    more = f" and {len(sizes) - _MOST_NAMED} more" if len(sizes) > _MOST_NAMED else ""
    raise InputError(
        f"found {'several matrices' if lights else 'no matrix'} N x 3 or 3 x"
        f" N{f': {named}{more}' if sizes else ''}",
        path,
        hint="Write the light directions to a text file, with one line x y z for each image",
    )


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path) from None
    except Exception:  # parsing a damaged header raises a dozen types of errors
        raise InputError(
            "the .npy file is damaged or does not contain an array of numbers", path
        ) from None


def _read_opencv(path: Path) -> dict[str, Float64Array]:
    """Return the matrices in a file of OpenCV's FileStorage, by name. Raises InputError."""
    text = numbers.read_text(path).decode(errors="replace")
    found: dict[str, Float64Array] = {}
    pattern = _XML if path.suffix.lower() == ".xml" else _YAML
    for name, rows, columns, data in pattern.findall(text):
        try:
            values = np.array([float(word) for word in re.split(r"[\s,]+", data.strip())])
            found[name] = values.reshape(int(rows), int(columns))
        except ValueError:
            raise InputError(
                f"the matrix {name} is damaged and does not contain {rows} x {columns} numbers",
                path,
            ) from None
    return found
