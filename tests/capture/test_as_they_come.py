"""Captures as people have them: names, formats and folders that are not the usual ones, and what is
said of them.
"""

import json
import re
import sys

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from capture.conftest import (
    DISC,
    LIGHTS,
    LINES,
    LP,
    MASK,
    NAMED,
    NORMALS,
    PICTURES,
    ROWS,
    check,
    normals_by_ls,
    xyz,
)
from scenes import codes, parametrize, put, refuses, write_image
from splinecli.capture import CaptureOptions, Overrides, find_capture_files, open_capture
from splinecli.capture.formats.images import decode_image
from splinecli.capture.light_files import read_light_positions
from splinecli.errors import UsageError
from splinecli.judge.checks import check_capture
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.transfer import encode_srgb
from splinecli.recipe import prepare_capture


def test_alpha_is_a_mask_if_there_is_no_other(folder):
    for number, image in enumerate(PICTURES):
        write_image(folder / f"{number:03}.png", np.dstack([image] * 3 + [np.uint16(MASK) * 257]))
    source = open_capture(folder)
    assert check(source, DISC) == ["mask_choice"]
    assert "The alpha channel of 000.png is used as the mask." in str(source.warnings[0])
    write_image(folder / "mask.png", np.full_like(MASK, 255))
    assert check(open_capture(folder), np.ones_like(DISC)) == []


@parametrize("listed", [False, True])
def test_images_in_a_folder_of_their_own(folder, listed):
    (folder / "images").mkdir()
    for path in folder.glob("*.png"):
        path.rename(folder / "images" / path.name)
    if listed:
        put(folder / "filenames.txt", "".join(f"{number:03}.png\n" for number in range(12)))
    write_image(folder / "owl_mask.png", MASK)
    source = open_capture(folder)
    assert check(source, DISC) == ["mask_choice"]
    assert source.files.name == "owl" and len(source.files.images) == 12


def test_bmp_ground_truth(folder):
    write_image(folder / "normals_gt.bmp", np.uint8(np.rint((NORMALS[..., ::-1] + 1) * 127.5)))
    truth = prepare_capture(open_capture(folder, CaptureOptions(mask=None))).ground_truth
    assert truth is not None and angle_between_deg(truth[DISC], NORMALS[DISC]).max() < 1


def angles(form):
    slant, tilt = np.degrees([np.arccos(LIGHTS[:, 2]), np.arctan2(LIGHTS[:, 1], LIGHTS[:, 0])])
    columns = (tilt, 90 - slant) if form == "azel" else (tilt, slant)
    return "\n".join(f"{first:.9f} {second:.9f}" for first, second in zip(*columns, strict=True))


XYZ = [xyz(row) for row in ROWS]
OPENCV = (
    "%YAML:1.0\nLights: !!opencv-matrix\n   rows: 12\n   cols: 3\n   dt: d\n   data:"
    f" {LIGHTS.ravel().tolist()}\n"
)


def alice(names, **more):
    lights = [
        {"viewId": n, "direction": [x, -y, -z], **more}
        for n, (x, y, z) in zip(names, ROWS, strict=True)
    ]
    return json.dumps({"lights": lights})


NUMBERS = [name.removesuffix(".png") for name, _ in NAMED]
FOUND = {
    "lp": ("dome.lp", f"12\n{LP}"),
    "foreign paths": ("a.LP", "12\n" + re.sub("(?m)^", r"C:\\\\RTI\\\\a vase\\\\", LP)),
    "by name without suffix": ("a.lp", LP.replace(".png", ".JPG")),
    "by order": ("a.lp", "12\n" + re.sub("(?m)^", "gone", LP)),
    "AliceVision, by name without suffix": ("lights.json", alice(NUMBERS, type="directional")),
    "AliceVision with intensities, by order": (
        "lights.json",
        alice(["47", *NUMBERS[1:]], intensity=[1, 1.0, 1]),
    ),
    "csv with names": ("lights.csv", "image,x,y,z\n" + LP.replace(" ", ",")),
    "list": ("lights.txt", str(ROWS)),
    "printed by NumPy": ("lights.txt", str(LIGHTS)),
    "tuples": ("light_directions.txt", "\n".join(str(tuple(row)) for row in ROWS)),
    "lp without a count": ("dome.lp", LP),
    "OpenCV": ("LightMatrix.yml", OPENCV),
    "OpenCV by object": ("owl_LightMatrix.yml", OPENCV),
    "JSON list": ("lights.json", json.dumps(ROWS)),
    "JSON with a key": ("light_directions.json", json.dumps({"L": ROWS})),
    "JSON by name": ("lights.json", json.dumps(dict(NAMED))),
    "Relight": (
        "a.dome",
        json.dumps({"lightConfiguration": "directional", "directions": XYZ, "positions3d": []}),
    ),
    "Relight with LEDs": (
        "a.dome",
        json.dumps({"directions": XYZ, "ledAdjust": [dict.fromkeys("rgb", 1.0)] * 12}),
    ),
}


@parametrize("case", FOUND)
def test_light_files(unlit, case):
    name, text = FOUND[case]
    put(unlit / name, text)
    source, by = open_capture(unlit), case[case.find("by") :]
    matched = case.endswith(("by order", "without suffix"))
    assert check(source) == ["lights_matched"] * matched
    assert not matched or str(source.warnings[0]).endswith(f"were matched to the images {by}.")


REFUSED = r"""
a.lp | | the file is empty, expected the number of lights on the first line
a.lp | many\na.png 0 0 1 | 1: found "many", expected the number of lights
a.lp | 6\na.png 0 0 1\nb.png 0 0 1 | 1: the first line states 6 lights, but 2 lines follow
a.lp | 0\n | 1: the file contains no lights
a.lp | 1\n0 0 1 | 2: found "0 0 1", expected a file name and x y z
a.lp | 1\na.png 0 zero 1 | 2: found "zero", expected a number
a.lp | 1\na.png 0 0 0 | 2: found a zero vector, expected a light direction
a.lp | 2\na.png 0 0 1\nb.png 0 1 -1 | 3: found a light below the horizon (z = -1), expected z > 0
a.lp | 2\na.png 0 0 1\nA.PNG 0 1 1 | 3: found a second light for the image "A.PNG"
a.lp | 2\n000.png 0 0 1\nx.png 0 1 1 | 3: found 2 lights but 12 images, which do not include "x.png"
lights.json | { | is not JSON (Expecting property name enclosed in double quotes)
lights.json | [] | found no list "lights"
lights.json | {"lights": []} | found no list "lights"
lights.json | {"lights": [3]} | light 1: Expected `object`, got `int`
lights.json | {"lights": [{"type": "point", "direction": [0, 0, 1]}]} | Invalid enum value 'point'
lights.json | {"lights": [{"direction": [0, 0]}]} | of length 3, got 2 - at `$.direction`
lights.json | {"lights": [{"direction": [0, 0, NaN]}]} | as JSON (the number NaN is not finite)
lights.json | {"lights": [{}]} | light 1: Object missing required field `direction`
lights.json | {"lights": [{"direction": [0, 0, 1]}]} | below the horizon as light 1 (z = -1)
lights.json | {"lights": [{"direction": [0, 0, -1], "intensity": [1, 0, 1]}]} | at `$.intensity[1]`
"""


@parametrize("name, text, message", REFUSED)
def test_refused_light_files(unlit, name, text, message):
    put(unlit / name, text)
    with refuses(re.escape(message)) as refused:
        open_capture(unlit)
    assert str(refused.value).startswith(f"{unlit / name}:")


def test_intensities_of_the_json_count_unless_a_file_is_given(unlit, tmp_path):
    put(unlit / "lights.json", alice(NUMBERS, intensity=[2.0, 1.0, 0.5]))
    assert open_capture(unlit).light_intensities.tolist() == [[2.0, 1.0, 0.5]] * 12
    given = CaptureOptions(intensities=put(tmp_path / "intensities.txt", "3\n" * 12))
    assert open_capture(unlit, given).light_intensities.tolist() == [[3.0] * 3] * 12
    one, other = ({"direction": [0, 0, -1]} | more for more in ({"intensity": [1, 1, 1]}, {}))
    put(unlit / "lights.json", json.dumps({"lights": [one, other]}))
    with refuses("1 of 2 lights have an intensity, expected all or none"):
        open_capture(unlit)


def test_umlauts_of_older_programs_and_images_that_are_not_named(unlit):
    for path in unlit.glob("*.png"):
        path.rename(unlit / f"schräg {path.name}")
    lines = re.sub("(?m)^", "schräg ", LP).splitlines()[:4]
    put(unlit / "capture.lp", "\n".join(["4", *lines]), "latin-1")
    source = open_capture(unlit)
    assert [path.name for path in source.files.images] == [
        f"schräg {number}.png" for number in NUMBERS[:4]
    ]
    assert codes(source) == ["images_left_out"]
    assert "lists 4 of the 12 images; the others were left out" in str(source.warnings[0])


@parametrize(
    "name, text, hint",
    [
        ("dirs.txt", LINES, r"Add --lights .*owl/dirs\.txt\."),
        (
            "TiltSlant.txt",
            "tilt slant\n" + angles("slant-tilt"),
            r"Add .*Slant\.txt --light-format slant-tilt",
        ),
        ("lamps.csv", angles("azel"), r"Add --lights .*lamps\.csv --light-format azel"),
    ],
)
def test_light_files_that_are_named(unlit, name, text, hint):
    """The option of the message reads the file."""
    put(unlit / name, text)
    with refuses(hint) as refused:
        open_capture(unlit)
    _, lights, *form = str(refused.value.hint).removeprefix("Add ").split()
    options = {"light_format": form[1]} if form else {}
    assert check(open_capture(unlit, CaptureOptions(lights=lights, **options))) == []


def test_files_too_long_for_the_lights_are_not_read_for_a_hint(unlit):
    """Fifty of 0.9 MB took a minute and more."""
    put(unlit / "dirs.txt", LINES + "\n# notes" * 5000)
    with refuses("Pass --lights FILE"):
        open_capture(unlit)


def test_a_dome_has_positions(folder):
    lamps = LIGHTS * 300 + (0, 0, 20)
    positions = [xyz(row) for row in lamps.tolist()]
    dome = {
        "lightConfiguration": "spherical",
        "directions": XYZ,
        "positionsSphere": positions,
        "positions3d": XYZ,
    }
    put(folder / "a.dome", json.dumps(dome))
    np.testing.assert_allclose(read_light_positions(folder / "a.dome", 12), lamps, rtol=1e-12)
    put(folder / "a.dome", json.dumps({"directions": XYZ}))
    with refuses(r"found no list of positions3d or .*, expected a dome"):
        read_light_positions(folder / "a.dome", 12)


@parametrize("vector", ["0.1 0.2 -0.1", "0 0 0"])
def test_one_bad_light_is_left_out(folder, vector):
    lines = LINES.splitlines()
    lines[4] = vector
    put(folder / "light_directions.txt", "\n".join(lines))
    source = open_capture(folder)
    assert check(source) == ["images_left_out"]
    assert str(source.warnings[0]).startswith("004.png (z = ") and source.n_lights == 11
    assert source.places_of([0, 3, 5, 11]) == [0, 3, 4, 10]
    with refuses(r"light 4 cannot be chosen, because it was left out", UsageError):
        source.places_of([0, 1, 4])
    put(folder / "light_directions.txt", "\n".join([*lines[:-1], vector]))
    assert "2 of 12 images were left out" in str(open_capture(folder).warnings[0])
    put(folder / "light_directions.txt", "\n".join([*lines[:5], *[vector] * 7]))
    with refuses(":5: found a"):
        open_capture(folder)


def test_copies_are_one_photograph(folder):
    for number, image in enumerate(PICTURES):
        write_image(folder / f"{number:03}.jpg", np.uint8(image >> 8))
    source = open_capture(folder)
    assert check(source) == ["images_left_out"]
    assert str(source.warnings[0]).startswith(
        "12 files (.jpg) were left out, because images with the same names (.png)"
    )


def test_pictures_of_results_are_left_out_where_the_count_says_so(folder):
    for name in ("demo.png", "result_1.png", "result_2.png"):
        write_image(folder / name, PICTURES[0])
    source = open_capture(folder)
    assert check(source) == ["images_left_out"]
    assert "no light for them, and the other images have another form of name" in str(
        source.warnings[0]
    )
    assert len(find_capture_files(folder, Overrides(needs_lights=False)).images) == 12
    for number in (12, 13):
        write_image(folder / f"{number:03}.png", PICTURES[0])
    with refuses(r"found 12 light directions, expected 17.* there is no light for 012\.png"):
        open_capture(folder)


def write_pnm(folder, shift, most):
    for number, image in enumerate(PICTURES >> shift):
        (folder / f"{number}.pgm").write_bytes(
            b"P5 # camera\n32 32\n%d\n" % most + image.astype(">u2").tobytes()
        )


WRITERS = {
    "16-bit PGM": lambda folder: write_pnm(folder, 0, 65535),
    "12-bit PGM": lambda folder: write_pnm(folder, 4, 4095),
    "PPM": lambda folder: [
        write_image(folder / f"{n}.ppm", np.dstack([PICTURES[n]] * 3)) for n in range(12)
    ],
    "stack": lambda folder: tifffile.imwrite(
        folder / "stack.tif", PICTURES, photometric="minisblack"
    ),
    # OpenCV's TIFF is LZW
    "LZW stack": lambda folder: cv2.imwritemulti(str(folder / "stack.tif"), list(PICTURES)),
}


@parametrize("form", WRITERS)
def test_images_of_other_formats(folder, form):
    for path in folder.glob("*.png"):
        path.unlink()
    WRITERS[form](folder)
    mask = write_image(folder.parent / "mask.png", MASK)
    source = open_capture(folder, CaptureOptions(mask=mask))
    assert source.n_lights == 12
    check(source, DISC)
    if form == "12-bit PGM":
        assert source.facts[0].white_level == 4095
    if "stack" in form:
        assert source.files.images[3].name == "stack.tif[3]"
        assert not check_capture(source, prepare_capture(source)).warnings


@parametrize("suffix", ".webp .avif .heic")
def test_display_encoded_formats(folder, suffix):
    """An 8-bit photograph with the sRGB curve, stored with little or no loss."""
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    for number, image in enumerate(encode_srgb(PICTURES / 65535)):
        (folder / f"{number:03}.png").unlink()
        options = {"lossless": True} if suffix == ".webp" else {"quality": 100}
        Image.fromarray(np.dstack([image] * 3)).save(folder / f"{number:03}{suffix}", **options)
    mask = write_image(folder.parent / "mask.png", MASK)
    capture, normals = normals_by_ls(open_capture(folder, CaptureOptions(mask=mask)))
    assert "display_decoded" in codes(capture)
    # Steps of 8 bits are half a percent of the brightness.
    assert angle_between_deg(normals[DISC], NORMALS[DISC]).mean() < 0.5


def test_formats_that_need_an_extra_or_are_not_read(folder, monkeypatch):
    for path in folder.glob("*.png"):
        path.rename(path.with_suffix(".heic"))
        path.with_suffix(".heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0" + bytes(64))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with refuses(r"000\.heic: .*pip install 'splinecli\[heif\]'"):
        prepare_capture(open_capture(folder))
    for path in folder.glob("*.heic"):
        path.rename(path.with_suffix(".jxl"))
    with refuses(r"no images, but 12 \.jxl files, 1 \.txt file\. Images"):
        open_capture(folder)
    (folder / "a.pgm").write_bytes(b"P5 40 30 255\n" + bytes(100))
    with refuses("the PGM is truncated"):
        decode_image(folder / "a.pgm")
