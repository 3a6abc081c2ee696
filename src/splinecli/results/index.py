"""Overview of the results of several captures: rows of a table, and the page index.html that links them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from splinecli.errors import OutputError
from splinecli.files import read_json
from splinecli.results.files import NORMALS, PAGE, REPORT
from splinecli.results.templates import render

INDEX = "index.html"
_OURS = b'<meta name="generator" content="splinecli">'
_START = 1 << 16  # bytes of a page, which contain this mark


class Row(NamedTuple):
    """One row of the overview, as text. A capture that failed has only its name and the error."""

    capture: str
    lights: str = ""
    pixels: str = ""
    mae: str = ""
    likely: str = ""
    warnings: str = ""
    seconds: str = ""
    error: str = ""


HEADER = Row("capture", "lights", "pixels", "MAE", "likely within 5°", "warnings", "seconds", "error")


def row_of(report: Mapping[str, Any]) -> Row:
    """Return the row of a report (see report_of) or of a document with `capture` and `error`."""
    if "error" in report:
        return Row(report["capture"], error=report["error"])
    errors, expected = report["angular_error_deg"], report["expected_under_5"]
    return Row(
        report["capture"],
        lights=str(report["n_lights"]),
        pixels=f"{report['n_pixels']:,}",
        mae="" if errors is None else f"{errors['mean']:.2f}°",
        likely="" if expected is None else f"{expected:.0%}",
        warnings=str(len(report["warnings"]) or ""),
        seconds=f"{sum(report['seconds'].values()):.1f}",
    )


def index_page(reports: Sequence[Mapping[str, Any]]) -> str:
    """Return the page that shows the normal maps and links the files. It belongs beside the captures' folders."""
    rows = []
    for report in reports:
        # As bytes, because a folder's name may not be valid text.
        folder, files = quote(os.fsencode(report["capture"])), report.get("files", [])
        picture = next((name for name in (NORMALS["png8"], NORMALS["png"]) if name in files), None)
        rows.append(
            {
                **row_of(report)._asdict(),
                "page": f"{folder}/{PAGE}" if PAGE in files else None,
                "picture": None if picture is None else f"{folder}/{picture}",
                "files": [(name, f"{folder}/{quote(name)}") for name in files],
            }
        )
    return render("index.html", title=f"{len(reports)} captures", header=HEADER, rows=rows)


def with_earlier(reports: Sequence[Mapping[str, Any]], folder: Path) -> list[Mapping[str, Any]]:
    """Return the reports, followed by those of other captures that have results in the folder, sorted by name."""
    names = {report["capture"] for report in reports}
    earlier = []
    for path in sorted(folder.glob(f"*/{REPORT}")):
        try:
            report = read_json(path)
            row_of(report)  # raises if this is not a report
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
        if report["capture"] == path.parent.name not in names:
            earlier.append(report)
    return [*reports, *earlier]


def has_index(folder: Path) -> bool:
    """Return whether the folder has an index.html that splinecli wrote."""
    try:
        if not (folder / INDEX).is_file():
            return False
        with (folder / INDEX).open("rb") as file:
            return _OURS in file.read(_START)
    except OSError:
        return False


def check_index_free(folder: Path, *, overwrite: bool) -> None:
    """Raise OutputError if the folder has an index.html that splinecli did not write and may not replace."""
    path = folder / INDEX
    if path.is_dir() or (path.exists() and not overwrite and not has_index(folder)):
        raise OutputError(
            "was not written by splinecli", path=path, hint="Add --overwrite, or choose another -o"
        )
