"""Light directions from image names: angles as in the Yale Face Database B, x and y, or sides such
as left and top.

The folder of the images is treated as a light file whose rows name their images.
"""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from splinecli.capture.files import list_images
from splinecli.capture.formats.numbers import NumberRow, NumberRows
from splinecli.capture.light_rows import RowForm, directions_from_angles
from splinecli.errors import InputError
from splinecli.maths import Float64Array
from splinecli.maths.robust import MIN_LIGHTS

_NUMBER = r"[-+]?\d+(?:\.\d+)?"
_LEAST_SHARE = 0.8  # smallest share of images whose names must contain a light
_ELEVATION_OF_SIDES_DEG = 45.0

Rows = dict[Path, tuple[float, float, float]]


def _numbers(pattern: str, images: Sequence[Path]) -> tuple[list[Path], Float64Array]:
    """Return the images whose stems match a pattern, and the numbers (F, N) in its groups."""
    found = [(image, match) for image in images if (match := re.search(pattern, image.stem, re.I))]
    numbers = [list(map(float, match.groups())) for _, match in found]
    return [image for image, _ in found], np.array(numbers, np.float64)


def _rows(images: Sequence[Path], vectors: Float64Array) -> Rows:
    return dict(zip(images, map(tuple, (vectors + 0.0).tolist()), strict=True))


def _yale(images: Sequence[Path]) -> tuple[Rows, str]:
    """Read names such as A+035E+40, in which positive azimuths are on the left of the image."""
    found, angles = _numbers(r"A([-+]\d{1,3})_?E([-+]\d{1,2})(?!\d)", images)
    azimuth, elevation = np.radians(angles.reshape(-1, 2)).T
    level = np.cos(elevation)
    x, y, z = -level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)
    text = "azimuth and elevation, as in Yale B, with positive azimuths on the left of the image"
    return _rows(found, np.stack((x, y, z), axis=1)), text


def _angles(images: Sequence[Path]) -> tuple[Rows, str]:
    """Read azimuth and elevation, or tilt and slant, with their names, as in az045_el30."""
    azimuth, zenith = "az[a-z]*|phi|tilt|pan", "slant|theta|zen[a-z]*|polar|incl[a-z]*"
    forms: tuple[tuple[str, str, RowForm], ...] = (
        (azimuth, "el[a-z]*|alt[a-z]*", "azel"),
        (zenith, azimuth, "slant-tilt"),
    )
    for first, second, form in forms:
        words = (rf"(?=.*?(?<![a-z])(?:{word})[ =_]?({_NUMBER}))" for word in (first, second))
        found, angles = _numbers("^" + "".join(words), images)
        if found:
            return _rows(found, directions_from_angles(angles, form)), f"angles, as {form}"
    return {}, ""


def _xy(images: Sequence[Path]) -> tuple[Rows, str]:
    """Read x and y, or x, y and z, as in NAME_-0.5_1.0."""
    start, between = r"(?:^|[ _,(=x])", r"[ _,=yz]{1,3}"
    for count in (3, 2):
        pattern = start + between.join(count * [f"({_NUMBER})"]) + r"\)?$"
        found, vectors = _numbers(pattern, images)
        if not found or not (vectors[:, :2].min(axis=0) < 0).all():  # counters, for example
            continue
        if count == 3:
            return _rows(found, vectors), "x, y and z"
        radius = np.hypot(*vectors.T)
        if radius.max() < 0.999:
            z, text = np.sqrt(1 - radius**2), "x and y of unit vectors"
        elif np.abs(vectors).max() <= 2:
            z, text = np.ones(len(found)), "x and y, with z = 1"
        else:
            continue
        return _rows(found, np.column_stack((vectors, z))), text
    return {}, ""


_SIDES = {
    (-1, 0): ("left", "west"),
    (1, 0): ("right", "east"),
    (0, 1): ("top", "up", "upper", "above", "north"),
    (0, -1): ("bottom", "down", "lower", "below", "under", "south"),
    (0, 0): ("front", "frontal", "center", "centre", "middle"),
}
_SIDE_OF = {word: side for side, words in _SIDES.items() for word in words}
_SIDE = re.compile(rf"(?<![a-z])((?:(?:{'|'.join(_SIDE_OF)})[ _-]?)+)(?![a-z])")


def _sides(images: Sequence[Path]) -> tuple[Rows, str]:
    """Read left, right, top, bottom and front, or two of them, in names that are equal
    otherwise.
    """
    rows, rests = Rows(), set[str]()
    for image in images:
        stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", image.stem).lower()
        if len(found := _SIDE.findall(stem)) != 1:
            continue
        words = re.findall("|".join(sorted(_SIDE_OF, key=len, reverse=True)), found[0])
        x, y = np.sum([_SIDE_OF[word] for word in words], axis=0).tolist()
        length = math.hypot(x, y)
        z = length / math.tan(math.radians(90 - _ELEVATION_OF_SIDES_DEG)) if length else 1.0
        rows[image] = (float(x), float(y), z)
        rests.add(re.sub(r"[\d\W_]+", "", stem.replace(found[0], "", 1)))
    if len(rests) > 1 or len(set(rows.values())) < len(rows):
        return {}, ""
    text = (
        f"sides, at an assumed elevation of {_ELEVATION_OF_SIDES_DEG:.0f} degrees; if the lamps"
        " were higher or lower, the surface is too steep or too flat"
    )
    return rows, text


_READERS: tuple[Callable[[Sequence[Path]], tuple[Rows, str]], ...] = (_yale, _angles, _xy, _sides)


def lights_in_names(images: Sequence[Path]) -> tuple[Rows, str] | None:
    """Return the lights in image names and a description of these names, or None if too few names
    contain a light.

    Frame: x right, y up, z to the camera. Vectors may have any length and may point behind the
    image plane.
    """
    for read in _READERS:
        rows, text = read(images)
        distinct = len(set(rows.values()))
        if distinct >= MIN_LIGHTS and len(rows) >= _LEAST_SHARE * len(images):
            return rows, text
    return None


def read_names(folder: Path, n_images: int | None, form: RowForm) -> NumberRows:
    """Return the lights in the names of a folder's images. Raises InputError if there are none."""
    found = lights_in_names(list_images(folder))
    if found is None:
        raise InputError("found no lights in the names of the images", folder)
    rows, _ = found
    names = tuple(image.name for image in rows)
    vectors = tuple(NumberRow(vector, None) for vector in rows.values())
    return NumberRows(folder, vectors, names, are_vectors=True)
