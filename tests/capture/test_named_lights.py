"""Light files that name their images: RTI's .lp and AliceVision's JSON."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splinecli.capture import open_capture, read_capture
from splinecli.errors import InputError
from splinecli.inference import estimate_normals
from splinecli.methods import make_estimator

LIGHTS = np.array([(0.4, 0.1, 0.9), (-0.3, 0.2, 0.8), (0.0, -0.5, 0.7), (0.1, 0.0, 1.0), (-0.2, -0.3, 0.6)])
NAMES = ["shot 10.png", "shot 2.png", "shot 3.png", "shot 04.png", "shot 1.png"]
WriteFolder = Callable[..., Path]


@pytest.fixture
def write_folder(tmp_path: Path) -> WriteFolder:
    """Write five photographs (5, 6, 7, 3), in the order of LIGHTS."""
    images = np.random.default_rng(0).integers(1000, 60_000, (5, 6, 7, 3)).astype(np.uint16)

    def write(folder: str, names: list[str] = NAMES) -> Path:
        for name, image in zip(names, images, strict=True):
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), image)
        return tmp_path / folder

    return write


def rows(names: list[str] | None = None) -> str:
    lines = [" ".join(map(repr, light)) for light in LIGHTS.tolist()]
    return "\n".join(f"{name} {line}" for name, line in zip(names, lines, strict=True)) if names else "\n".join(lines)


def alice(names: list[Any], **more: Any) -> str:
    lights = [
        {"viewId": name, "type": "directional", "direction": [x, -y, -z], **more}
        for name, (x, y, z) in zip(names, LIGHTS.tolist(), strict=True)
    ]
    return json.dumps({"lights": lights})


def test_one_capture_in_every_form_gives_the_same_normals(write_folder: WriteFolder) -> None:
    numbered = [f"{number}.png" for number in range(1, 6)]

    def make(folder: str, names: list[str], file: str, text: str) -> Path:
        path = write_folder(folder, names)
        (path / file).write_text(text)
        return path

    psbox = write_folder("psbox/Objects", numbered).parent
    (psbox / "light_directions.txt").write_text("\n".join(" ".join(map(repr, row)) for row in LIGHTS.T.tolist()))
    forms = {
        "plain": make("plain", numbered, "light_directions.txt", rows()),
        "uw": make("uw", numbered, "lights.txt", f"5\n{rows()}"),
        "psbox": psbox,
        "lp": make("lp", NAMES, "capture.lp", f"5\n{rows(NAMES)}"),
        "foreign paths": make("foreign", NAMES, "a.lp", "5\n" + rows([f"C:\\RTI\\a vase\\{name}" for name in NAMES])),
        "other suffix": make("suffix", NAMES, "a.LP", "5\n" + rows([f"jpg/{name[:-4].upper()}.jpg" for name in NAMES])),
        "lp by order": make("order", numbered, "a.lp", "5\n" + rows([f"gone{number}.jpg" for number in range(5)])),
        "json": make("json", numbered, "lights.json", alice([1, 2, 3, 4, 5])),
        "json by order": make("json2", numbered, "lights.json", alice([81, 13, 4711, 7, 9])),
        "json with intensities": make("json3", numbered, "lights.json", alice(list("12345"), intensity=[1, 1.0, 1])),
    }
    estimator = make_estimator("ls")
    expected = estimate_normals(read_capture(forms["plain"]), estimator).normal_map
    assert np.ptp(expected) > 0.5
    for form, folder in forms.items():
        capture = read_capture(folder)
        # Bit for bit, signs of zeros included.
        assert estimate_normals(capture, estimator).normal_map.tobytes() == expected.tobytes(), form
        matched = [str(warning) for warning in capture.warnings if warning.code == "lights_matched"]
        assert bool(matched) == (form.startswith("json") or form in ("other suffix", "lp by order"))
        if matched:
            assert matched[0].endswith("by order." if "order" in form else "by name without suffix."), form


def test_images_that_no_light_names_are_left_out(write_folder: WriteFolder) -> None:
    folder = write_folder("dome")
    (folder / "some.lp").write_text("4\n" + rows(NAMES).rpartition("\n")[0])
    assert [path.name for path in open_capture(folder).files.images] == NAMES[:4]


def test_intensities_of_the_json_count_unless_a_file_is_given(write_folder: WriteFolder, tmp_path: Path) -> None:
    folder = write_folder("alice", [f"{number}.png" for number in range(1, 6)])
    (folder / "lights.json").write_text(alice([1, 2, 3, 4, 5], intensity=[2.0, 1.0, 0.5]))
    assert open_capture(folder).light_intensities.tolist() == [[2.0, 1.0, 0.5]] * 5
    file = tmp_path / "intensities.txt"
    file.write_text("3\n3\n3\n3\n3\n")
    assert open_capture(folder, intensities=file).light_intensities.tolist() == [[3.0] * 3] * 5


REFUSED = {
    "a.lp": [
        ("", "the file is empty, expected the number of lights on the first line"),
        ("many\na.png 0 0 1", '1: found "many", expected the number of lights'),
        (f"6\n{rows(NAMES)}", "1: the first line says 6 lights, but 5 lines follow"),
        ("0\n", "1: the file contains no lights"),
        ("1\n0 0 1", '2: found "0 0 1", expected a file name and x y z'),
        ("1\na.png 0 zero 1", '2: found "zero", expected a number'),
        ("1\na.png 0 0 0", "2: found a zero vector, expected a light direction"),
        ("2\na.png 0 0 1\nb.png 0 1 -1", "3: found a light below the horizon (z = -1), expected z > 0"),
        ("2\na.png 0 0 1\nA.PNG 0 1 1", '3: a second light for the image "A.PNG"'),
        ("2\nshot 1.png 0 0 1\nx.png 0 1 1", '3: found 2 lights but 5 images; the image "x.png" is not among them'),
    ],
    "lights.json": [
        ("{", "is not JSON (Expecting property name enclosed in double quotes)"),
        ("[]", 'found no list "lights"'),
        ('{"lights": []}', 'found no list "lights"'),
        ('{"lights": [3]}', "light 1 is not an object"),
        ('{"lights": [{"type": "point", "direction": [0, 0, -1]}]}', "is of type 'point', expected 'directional'"),
        ('{"lights": [{"direction": [0, 0]}]}', "light 1 has 'direction' [0, 0], expected three numbers"),
        ('{"lights": [{"direction": [0, 0, NaN]}]}', "light 1 has 'direction' [0, 0, nan], expected three numbers"),
        ('{"lights": [{}]}', "light 1 has 'direction' None, expected three numbers"),
        ('{"lights": [{"direction": [0, 0, 1]}]}', "found a light below the horizon as light 1 (z = -1)"),
        ('{"lights": [{"direction": [0, 0, -1], "intensity": [1, 0, 1]}]}', "light 1 has the intensity 0"),
        (
            '{"lights": [{"direction": [0, 0, -1], "intensity": [1, 1, 1]}, {"viewId": 2, "direction": [0, 0, -1]}]}',
            "1 of 2 lights have an intensity, expected all or none",
        ),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "message"), [(name, *case) for name, cases in REFUSED.items() for case in cases]
)
def test_refused_files(write_folder: WriteFolder, name: str, text: str, message: str) -> None:
    folder = write_folder("dome")
    (folder / name).write_text(text)
    with pytest.raises(InputError) as refused:
        open_capture(folder)
    assert str(refused.value).startswith(f"{folder / name}:") and message in str(refused.value)


def test_umlauts_of_older_programs_and_images_that_are_not_named(write_folder: WriteFolder) -> None:
    names = ["schräg 1.png", "schräg 2.png", "schräg 3.png", "schräg 4.png", "rest.png"]
    folder = write_folder("umlauts", names)
    lines = rows(names).split("\n")[:4]
    (folder / "capture.lp").write_bytes("\n".join(["4", *lines]).encode("latin-1"))
    source = open_capture(folder)
    assert [path.name for path in source.files.images] == names[:4]
    assert [warning.code for warning in source.warnings] == ["images_left_out"]
    assert "names 4 of the 5 images; the others are left out" in str(source.warnings[0])
