"""Light files: every accepted way of writing one, as people have them, and the message for every
wrong one.
"""

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import savemat

from scenes import parametrize, put, refuses, vectors, write_image
from splinecli.capture import read_light_directions, read_light_intensities
from splinecli.capture.light_files import light_encoder, match_images, read_lights
from splinecli.errors import InputError
from splinecli.maths.normals import unit

DIRECTIONS = vectors("0 0 1; 0.6 0 0.8; 0 -0.6 0.8; -0.48 0.36 0.8")
ROWS = ["0 0 1", "0.6 0 0.8", "0 -0.6 0.8", "-0.48 0.36 0.8"]


FORMS = {
    "rows": "\n".join(ROWS),
    "count": "4\n" + "\n".join(ROWS),
    "comments": "# x y z\n\n" + "\n\n".join(row + "  # a light" for row in ROWS),
    "commas": "\n".join(ROWS).replace(" ", ", "),
    "semicolons": "\n".join(ROWS).replace(" ", ";"),
    "mixed": "0 0 2\n3,0,4\n0;\t-6e-1; 0.8,\n-0.48\t0.36 , 0.8",
    "transposed": "0 0.6 0 -0.48\n0 0 -0.6 0.36\n1 0.8 0.8 0.8",
    "count-transposed": "4\n0 0.6 0 -0.48\n0 0 -0.6 0.36\n1 0.8 0.8 0.8",
    "header": "x y z\n" + "\n".join(ROWS),
    "units": "Lx,Ly,Lz\r\n0,0,1\r\n0.6,0,0.8\r\n0,-0.6,0.8\r\n-0.48,0.36,0.8\r\n",
    "decimal-commas": "0 0 1\n0,6 0 0,8\n0 -0,6 0,8\n-0,48 0,36 0,8",
    "commas-and-semicolons": "4\n0;0;1\n0,6;0;0,8\n0;-0,6;0,8\n-0,48;0,36;0,8",
    "counted-from-1": "1 0 0 1\n3 0 -0.6 0.8\n2 0.6 0 0.8\n4 -0.48 0.36 0.8",
    "z-first": "z y x\n1 0 0\n0.8 0 0.6\n0.8 -0.6 0\n0.8 0.36 -0.48",
    "y-first": "light,dir_y,dir_x,dir_z\n1,0,0,1\n2,0,0.6,0.8\n3,-0.6,0,0.8\n4,0.36,-0.48,0.8",
    "counted-from-0": "no x y z\n0 0 0 1\n1 0.6 0 0.8\n2 0 -0.6 0.8\n3 -0.48 0.36 0.8",
}


@parametrize("form", FORMS)
def test_directions(tmp_path, form):
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        directions = read_light_directions(put(tmp_path / "lights.txt", FORMS[form], encoding), 4)
        assert directions.dtype == np.float64
        assert_allclose(directions, DIRECTIONS, atol=1e-15)


def test_lengths_far_from_one_neither_overflow_nor_underflow(tmp_path):
    directions = read_light_directions(
        put(tmp_path / "lights.txt", "0 3e300 4e300\n0 3e-300 4e-300\n0 0 1")
    )
    assert_allclose(directions[:2], [[0, 0.6, 0.8]] * 2)


COMMA = "Commas separate columns, so use a point as the decimal separator."


@parametrize(
    "text, line, message",
    [
        ("0 0 1\n\n0 1\n0 1 1", 3, "found 2 columns, expected 3 as in the other lines"),
        ("0 0 1 1\n" * 5, 1, "found 4 columns, expected 3 (x y z)"),
        ("0,1,0,2,0,9\n" * 5, 1, f"found 6 columns, expected 3 (x y z). {COMMA}"),
        (
            "0.1 0.2 1\n0,1 0,2 1\n0.1 0.2 1",
            2,
            f"found 5 columns, expected 3 as in the other lines. {COMMA}",
        ),
        (
            "0.1 0.2 1\n0.1,0.2,0.3,1\n0.1 0.2 1",
            2,
            "found 4 columns, expected 3 as in the other lines",
        ),
        ("# lights\n0 0 1\n0 one 1", 3, 'found "one", expected a number'),
        ("0 0 1\n0 1_0 1", 2, 'found "1_0", expected a number'),
        ("0 0 1\n0 1e999 1", 2, 'found "1e999", expected a finite number'),
        (
            "0 0 0 1\n0 1 0 0\n1 1 1 0",
            3,
            "found a light below the horizon in column 4 (z = 0), expected z > 0",
        ),
        ("5\n0 0 1\n0 1 1\n1 0 1\n1 1 1", 1, "the count line states 5, but 4 rows follow"),
        ("0.5\n0 0 1\n0 1 1", 1, "found 1 column, expected 3 columns or a count"),
        ("0 0 1\n0 1 1\n1 0 1", None, "found 3 light directions, expected 5, one for each image"),
        ("# nothing\n", None, "the file contains no numbers"),
    ],
)
def test_wrong_directions(tmp_path, text, line, message):
    path = put(tmp_path / "lights.txt", text)
    with pytest.raises(InputError) as caught:
        read_light_directions(path, 5 if line is None else None)
    assert str(caught.value).startswith(
        f"{path}: {message}" if line is None else f"{path}:{line}: {message}"
    )
    assert caught.value.path == path
    assert caught.value.line == line


def test_files_that_are_no_text(tmp_path):
    write_image(tmp_path / "mask.png", np.zeros((3, 3), np.uint8))
    put(tmp_path / "lights.txt", "0 0 1 # \u00e9", encoding="latin-1")
    for name, message in (
        ("none.txt", r"none\.txt: the file does not exist\."),
        (".", r"found a folder, expected a text file with one line x y z for"),
        ("lights.txt", r"the file is not UTF-8 text\. Save it as plain UTF-8 text\."),
        ("mask.png", r"found an image, expected a text file with one line x y z for each image\."),
    ):
        with refuses(message):
            read_light_directions(tmp_path / name)
    with refuses(r"expected a text file with one line r g b for each image\."):
        read_light_intensities(tmp_path / "mask.png", 3)


COLOURED = (
    "1 2 4\n2 2 2\n1 1 1\n3 3 3",
    "4\n1,2,4\n2,2,2\n1,1,1\n3,3,3",
    "1 2 1 3\n2 2 1 3\n4 2 1 3",
)
GRAY = ("3\n1\n2\n5", "4\n3\n1\n2\n5", "3 1 2 5")


@parametrize("text", COLOURED + GRAY)
def test_intensities(tmp_path, text):
    """In rows, after a count, or in columns; gray ones count for every channel."""
    expected = (
        [[3] * 3, [1] * 3, [2] * 3, [5] * 3]
        if text in GRAY
        else [[1, 2, 4], [2, 2, 2], [1, 1, 1], [3, 3, 3]]
    )
    assert_array_equal(read_light_intensities(put(tmp_path / "lights.txt", text), 4), expected)


@parametrize(
    "text, message",
    r"""
1 1 1\n1 0 1\n1 1 1\n1 1 1 | :2: found the intensity 0, expected a number above 0.
1 1 1 1\n1 1 -2 1\n1 1 1 1 | :2: found the intensity -2 in column 3, expected a number above 0.
1 1\n1 1\n1 1\n1 1 | :1: found 2 columns, expected 3 (R G B) or 1 (gray).
1 1 1\n1 inf 1\n1 1 1\n1 1 1 | :2: found "inf", expected a finite number.
1 1 1\n1 1 1 | : found 2 light intensities, expected 4, one for each image.
1 1 1\n1 1e308 1\n1 1 1\n1 1 1 | :2: found the intensity 1e+308, expected a number from 1e-12 to
""",
)
def test_wrong_intensities(tmp_path, text, message):
    path = put(tmp_path / "lights.txt", text)
    with pytest.raises(InputError) as caught:
        read_light_intensities(path, 4)
    assert str(caught.value).startswith(f"{path}{message}")


@parametrize("n_images", [None, 4])
def test_one_light_in_each_column_is_no_count(tmp_path, n_images):
    # The first column, 1 3 2, would count three lights.
    path = put(tmp_path / "lights.txt", "1 0 0 1\n3 1 0 0\n2 1 1 1")
    expected = vectors("1 3 2; 0 1 1; 0 0 1; 1 0 1")
    assert_allclose(read_light_directions(path, n_images), unit(expected))


@parametrize(
    "text",
    [
        "image,x,y,z\nimg10.png,-0.48,0.36,0.8\nimg2.png,0.6,0,0.8\nimg1.png,0,0,1\nimg3.png,0,-0.6,0."
        "8",
        'C:\\shoot\\img3.PNG 0 -0,6 0,8\n"img2.png" 0,6 0 0,8\nimg1.png 0 0'
        " 1\nimg10.png -0,48 0,36 0,8",
        "name z y x\nimg1 1 0 0\nimg2 0.8 0 0.6\nimg3 0.8 -0.6 0\nimg10 0.8 0.36 -0.48",
        "4\nimg1 0 0 1\nimg2 0.6 0 0.8\nimg3 0 -0.6 0.8\nimg10 -0.48 0.36 0.8",
    ],
    ids=["csv", "paths", "header", "stems"],
)
@parametrize("stem", "img 2024_0")
def test_rows_that_name_their_image(tmp_path, text, stem):
    """A name such as 2024_01, which Python would read as a number, is a name."""
    table, directions = read_lights(put(tmp_path / "lights.txt", text.replace("img", stem)), 4)
    wanted = [Path(f"{stem}{number}.png") for number in (1, 2, 3, 10)]
    images, how = match_images(table, wanted)
    assert how.startswith("name")
    found = dict(zip(images, directions, strict=True))
    assert_allclose([found[image] for image in wanted], DIRECTIONS, atol=1e-15)


@parametrize(
    "factors, message",
    [
        ([1, 2, 4, 8], None),
        ([1, 2, 4], "3 factors for 4 lights"),
        ([1, 2, 4, 1e-320], "not from 1e-12 to 1e"),
    ],
)
def test_factors_of_a_dome_are_inverse_intensities(tmp_path, factors, message):
    path = tmp_path / "a.dome"
    lights = [dict(zip("xyz", row, strict=True)) for row in DIRECTIONS.tolist()]
    put(
        path,
        json.dumps(
            {
                "directions": lights,
                "ledAdjust": [dict.fromkeys("rgb", factor) for factor in factors],
            }
        ),
    )
    if message is None:
        assert_allclose(read_lights(path, 4)[0].intensities, 1 / np.tile(factors, (3, 1)).T)
    else:
        with refuses(message):
            read_lights(path, 4)


@parametrize("suffix", ".txt .npy .lp .csv")
def test_written_lights_are_read_again(tmp_path, suffix):
    path = tmp_path / f"lights{suffix}"
    path.write_bytes(
        light_encoder(path)(DIRECTIONS, [Path(f"{number}.png") for number in range(4)])
    )
    assert_allclose(read_lights(path, 4)[1], DIRECTIONS, atol=1e-8)
    if suffix == ".csv":
        assert path.read_text().splitlines()[0] == "x,y,z"


@parametrize("text", ["0 90\n0 53.130102\n-90 53.130102\n143.130102 53.130102", None])
def test_angles(tmp_path, text):
    # atan2(0.36, -0.48) = 143.13 degrees, asin(0.8) = 53.13 degrees.
    counted = "2 0 53.130102\n1 0 90\n3 270 53.130102\n4 143.130102 53.130102"
    directions = read_light_directions(
        put(tmp_path / "lights.txt", text or counted), 4, form="azel"
    )
    assert_allclose(directions, DIRECTIONS, atol=1e-7)


ADD_AZEL = ".*add --light-format azel"


@parametrize(
    "form, text, message",
    [
        (
            "xyz",
            "0 90\n30 45\n120 45\n240 45",
            f"2 columns of angles, expected 3 columns{ADD_AZEL}",
        ),
        (
            "xyz",
            "1 0 90\n2 30 45\n3 120 45\n4 240 45",
            f"a number and two angles, expected 3 columns{ADD_AZEL}",
        ),
        (
            "xyz",
            "0 30 1\n90 40 1\n180 45 1\n270 30 1",
            f"and 1, expected x y z.*Remove the third{ADD_AZEL}",
        ),
        ("xyz", "a.png 0 30\nb.png 90 40\nc.png 180 45", f"a name and 2 numbers{ADD_AZEL}"),
        (
            "azel",
            "30 45\n120 100\n240 45",
            r":2: found azimuth 120 and elevation 100, expected azimuths from -360",
        ),
        ("azel", "30 45\n120 0\n240 45", r":2: found azimuth 120 and elevation 0, expected"),
        (
            "azel",
            "0.5 0.7\n2.1 0.8\n4.2 0.9",
            "found no angle above 2 pi, which suggests radians.*57.2958",
        ),
        (
            "azel",
            "azimuth zenith\n30 45\n120 40\n240 45",
            r':1: found the column "zenith".*90 minus the angle',
        ),
        (
            "azel",
            "0 0 1\n1 0 1\n0 1 1\n1 1 1",
            r"found 3 columns, expected 2 \(azimuth elevation\)",
        ),
        ("slant-tilt", "30 45\n100 100", ":2: found slant 100 and tilt 100, expected"),
    ],
)
def test_angles_and_vectors_are_not_mistaken_for_each_other(tmp_path, form, text, message):
    with refuses(message):
        read_lights(put(tmp_path / "lights.txt", text), text.count("\n") + 1, form=form)


def write_opencv(path, **matrices):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, matrix in matrices.items():
        storage.write(name, np.ascontiguousarray(matrix, np.float64))
    storage.release()
    return path


@parametrize("suffix", ".npy .yml .yaml .xml .mat packed.mat")
@parametrize("transposed", [False, True])
def test_arrays(tmp_path, suffix, transposed):
    """Written by NumPy, OpenCV and SciPy themselves."""
    stored, path = (
        5 * np.float32(DIRECTIONS.T if transposed else DIRECTIONS),
        tmp_path / f"lights{suffix}",
    )
    if suffix == ".npy":
        np.save(path, stored)
    elif "mat" in suffix:
        others = {"mu": np.ones((4, 1)), "name": "rig", "K": np.eye(3)}
        savemat(path, {"Dir": stored, **others}, do_compression=suffix != ".mat")
    else:
        write_opencv(path, camera=np.eye(3), lights=stored)
    assert_allclose(read_light_directions(path, 4), DIRECTIONS, atol=1e-7)


def test_refused_arrays(tmp_path):
    for array, message in (
        (np.zeros((4, 3), "U1"), "expected finite numbers N x 3"),
        (np.full((4, 3), np.nan), "expected finite numbers N x 3"),
        (np.array({"a": 1}, object), "is damaged or does not contain an array of numbers"),
        (np.ones((5, 3)), "found 5 light directions, expected 4"),
    ):
        np.save(tmp_path / "lights.npy", array, allow_pickle=True)
        with refuses(message):
            read_light_directions(tmp_path / "lights.npy", 4)
    savemat(tmp_path / "leds.mat", {"Dir": DIRECTIONS.T, "S": DIRECTIONS})
    with refuses(r"several matrices N x 3 or 3 x N: Dir \(3 x 4\), S \(4 x 3\)"):
        read_light_directions(tmp_path / "leds.mat", 4)
    with refuses(r"no matrix N x 3 or 3 x N: K \(2 x 2\)"):
        read_light_directions(write_opencv(tmp_path / "k.yml", K=np.eye(2)), 4)


@parametrize(
    "name, content, problem",
    [
        ("a.yml", b"", "no matrix"),
        (
            "a.yml",
            b"lights: !!opencv-matrix\n rows: 2\n cols: 3\n dt: d\n data: [ 1, 2 ]\n",
            "is damaged",
        ),
        (
            "a.yml",
            b"lights: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1, x, 2 ]\n",
            "is damaged",
        ),
        (
            "a.yml",
            b"l: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1, .Nan, 2 ]\n",
            "damaged",
        ),
        ("a.xml", b"<?xml version='1.0'?><opencv_storage></opencv_storage>", "no matrix"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(300), "is damaged|no matrix"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + bytes(300), "7.3 file, which is not supported"),
    ],
)
def test_damaged_matrices(tmp_path, name, content, problem):
    (tmp_path / name).write_bytes(content)
    with refuses(problem):
        read_light_directions(tmp_path / name, 3)


@parametrize(
    "name, start, unit",
    [
        ("a.yml", "", "\n"),
        ("a.yml", "lights: ", "\n"),
        ("a.yml", "lights: !!opencv-matrix", " \n"),
        ("a.yml", "", "l: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1\n"),
        ("a.xml", "", '<l type_id="opencv-matrix"><rows>1</rows><cols>3</cols><dt>d</dt><data>1'),
    ],
)
def test_the_time_of_a_file_does_not_grow_with_the_square_of_its_length(
    tmp_path, name, start, unit
):
    put(tmp_path / name, start + unit * (900_000 // len(unit)))
    started = time.process_time()
    with refuses("no matrix"):
        read_light_directions(tmp_path / name, 3)
    assert time.process_time() - started < 3  # the square took minutes to hours
