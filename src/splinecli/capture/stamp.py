"""Stamps: values that change when a file of a capture changes, so that earlier results are known to be out of date."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from splinecli.capture.formats.text import read_text
from splinecli.capture.paths import is_substitution
from splinecli.capture.source import CaptureSource
from splinecli.errors import InputError
from splinecli.files import file_sha256


def stamp_capture(source: CaptureSource) -> list[Any]:
    """Return JSON values that change when any file read for the capture, or the given white level, does.

    Images and flat fields are stamped by path, size and time of change, because reading them takes long. All other
    files (lights, intensities, mask, ground truth, ambient image) are stamped by their content.

    Raises:
        InputError: a file cannot be read.
    """
    files = source.files
    small = (files.light_directions, files.light_intensities, files.mask, files.ground_truth, files.ambient)
    lamps = () if source.lamps is None else source.lamps.paths
    stamp: list[Any] = [
        [_sha256(path) for path in (*files.boundaries, *small, *lamps) if path is not None],
        [_path_size_and_time(path) for path in files.images],
        [_path_size_and_time(path) for path in source.radiometry.flat_field],
    ]
    if source.radiometry.automatic and source.radiometry.curve != 1:
        # Earlier versions read such images as linear, or those with a colour profile as sRGB.
        stamp.append(source.radiometry.curve or "sRGB")
    # Left out where it is not given, so that earlier stamps stay valid.
    return stamp if source.white_level is None else [*stamp, source.white_level]


def digest(stamp: list[Any]) -> str:
    """Return the SHA-256 of a stamp, or of any JSON values, in hexadecimal digits."""
    return hashlib.sha256(json.dumps(stamp).encode()).hexdigest()


def _sha256(path: Path) -> str:
    try:
        if is_substitution(path):
            return hashlib.sha256(read_text(path)).hexdigest()
        return file_sha256(path)
    except OSError as error:
        raise _unreadable(path, error) from None


def _path_size_and_time(path: Path) -> tuple[str, int, int]:
    try:
        status = path.stat()
        return str(path.resolve()), status.st_size, status.st_mtime_ns
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: OSError) -> InputError:
    return InputError(f"the file cannot be read ({error.strerror})", path=path)
