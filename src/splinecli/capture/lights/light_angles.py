"""Light directions from azimuth and elevation, and the refusal of angles that would be read as vectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.text import NumberRows
from splinecli.errors import InputError

LightForm = Literal["xyz", "azel", "slant-tilt"]
"""The numbers of a light: a vector; azimuth and elevation; or slant and tilt (HALCON). Angles are in degrees."""

RowForm = LightForm | Literal["positions"]
"""The numbers of a row in a file of lights or of near lamps."""

COLUMNS: dict[RowForm, dict[int, str]] = {
    "xyz": {3: "x y z"},
    "azel": {2: "azimuth elevation"},
    "slant-tilt": {2: "slant tilt"},
    "positions": {3: "x y z"},
}
"""The number of columns of each form, and their meaning."""

_ZENITH = ("zen", "polar", "incl", "colat", "coelev")

AZEL_HINT = "If they are azimuth and elevation in degrees, add --lights-format azel"


def directions_from_angles(angles_deg: NDArray[np.float64], form: RowForm) -> NDArray[np.float64]:
    """Return unit vectors (F, 3) from azimuths and elevations, or slants and tilts (F, 2), in degrees.

    Azimuth and tilt count from x (right) towards y (up), the elevation from the image plane towards the camera, the
    slant from the camera axis.
    """
    azimuth, elevation = np.radians([_azimuth_elevation(row, form) for row in angles_deg.tolist()]).T
    level = np.cos(elevation)
    return np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)


def _azimuth_elevation(row: Sequence[float], form: RowForm) -> tuple[float, float]:
    first, second = row[-2:]
    return (second, 90 - first) if form == "slant-tilt" else (first, second)


def check_angles(table: NumberRows, form: RowForm) -> None:
    """Raise InputError, with the line, for rows whose last two columns are no such angles."""
    for row, line in zip(table.rows, table.lines, strict=True):
        azimuth, elevation = _azimuth_elevation(row, form)
        if not (0 < elevation <= 90 and abs(azimuth) <= 360):
            slants = form == "slant-tilt"
            raise InputError(
                f"found slant {row[-2]:g} and tilt {row[-1]:g}, expected 0 to below 90 and -360 to 360 degrees"
                if slants
                else f"found azimuth {azimuth:g} and elevation {elevation:g}, expected -360 to 360 and above 0 to 90"
                " degrees",
                path=table.path,
                line=line,
                hint="The slant counts from the camera axis"
                if slants
                else "The elevation counts from the image plane: 90 is the direction of the camera",
            )
    if np.abs([row[-2:] for row in table.rows]).max() < 2 * np.pi:
        raise InputError(
            "no angle is above 2 pi, so they look like radians, expected degrees",
            path=table.path,
            line=table.lines[0],
            hint="Multiply them by 180 / pi = 57.2958",
        )


def refuse_zenith(header: list[str], path: Path, line: int) -> None:
    """Raise InputError for a header with an angle from the camera axis in place of the elevation."""
    found = next((word for word in header if word.lower().startswith(_ZENITH)), None)
    if found is not None:
        raise InputError(
            f'found the column "{found[:40]}", expected azimuth and elevation',
            path=path,
            line=line,
            hint="The elevation is 90 minus the angle from the camera axis",
        )


def zenith_as_elevation(light_directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lights (..., 3) whose angles from the camera axis are the elevations of these."""
    level = np.linalg.norm(light_directions[..., :2], axis=-1, keepdims=True)
    across = light_directions[..., :2] / np.maximum(level, 1e-9) * light_directions[..., 2:]
    return np.concatenate((across, level), axis=-1)


def refuse_angles(table: NumberRows) -> None:
    """Raise InputError for rows that are plainly angles: two columns, or with a count, or with one radius for all."""
    lengths = {len(row) for row in table.rows}
    numbered = lengths == {3} and counts_rows([row[0] for row in table.rows]) is not None
    largest = max((abs(value) for row in table.rows for value in row[-2:]), default=0)
    if len(table.rows) > 3 and lengths == {3} and not numbered and _have_one_radius(table.rows):
        raise InputError(
            f"found azimuth, elevation and {table.rows[0][2]:g}, expected x y z",
            path=table.path,
            line=table.lines[0],
            hint=f"Leave the third column out. {AZEL_HINT}",
        )
    if len(table.rows) > 3 and largest > 2 and (lengths == {2} or numbered):
        found = "a number and two angles" if numbered else "2 columns of angles"
        raise InputError(
            f"found {found}, expected 3 columns (x y z)",
            path=table.path,
            line=table.lines[0],
            hint=AZEL_HINT,
        )


def _have_one_radius(rows: tuple[tuple[float, ...], ...]) -> bool:
    """Return whether rows look like azimuth, elevation and the same radius; vectors around an object have y < 0."""
    azimuth, elevation, radius = np.array(rows).T
    all_in_range = (np.abs(azimuth) <= 360).all() and ((elevation > 0) & (elevation <= 90)).all()
    return bool(np.ptp(radius) == 0 and all_in_range and elevation.max() > 2 and np.abs(azimuth).max() > 90)


def counts_rows(column: list[float]) -> int | None:
    """Return the first number of a column that counts the rows in some order, 0 or 1; None for any other column."""
    ordered = sorted(column)
    return next((first for first in (0, 1) if ordered == list(range(first, first + len(column)))), None)
