"""Light files: every accepted way of writing one, and the message for every wrong one."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splinecli.capture import read_light_directions, read_light_intensities
from splinecli.errors import InputError

DIRECTIONS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8], [-0.48, 0.36, 0.8]])
ROWS = ["0 0 1", "0.6 0 0.8", "0 -0.6 0.8", "-0.48 0.36 0.8"]


def write(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "lights.txt"
    path.write_text(text, encoding=encoding)
    return path


FORMS = {
    "rows": "\n".join(ROWS),
    "crlf": "\r\n".join(ROWS) + "\r\n\r\n",
    "count": "4\n" + "\n".join(ROWS),
    "comments": "# x y z\n\n" + "\n\n".join(row + "  # a light" for row in ROWS),
    "tabs": "\n".join(ROWS).replace(" ", "\t"),
    "commas": "\n".join(ROWS).replace(" ", ", "),
    "semicolons": "\n".join(ROWS).replace(" ", ";"),
    "mixed": "0 0 2\n3,0,4\n0;\t-6e-1; 0.8,\n-0.48\t0.36 , 0.8",
    "transposed": "0 0.6 0 -0.48\n0 0 -0.6 0.36\n1 0.8 0.8 0.8",
    "count-transposed": "4\n0 0.6 0 -0.48\n0 0 -0.6 0.36\n1 0.8 0.8 0.8",
}


@pytest.mark.parametrize("form", FORMS)
def test_directions(tmp_path: Path, form: str) -> None:
    for n_images, encoding in ((None, "utf-8"), (4, "utf-8"), (None, "utf-8-sig"), (4, "utf-8-sig")):
        directions = read_light_directions(write(tmp_path, FORMS[form], encoding), n_images)
        assert directions.dtype == np.float64
        np.testing.assert_allclose(directions, DIRECTIONS, atol=1e-15)


def test_lengths_far_from_one_neither_overflow_nor_underflow(tmp_path: Path) -> None:
    directions = read_light_directions(write(tmp_path, "0 3e300 4e300\n0 3e-300 4e-300\n0 0 1"))
    np.testing.assert_allclose(directions[:2], [[0, 0.6, 0.8]] * 2)


@settings(deadline=None)
@given(
    vectors=st.lists(st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.01, 10)), min_size=4, max_size=12),
    separator=st.sampled_from([" ", "\t", ",", ";", " ,\t", " ; "]),
    counted=st.booleans(),
    transposed=st.booleans(),
)
def test_directions_round_trip(
    vectors: list[tuple[float, float, float]], separator: str, counted: bool, transposed: bool
) -> None:
    values = np.array(vectors)
    rows = [separator.join(repr(float(v)) for v in row) for row in (values.T if transposed else values)]
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), "\n".join(([str(len(values))] if counted else []) + rows))
        directions = read_light_directions(path, len(values))
    np.testing.assert_allclose(
        directions, values / np.linalg.norm(values, axis=1, keepdims=True), rtol=1e-12, atol=1e-15
    )


COMMA = "A comma separates columns; write decimals with a point."
BELOW = "found a light below the horizon"


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("0 0 1\n\n0 1\n0 1 1", 3, "found 2 columns, expected 3 as in the other lines"),
        ("0 0 1 1\n" * 5, 1, "found 4 columns, expected 3 (x y z)"),
        ("0,1,0,2,0,9\n" * 5, 1, f"found 6 columns, expected 3 (x y z). {COMMA}"),
        ("0.1 0.2 1\n0,1 0,2 1\n0.1 0.2 1", 2, f"found 5 columns, expected 3 as in the other lines. {COMMA}"),
        ("0.1 0.2 1\n0.1,0.2,0.3,1\n0.1 0.2 1", 2, "found 4 columns, expected 3 as in the other lines"),
        ("# lights\n0 0 1\n0 one 1", 3, 'found "one", expected a number'),
        ("0 0 1\n0 1_0 1", 2, 'found "1_0", expected a number'),
        ("0 0 1\n0 nan 1", 2, 'found "nan", expected a finite number'),
        ("0 0 1\n0 1e999 1", 2, 'found "1e999", expected a finite number'),
        ("0 0 1\n0 0 0", 2, "found a zero vector, expected a light direction"),
        ("0 0 1\n0 1 -0.5", 2, f"{BELOW} (z = -0.5), expected z > 0"),
        ("0 0 0 1\n0 1 0 0\n1 1 1 0", 3, f"{BELOW} in column 4 (z = 0), expected z > 0"),
        ("5\n0 0 1\n0 1 1\n1 0 1\n1 1 1", 1, "the count line says 5, but 4 rows follow"),
        ("0.5\n0 0 1\n0 1 1", 1, "found 1 column, expected 3 columns or a count"),
        ("0 0 1\n0 1 1\n1 0 1", None, "found 3 light directions, expected 5, one for each image"),
        ("# nothing\n", None, "the file contains no numbers"),
    ],
)
def test_wrong_directions(tmp_path: Path, text: str, line: int | None, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_light_directions(path, 5 if line is None else None)
    assert str(caught.value).startswith(f"{path}: {message}" if line is None else f"{path}:{line}: {message}")
    assert (caught.value.path, caught.value.line) == (path, line)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((3, 3), np.uint8))
    write(tmp_path, "0 0 1 # \u00e9", encoding="latin-1")
    for name, message in (
        ("none.txt", r"none\.txt: the file does not exist\."),
        (".", r"found a folder, expected a text file with a line x y z for"),
        ("lights.txt", r"the file is not UTF-8 text\. Save it as plain UTF-8 text\."),
        ("mask.png", r"found an image, expected a text file with a line x y z for each image\."),
    ):
        with pytest.raises(InputError, match=message):
            read_light_directions(tmp_path / name)
    with pytest.raises(InputError, match=r"expected a text file with a line r g b for each image\."):
        read_light_intensities(tmp_path / "mask.png", 3)


@pytest.mark.parametrize(
    "text", ["1 2 4\n2 2 2\n1 1 1\n3 3 3", "4\n1,2,4\n2,2,2\n1,1,1\n3,3,3", "1 2 1 3\n2 2 1 3\n4 2 1 3"]
)
def test_intensities(tmp_path: Path, text: str) -> None:
    intensities = read_light_intensities(write(tmp_path, text), 4)
    np.testing.assert_array_equal(intensities, [[1, 2, 4], [2, 2, 2], [1, 1, 1], [3, 3, 3]])


@pytest.mark.parametrize("text", ["3\n1\n2\n5", "4\n3\n1\n2\n5", "3 1 2 5"], ids=["column", "count", "row"])
def test_gray_intensities_count_for_every_channel(tmp_path: Path, text: str) -> None:
    intensities = read_light_intensities(write(tmp_path, text), 4)
    np.testing.assert_array_equal(intensities, np.repeat([[3], [1], [2], [5]], 3, axis=1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 1 1\n1 0 1\n1 1 1\n1 1 1", ":2: found the intensity 0, expected a number above 0."),
        ("1 1 1 1\n1 1 -2 1\n1 1 1 1", ":2: found the intensity -2 in column 3, expected a number above 0."),
        ("1 1\n1 1\n1 1\n1 1", ":1: found 2 columns, expected 3 (R G B) or 1 (gray)."),
        ("1 1 1\n1 inf 1\n1 1 1\n1 1 1", ':2: found "inf", expected a finite number.'),
        ("1 1 1\n1 1 1", ": found 2 light intensities, expected 4, one for each image."),
        ("1 1 1\n1 1e308 1\n1 1 1\n1 1 1", ":2: found the intensity 1e+308, expected a number from 1e-12 to"),
    ],
)
def test_wrong_intensities(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_light_intensities(path, 4)
    assert str(caught.value).startswith(f"{path}{message}")
