"""Stamps: values that change when a file of a capture changes, so that earlier results are known to be out of date."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli.capture.formats.text import read_text
from splinecli.system.files import check_file, file_sha256, is_substitution, reading

if TYPE_CHECKING:
    from splinecli.capture.layouts.capture_files import CaptureFiles

LARGEST_HASHED = 1 << 26  # bytes of the largest file that is stamped by its content


def stamp_files(files: CaptureFiles, flat_field: Sequence[Path], lamps: Sequence[Any]) -> tuple[Any, ...]:
    """Return JSON values that change when a file of the capture does. Take them before the files are read.

    Images and flat fields are stamped by path, size and time of change, because reading them takes long. All other
    files (lights, intensities, mask, ground truth, ambient image) are stamped by their content.

    Raises:
        InputError: a file cannot be read.
    """
    small = (files.light_directions, files.light_intensities, files.mask, files.ground_truth, files.ambient)
    return (
        [*(stamp_content(path) for path in (*files.boundaries, *small) if path is not None), *lamps],
        [_path_size_and_time(path) for path in files.images],
        [_path_size_and_time(path) for path in flat_field],
    )


def stamp_content(path: Path) -> Any:
    """Return the SHA-256 of a file, or the path, size and time of change of a very large one. Raises InputError."""
    check_file(path, "a file", pipe=True)
    if is_substitution(path):
        return hashlib.sha256(read_text(path)).hexdigest()
    with reading(path):
        return file_sha256(path) if path.stat().st_size <= LARGEST_HASHED else _path_size_and_time(path)


def digest(stamp: Sequence[Any]) -> str:
    """Return the SHA-256 of a stamp, or of any JSON values, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(stamp).encode()).hexdigest()


def _path_size_and_time(path: Path) -> tuple[str, int, int]:
    with reading(path):
        status = path.stat()
        return str(path.resolve()), status.st_size, status.st_mtime_ns
