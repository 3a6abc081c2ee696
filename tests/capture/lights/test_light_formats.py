"""Light files as people have them: headers, names, counts, other encodings, decimal commas, angles, arrays."""

from pathlib import Path

import numpy as np
import pytest

from splinecli.capture.lights.light_files import read_light_directions
from splinecli.capture.lights.named_lights import NamedLights, read_lights
from splinecli.errors import InputError

DIRECTIONS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8], [-0.48, 0.36, 0.8]])
IMAGES = tuple(Path(f"img{number}.png") for number in (1, 2, 3, 10))


def write(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "lights.txt"
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("x y z\n0 0 1\n0.6 0 0.8\n0 -0.6 0.8\n-0.48 0.36 0.8", "utf-8"),
        ("Lx,Ly,Lz\r\n0,0,1\r\n0.6,0,0.8\r\n0,-0.6,0.8\r\n-0.48,0.36,0.8\r\n", "utf-16"),
        ("0 0 1\n0,6 0 0,8\n0 -0,6 0,8\n-0,48 0,36 0,8", "utf-8"),
        ("4\n0;0;1\n0,6;0;0,8\n0;-0,6;0,8\n-0,48;0,36;0,8", "utf-16-le"),
        ("1 0 0 1\n3 0 -0.6 0.8\n2 0.6 0 0.8\n4 -0.48 0.36 0.8", "utf-8"),
        ("z y x\n1 0 0\n0.8 0 0.6\n0.8 -0.6 0\n0.8 0.36 -0.48", "utf-8"),
        ("light,dir_y,dir_x,dir_z\n1,0,0,1\n2,0,0.6,0.8\n3,-0.6,0,0.8\n4,0.36,-0.48,0.8", "utf-8"),
        ("no x y z\n0 0 0 1\n1 0.6 0 0.8\n2 0 -0.6 0.8\n3 -0.48 0.36 0.8", "utf-8-sig"),
    ],
    ids=[
        "header",
        "utf-16",
        "decimal-commas",
        "commas-and-semicolons",
        "counted-from-1",
        "z-first",
        "y-first",
        "counted-from-0",
    ],
)
def test_plain_files(tmp_path: Path, text: str, encoding: str) -> None:
    path = write(tmp_path, ("\ufeff" if encoding == "utf-16-le" else "") + text, encoding)
    np.testing.assert_allclose(read_light_directions(path, 4), DIRECTIONS, atol=1e-15)


@pytest.mark.parametrize("n_images", [None, 4])
def test_one_light_in_each_column_is_no_count(tmp_path: Path, n_images: int | None) -> None:
    # The first column, 1 3 2, would count three lights.
    path = write(tmp_path, "1 0 0 1\n3 1 0 0\n2 1 1 1")
    expected = np.array([[1, 3, 2], [0, 1, 1], [0, 0, 1], [1, 0, 1]])
    expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(read_light_directions(path, n_images), expected)


@pytest.mark.parametrize(
    "text",
    [
        "image,x,y,z\nimg10.png,-0.48,0.36,0.8\nimg2.png,0.6,0,0.8\nimg1.png,0,0,1\nimg3.png,0,-0.6,0.8",
        'C:\\shoot\\img3.PNG 0 -0,6 0,8\n"img2.png" 0,6 0 0,8\nimg1.png 0 0 1\nimg10.png -0,48 0,36 0,8',
        "name z y x\nimg1 1 0 0\nimg2 0.8 0 0.6\nimg3 0.8 -0.6 0\nimg10 0.8 0.36 -0.48",
        "4\nimg1 0 0 1\nimg2 0.6 0 0.8\nimg3 0 -0.6 0.8\nimg10 -0.48 0.36 0.8",
    ],
    ids=["csv", "paths", "header", "stems"],
)
@pytest.mark.parametrize("stem", ["img", "2024_0"])
def test_rows_that_name_their_image(tmp_path: Path, text: str, stem: str) -> None:
    """A name such as 2024_01, which Python would read as a number, is a name."""
    text = text.replace("img", stem)
    lights = read_lights(write(tmp_path, text), 4)
    assert isinstance(lights, NamedLights)
    wanted = [Path(image.name.replace("img", stem)) for image in IMAGES]
    images, how = lights.match(wanted)
    assert how.startswith("name")
    found = dict(zip(images, lights.directions, strict=True))
    np.testing.assert_allclose([found[image] for image in wanted], DIRECTIONS, atol=1e-15)


@pytest.mark.parametrize("vectors", [DIRECTIONS * 3, DIRECTIONS.T.astype(np.float32)], ids=["rows", "columns"])
def test_arrays(tmp_path: Path, vectors: np.ndarray) -> None:
    np.save(tmp_path / "lights.npy", vectors)
    np.testing.assert_allclose(read_light_directions(tmp_path / "lights.npy", 4), DIRECTIONS, atol=1e-7)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 3), "U1"), "expected finite numbers N x 3"),
        (np.full((4, 3), np.nan), "expected finite numbers N x 3"),
        (np.array({"a": 1}, object), "is damaged, or contains no array of numbers"),
        (np.ones((5, 3)), "found 5 light directions, expected 4"),
    ],
)
def test_refused_arrays(tmp_path: Path, array: np.ndarray, message: str) -> None:
    np.save(tmp_path / "lights.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=message):
        read_light_directions(tmp_path / "lights.npy", 4)


@pytest.mark.parametrize("text", ["0 90\n0 53.130102\n-90 53.130102\n143.130102 53.130102", None])
def test_angles(tmp_path: Path, text: str | None) -> None:
    # atan2(0.36, -0.48) = 143.13 degrees, asin(0.8) = 53.13 degrees.
    counted = "2 0 53.130102\n1 0 90\n3 270 53.130102\n4 143.130102 53.130102"
    directions = read_light_directions(write(tmp_path, text or counted), 4, form="azel")
    np.testing.assert_allclose(directions, DIRECTIONS, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 90\n30 45\n120 45\n240 45", "2 columns of angles, expected 3 columns"),
        ("1 0 90\n2 30 45\n3 120 45\n4 240 45", "a number and two angles, expected 3 columns"),
        ("0 30 1\n90 40 1\n180 45 1\n270 30 1", "azimuth, elevation and 1, expected x y z.*Leave the third"),
        ("a.png 0 30\nb.png 90 40\nc.png 180 45", "a name and 2 numbers"),
    ],
)
def test_angles_are_not_read_as_vectors(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=f"found {message}.*add --lights-format azel"):
        read_lights(write(tmp_path, text), text.count("\n") + 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("30 45\n120 100\n240 45", r":2: found azimuth 120 and elevation 100, expected -360 to 360"),
        ("30 45\n120 0\n240 45", r":2: found azimuth 120 and elevation 0, expected"),
        ("0.5 0.7\n2.1 0.8\n4.2 0.9", "no angle is above 2 pi, so they look like radians.*57.2958"),
        ("azimuth zenith\n30 45\n120 40\n240 45", r':1: found the column "zenith".*90 minus the angle'),
        ("0 0 1\n1 0 1\n0 1 1\n1 1 1", r"found 3 columns, expected 2 \(azimuth elevation\)"),
    ],
)
def test_refused_angles(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_light_directions(write(tmp_path, text), form="azel")
