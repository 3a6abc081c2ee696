"""Matrices of light files that are not lines of text: NumPy's .npy, MATLAB's .mat, OpenCV's YAML and XML.

A file may have several matrices. The lights are the only one N x 3 or 3 x N that fits the images.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splinecli.capture.formats.matlab import read_matrices
from splinecli.capture.formats.text import MOST_TEXT, NumberRows, Row, check_length, read_text
from splinecli.errors import InputError
from splinecli.maths import Doubles

SUFFIXES = (".npy", ".mat", ".yml", ".yaml", ".xml")

# OpenCV's FileStorage; its own reader is C++ that was made for trusted files.
# No part may run over what another one begins with: a file of 1 MB would take minutes.
_YAML = re.compile(
    r"^[ \t]*([\w.-]+):\s*!!opencv-matrix\s+rows:\s*(\d{1,9})\s+cols:\s*(\d{1,9})\s+dt:\s*\"?\w+\"?"
    r"\s+data:\s*\[([^][:]*)\]",
    re.MULTILINE,
)
_XML = re.compile(
    r"<([\w.-]+)\s+type_id=\"opencv-matrix\"\s*>\s*<rows>\s*(\d{1,9})\s*</rows>\s*<cols>\s*(\d{1,9})\s*</cols>"
    r"\s*<dt>[^<]*</dt>\s*<data>([^<]*)</data>"
)


def read_array_file(path: Path, n_images: int | None = None) -> NumberRows:
    """Return the rows of the matrix of lights, n_images of them if it is known; the lines count them from 1.

    Raises InputError where the file is damaged, or not one alone of its matrices can be the lights.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        array = _read_npy(path)
    else:
        check_length(path, MOST_TEXT)
        array = _choose(read_matrices(path) if suffix == ".mat" else _read_opencv(path), path, n_images)
    if array.ndim != 2 or array.dtype.kind not in "fiu" or not array.size or not np.isfinite(array).all():
        raise InputError(
            f"found an array of shape {array.shape} and type {array.dtype}, expected finite numbers N x 3", path=path
        )
    rows = enumerate(array.astype(np.float64).tolist(), start=1)
    return NumberRows(path, tuple(Row(tuple(numbers), line) for line, numbers in rows))


def _choose(matrices: Mapping[str, Doubles], path: Path, n_images: int | None) -> Doubles:
    """Return the matrix N x 3 or 3 x N, of several the one that has a light for each image."""
    lights = {name: matrix for name, matrix in matrices.items() if matrix.ndim == 2 and 3 in matrix.shape}
    if len(lights) > 1:
        lights = {name: m for name, m in lights.items() if m.shape in ((n_images, 3), (3, n_images))} or lights
    if len(lights) == 1:
        return next(iter(lights.values()))
    sizes = ", ".join(f"{name} ({' x '.join(map(str, m.shape))})" for name, m in (lights or matrices).items())
    problem = f"found {'several matrices' if lights else 'no matrix'} N x 3 or 3 x N{f': {sizes}' if sizes else ''}"
    hint = "Write the light directions into a text file, a line x y z for each image"
    raise InputError(problem, path=path, hint=hint)


def _read_npy(path: Path) -> NDArray[np.generic]:
    check_length(path, MOST_TEXT)
    try:
        with path.open("rb") as file:
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except OSError as error:
        raise InputError(f"the file cannot be read ({error.strerror})", path=path) from None
    except Exception:  # the header is a Python literal: a damaged one fails in a dozen ways
        raise InputError("the .npy file is damaged, or contains no array of numbers", path=path) from None


def _read_opencv(path: Path) -> dict[str, Doubles]:
    """Return the matrices of a file of OpenCV's FileStorage by name. Raises InputError."""
    text = read_text(path).decode(errors="replace")
    found: dict[str, Doubles] = {}
    for name, rows, columns, data in (_XML if path.suffix.lower() == ".xml" else _YAML).findall(text):
        try:
            numbers = np.array([float(word) for word in re.split(r"[\s,]+", data.strip())])
            found[name] = numbers.reshape(int(rows), int(columns))
        except ValueError:
            raise InputError(
                f"the matrix {name} is damaged: its numbers do not fill {rows} x {columns}", path=path
            ) from None
    return found
