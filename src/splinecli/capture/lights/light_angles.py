"""Light directions from azimuth and elevation, and the refusal of angles that would be read as vectors."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.text import NumberRows
from splinecli.errors import InputError

LightForm = Literal["xyz", "azel"]
"""The numbers of a light: a vector, or azimuth and elevation in degrees."""

COLUMNS = {"xyz": {3: "x y z"}, "azel": {2: "azimuth elevation"}}
"""The number of columns of each form, and their meaning."""

AZEL_HINT = "If they are azimuth and elevation in degrees, add --lights-format azel"


def directions_from_angles(angles_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors (F, 3) from azimuths and elevations (F, 2) in degrees.

    The azimuth counts from x (right) towards y (up), the elevation from the image plane towards the camera.
    """
    azimuth, elevation = np.radians(angles_deg).T
    level = np.cos(elevation)
    return np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)


def check_angles(table: NumberRows) -> None:
    """Raise InputError, with the line, for azimuths or elevations (the last two columns) that are no such angles."""
    for row, line in zip(table.rows, table.lines, strict=True):
        azimuth, elevation = row[-2:]
        if not (0 < elevation <= 90 and abs(azimuth) <= 360):
            raise InputError(
                f"found azimuth {azimuth:g} and elevation {elevation:g}, expected -360 to 360 and above 0 to 90"
                " degrees",
                path=table.path,
                line=line,
                hint="The elevation counts from the image plane: 90 is the direction of the camera",
            )
    if np.abs([row[-2:] for row in table.rows]).max() < 2 * np.pi:
        raise InputError(
            "no angle is above 2 pi, so they look like radians, expected degrees",
            path=table.path,
            line=table.lines[0],
        )


def refuse_angles(table: NumberRows) -> None:
    """Raise InputError for rows that are plainly angles: two columns, or a count and two columns."""
    lengths = {len(row) for row in table.rows}
    numbered = lengths == {3} and counts_rows([row[0] for row in table.rows]) is not None
    largest = max((abs(value) for row in table.rows for value in row[-2:]), default=0)
    if len(table.rows) > 3 and largest > 2 and (lengths == {2} or numbered):
        found = "a number and two angles" if numbered else "2 columns of angles"
        raise InputError(
            f"found {found}, expected 3 columns (x y z)",
            path=table.path,
            line=table.lines[0],
            hint=AZEL_HINT,
        )


def counts_rows(column: list[float]) -> int | None:
    """Return the first number of a column that counts the rows in some order, 0 or 1; None for any other column."""
    ordered = sorted(column)
    return next((first for first in (0, 1) if ordered == list(range(first, first + len(column)))), None)
