"""Overview of the results of several captures: rows of a table, and the page index.html that links them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from splinecli.capture.formats.facts import read_facts
from splinecli.capture.formats.images import decode_image, image_bytes
from splinecli.capture.result_names import NORMALS, PAGE, REPORT
from splinecli.errors import InputError, OutputError
from splinecli.results.files import read_report
from splinecli.results.templates import picture_url, render
from splinecli.system.machine import is_out_of_memory

INDEX = "index.html"

THUMBNAIL = 256, 192  # largest width and height in pixels: twice its size on the page, for sharp screens
_LARGEST_SHOWN = 10**9  # bytes of a normal map shown small: 33 megapixels of 16 bits; others may be bombs
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


class Entry(NamedTuple):
    """What the page shows of one capture: its row, the names of its files, and its warnings."""

    row: Row
    files: tuple[str, ...] = ()
    words: tuple[str, ...] = ()

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> Entry:
        """Return the entry of a report (see report_of), or of a document with `capture` and `error`."""
        if "error" in report:
            return cls(Row(report["capture"], error=report["error"]))
        errors, expected, seconds = report["angular_error_deg"], report["expected_under_5"], report["seconds"]
        row = Row(
            report["capture"],
            lights=str(report["n_lights"]),
            pixels=f"{report['n_pixels']:,}",
            mae="" if errors is None else f"{errors['mean']:.2f}°",
            likely="" if expected is None else f"{expected:.0%}",
            warnings=str(len(report["warnings"]) or ""),
            seconds=f"{seconds.get('total', sum(seconds.values())):.1f}",
        )
        return cls(row, tuple(report["files"]), tuple(str(warning["text"]) for warning in report["warnings"]))


def index_page(entries: Sequence[Entry], output: Path) -> str:
    """Return the page that shows small normal maps and links the files, for the folder of the captures' folders."""
    rows = []
    for row, files, words in entries:
        # As bytes, because a folder's name may not be valid text.
        folder = quote(os.fsencode(row.capture))
        picture = next((name for name in (NORMALS["png8"], NORMALS["png"]) if name in files), None)
        rows.append(
            {
                **row._asdict(),
                "page": f"{folder}/{PAGE}" if PAGE in files else None,
                "picture": None if picture is None else f"{folder}/{picture}",
                "thumbnail": None if picture is None else _thumbnail(output / row.capture / picture),
                "words": words,
                "files": [(name, f"{folder}/{quote(name)}") for name in files],
            }
        )
    return render("index.html", title=f"{len(entries)} captures", header=HEADER, rows=rows)


def _thumbnail(path: Path) -> str | None:
    """Return a picture of at most THUMBNAIL pixels as a JPEG data URL, or None where it cannot be read."""
    import cv2

    try:
        if image_bytes(*read_facts(path).size) > _LARGEST_SHOWN:
            return None
        picture = decode_image(path)
    except InputError:
        return None
    if picture.dtype.kind != "u":
        return None
    height, width = picture.shape[:2]
    shrink = min(1, THUMBNAIL[0] / width, THUMBNAIL[1] / height)
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) / np.iinfo(picture.dtype).max
    done, jpeg = cv2.imencode(".jpg", np.rint(255 * small[..., ::-1]).astype(np.uint8))
    return picture_url(jpeg.tobytes(), "jpeg") if done else None


def with_earlier(entries: Sequence[Entry], folder: Path) -> list[Entry]:
    """Return the entries, followed by those of other captures that have results in the folder, sorted by name."""
    names = {entry.row.capture for entry in entries}
    earlier = []
    for path in sorted(folder.glob(f"*/{REPORT}")):
        if path.parent.name in names or path.parent.is_symlink():
            continue
        try:
            entry = Entry.of(read_report(path.parent))
        except Exception as error:  # a report of somebody else may be wrong in any way
            if is_out_of_memory(error):
                raise
            continue
        if entry.row.capture == path.parent.name:
            earlier.append(entry)
    return [*entries, *earlier]


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
        raise OutputError("was not written by splinecli", path=path, hint="Add --overwrite, or choose another -o")
