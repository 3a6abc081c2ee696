"""Light files of MATLAB and OpenCV, written by SciPy and OpenCV themselves."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from scenes import ring_lights
from splinecli.capture.light_files import read_light_directions
from splinecli.errors import InputError

LIGHTS = ring_lights(8)


def write_opencv(path: Path, **matrices: np.ndarray) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, matrix in matrices.items():
        storage.write(name, matrix)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml"])
@pytest.mark.parametrize("transposed", [False, True])
def test_opencv(tmp_path: Path, suffix: str, transposed: bool) -> None:
    stored = np.ascontiguousarray(LIGHTS.T) if transposed else LIGHTS
    path = write_opencv(tmp_path / f"calibration{suffix}", camera=np.eye(3), lights=5 * stored)
    np.testing.assert_allclose(read_light_directions(path, 8), LIGHTS, atol=1e-12)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_matlab(tmp_path: Path, compressed: bool, dtype: type) -> None:
    path = tmp_path / "leds.mat"
    content = {"Dir": LIGHTS.T.astype(dtype), "mu": np.ones((8, 1)), "name": "rig", "K": np.eye(3)}
    savemat(path, content, do_compression=compressed)
    np.testing.assert_allclose(read_light_directions(path, 8), LIGHTS, atol=1e-6)


def test_several_matrices_are_named(tmp_path: Path) -> None:
    savemat(tmp_path / "leds.mat", {"Dir": LIGHTS.T, "S": LIGHTS})
    with pytest.raises(InputError, match=r"several matrices N x 3 or 3 x N: Dir \(3 x 8\), S \(8 x 3\)"):
        read_light_directions(tmp_path / "leds.mat", 8)
    with pytest.raises(InputError, match=r"no matrix N x 3 or 3 x N: K \(2 x 2\)"):
        read_light_directions(write_opencv(tmp_path / "k.yml", K=np.eye(2)), 8)


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.yml", b"", "no matrix"),
        ("a.yml", b"lights: !!opencv-matrix\n rows: 2\n cols: 3\n dt: d\n data: [ 1, 2 ]\n", "is damaged"),
        ("a.yml", b"lights: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1, x, 2 ]\n", "is damaged"),
        ("a.yml", b"l: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1, .Nan, 2 ]\n", "damaged"),
        ("a.xml", b"<?xml version='1.0'?><opencv_storage></opencv_storage>", "no matrix"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(300), "is damaged|no matrix"),
        ("a.mat", b"MATLAB 7.3 MAT-file" + bytes(300), "7.3 file, which is not supported"),
    ],
)
def test_damaged_files(tmp_path: Path, name: str, content: bytes, problem: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=problem):
        read_light_directions(tmp_path / name, 3)


@pytest.mark.parametrize(
    ("name", "start", "unit"),
    [
        ("a.yml", "", "\n"),
        ("a.yml", "lights: ", "\n"),
        ("a.yml", "lights: !!opencv-matrix", " \n"),
        ("a.yml", "", "l: !!opencv-matrix\n rows: 1\n cols: 3\n dt: d\n data: [ 1\n"),
        ("a.xml", "", '<l type_id="opencv-matrix"><rows>1</rows><cols>3</cols><dt>d</dt><data>1'),
    ],
)
def test_no_file_takes_a_time_that_grows_with_the_square_of_its_length(
    tmp_path: Path, name: str, start: str, unit: str
) -> None:
    (tmp_path / name).write_text(start + unit * (900_000 // len(unit)))
    started = time.process_time()
    with pytest.raises(InputError, match="no matrix"):
        read_light_directions(tmp_path / name, 3)
    assert time.process_time() - started < 3  # the square took minutes to hours


def test_slant_and_tilt_of_halcon(tmp_path: Path) -> None:
    x, y, z = LIGHTS.T
    angles = np.degrees(np.stack((np.arccos(z), np.arctan2(y, x)), axis=1))
    np.savetxt(tmp_path / "l.txt", angles)
    found = read_light_directions(tmp_path / "l.txt", 8, form="slant-tilt")
    np.testing.assert_allclose(found, LIGHTS, atol=1e-12)
    np.savetxt(tmp_path / "wrong.txt", angles + np.array((60, 0)))
    with pytest.raises(InputError, match="found slant 100 and tilt"):
        read_light_directions(tmp_path / "wrong.txt", 8, form="slant-tilt")
