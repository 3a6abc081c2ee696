"""Captures as people have them: names, formats and folders that are not the usual ones, and what is
said of them.

The oracle is a matte sphere: whatever its files are called, the normals are those of its geometry.
"""

import json
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

import scenes
from scenes import codes, to_uint16, write_image
from splinecli.capture import CaptureOptions, Overrides, find_capture_files, open_capture
from splinecli.capture.formats.images import decode_image
from splinecli.capture.light_files import read_light_positions
from splinecli.errors import InputError, UsageError
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import make_estimator
from splinecli.judge.checks import check_capture
from splinecli.lights.calibration.balls import find_ball_files
from splinecli.maths.normals import angle_between_deg
from splinecli.maths.transfer import encode_srgb
from splinecli.recipe import RecipeOptions, prepare_capture

SIZE = 32
LIGHTS = scenes.spiral_lights(12, 40)
NORMALS, DISC = scenes.sphere(SIZE, 0.6)
PICTURES = to_uint16(np.moveaxis(scenes.shade(NORMALS, LIGHTS), -1, 0) * 50_000)
MASK = DISC.astype(np.uint8) * 255


@pytest.fixture
def folder(tmp_path):
    """Return a capture without a mask."""
    return scenes.write_capture(tmp_path / "cat", PICTURES, LIGHTS)


def check(source, mask=DISC):
    """Compare the normals with the geometry, and return the codes of the warnings."""
    capture = prepare_capture(source, options=RecipeOptions(as_stored=True))
    assert mask is None or (capture.mask == mask).all()
    normals = estimate_normals(capture, make_estimator("ls")).normal_map
    inside = capture.mask & DISC
    # 16-bit values as stored, without shadows: least squares is exact to a few thousandths of a
    # degree.
    assert angle_between_deg(normals[inside], NORMALS[inside]).max() < 0.1
    return codes(capture)


@pytest.mark.parametrize(
    "name", ["cat_mask.png", "cat.mask.tif", "mask_1.png", "../cat_mask.png", "../cat.mask.bmp"]
)
def test_masks_by_name(folder, name):
    write_image(folder / name, MASK)
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert str(source.warnings[0]).startswith(
        f"{Path(name).name} is used as the mask. To use another one, pass"
    )
    balls = find_ball_files(folder)
    assert len(balls.images) == 12 and balls.mask == source.files.mask


def test_two_masks_are_named_and_none_is_used(folder):
    write_image(folder / "mask_left.png", MASK)
    write_image(folder / "mask_right.png", MASK)
    write_image(folder / "mask_small.png", MASK[::2, ::2])
    source = open_capture(folder)
    assert check(source, np.ones_like(DISC)) == ["mask_choice"]
    expected = (
        "No mask is used, because several files may be the mask: mask_left.png, mask_right.png."
        " Choose one with --mask FILE."
    )
    assert str(source.warnings[0]) == expected
    assert check(open_capture(folder, CaptureOptions(mask=folder / "mask_left.png"))) == [
        "images_left_out"
    ]


def test_alpha_is_a_mask_if_there_is_no_other(folder):
    for number, image in enumerate(PICTURES):
        write_image(
            folder / f"{number:03}.png", np.dstack([image] * 3 + [MASK.astype(np.uint16) * 257])
        )
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert "The alpha channel of 000.png is used as the mask." in str(source.warnings[0])
    write_image(folder / "mask.png", np.full_like(MASK, 255))
    assert check(open_capture(folder), np.ones_like(DISC)) == []


@pytest.mark.parametrize("listed", [False, True])
def test_images_in_a_folder_of_their_own(folder, listed):
    (folder / "images").mkdir()
    for path in folder.glob("*.png"):
        path.rename(folder / "images" / path.name)
    if listed:
        (folder / "filenames.txt").write_text("".join(f"{number:03}.png\n" for number in range(12)))
    write_image(folder / "cat_mask.png", MASK)
    source = open_capture(folder)
    assert check(source) == ["mask_choice"]
    assert source.files.name == "cat" and len(source.files.images) == 12


def test_bmp_ground_truth(folder):
    write_image(
        folder / "normals_gt.bmp", np.rint((NORMALS[..., ::-1] + 1) * 127.5).astype(np.uint8)
    )
    truth = prepare_capture(open_capture(folder, CaptureOptions(mask=None))).ground_truth
    assert truth is not None and angle_between_deg(truth[DISC], NORMALS[DISC]).max() < 1


def rows(vectors=LIGHTS):
    return vectors.tolist()


def angles(form):
    slant, tilt = np.degrees([np.arccos(LIGHTS[:, 2]), np.arctan2(LIGHTS[:, 1], LIGHTS[:, 0])])
    columns = (tilt, 90 - slant) if form == "azel" else (tilt, slant)
    return "\n".join(f"{first:.9f} {second:.9f}" for first, second in zip(*columns, strict=True))


LINES = "\n".join(" ".join(map(str, row)) for row in rows())
NAMED = "\n".join(f"{number:03}.png {' '.join(map(str, row))}" for number, row in enumerate(rows()))
OPENCV = (
    "%YAML:1.0\nLights: !!opencv-matrix\n   rows: 12\n   cols: 3\n   dt: d\n   data:"
    f" {LIGHTS.ravel().tolist()}\n"
)
XYZ = [dict(zip("xyz", row, strict=True)) for row in rows()]


def alice(names, **more):
    lights = [
        {"viewId": n, "direction": [x, -y, -z], **more}
        for n, (x, y, z) in zip(names, rows(), strict=True)
    ]
    return json.dumps({"lights": lights})


NUMBERS = [f"{number:03}" for number in range(12)]
FOUND = {
    "University of Washington": ("lights.txt", f"12\n{LINES}"),
    "lp": ("dome.lp", f"12\n{NAMED}"),
    "foreign paths": (
        "a.LP",
        "12\n" + re.sub("^", r"C:\\\\RTI\\\\a vase\\\\", NAMED, flags=re.MULTILINE),
    ),
    "by name without suffix": ("a.lp", NAMED.replace(".png", ".JPG")),
    "by order": ("a.lp", "12\n" + re.sub("^", "gone", NAMED, flags=re.MULTILINE)),
    "AliceVision, by name without suffix": ("lights.json", alice(NUMBERS, type="directional")),
    "AliceVision with intensities, by order": (
        "lights.json",
        alice(["47", *NUMBERS[1:]], intensity=[1, 1.0, 1]),
    ),
    "csv": ("lights.csv", "x,y,z\n" + LINES.replace(" ", ",")),
    "csv with names": ("lights.csv", "image,x,y,z\n" + NAMED.replace(" ", ",")),
    "list": ("lights.txt", str(rows())),
    "list of lines": ("lights.txt", str(rows()).replace("],", "],\n")),
    "printed by NumPy": ("lights.txt", str(LIGHTS)),
    "tuples": ("light_directions.txt", "\n".join(str(tuple(row)) for row in rows())),
    "lp without a count": ("dome.lp", NAMED),
    "OpenCV": ("LightMatrix.yml", OPENCV),
    "OpenCV by object": ("cat_LightMatrix.yml", OPENCV),
    "JSON list": ("lights.json", json.dumps(rows())),
    "JSON with a key": ("light_directions.json", json.dumps({"L": rows()})),
    "JSON by name": (
        "lights.json",
        json.dumps({f"{number:03}.png": row for number, row in enumerate(rows())}),
    ),
    "Relight": (
        "a.dome",
        json.dumps({"lightConfiguration": "directional", "directions": XYZ, "positions3d": []}),
    ),
    "Relight with LEDs": (
        "a.dome",
        json.dumps({"directions": XYZ, "ledAdjust": [dict.fromkeys("rgb", 1.0)] * 12}),
    ),
}


@pytest.mark.parametrize("case", FOUND)
def test_light_files(folder, case):
    (folder / "light_directions.txt").unlink()
    name, text = FOUND[case]
    (folder / name).write_text(text)
    source, by = open_capture(folder), case[case.find("by") :]
    matched = case.endswith(("by order", "without suffix"))
    assert check(source, None) == ["lights_matched"] * matched
    assert not matched or str(source.warnings[0]).endswith(f"were matched to the images {by}.")


REFUSED = {
    "a.lp": [
        ("", "the file is empty, expected the number of lights on the first line"),
        ("many\na.png 0 0 1", '1: found "many", expected the number of lights'),
        (f"6\n{NAMED}", "1: the first line states 6 lights, but 12 lines follow"),
        ("0\n", "1: the file contains no lights"),
        ("1\n0 0 1", '2: found "0 0 1", expected a file name and x y z'),
        ("1\na.png 0 zero 1", '2: found "zero", expected a number'),
        ("1\na.png 0 0 0", "2: found a zero vector, expected a light direction"),
        (
            "2\na.png 0 0 1\nb.png 0 1 -1",
            "3: found a light below the horizon (z = -1), expected z > 0",
        ),
        ("2\na.png 0 0 1\nA.PNG 0 1 1", '3: found a second light for the image "A.PNG"'),
        (
            "2\n000.png 0 0 1\nx.png 0 1 1",
            '3: found 2 lights but 12 images, which do not include "x.png"',
        ),
    ],
    "lights.json": [
        ("{", "is not JSON (Expecting property name enclosed in double quotes)"),
        ("[]", 'found no list "lights"'),
        ('{"lights": []}', 'found no list "lights"'),
        ('{"lights": [3]}', "light 1: Expected `object`, got `int`"),
        (
            '{"lights": [{"type": "point", "direction": [0, 0, -1]}]}',
            "light 1: Invalid enum value 'point' - at",
        ),
        (
            '{"lights": [{"direction": [0, 0]}]}',
            "light 1: Expected `array` of length 3, got 2 - at `$.direction`",
        ),
        (
            '{"lights": [{"direction": [0, 0, NaN]}]}',
            "cannot be read as JSON (the number NaN is not finite)",
        ),
        ('{"lights": [{}]}', "light 1: Object missing required field `direction`"),
        (
            '{"lights": [{"direction": [0, 0, 1]}]}',
            "found a light below the horizon as light 1 (z = -1)",
        ),
        (
            '{"lights": [{"direction": [0, 0, -1], "intensity": [1, 0, 1]}]}',
            "`float` > 0.0 - at `$.intensity[1]`",
        ),
        (
            '{"lights": [{"direction": [0, 0, -1], "intensity": [1, 1, 1]},'
            ' {"viewId": 2, "direction": [0, 0, -1]}]}',
            "1 of 2 lights have an intensity, expected all or none",
        ),
    ],
}


@pytest.mark.parametrize(
    "name, text, message", [(name, *case) for name, cases in REFUSED.items() for case in cases]
)
def test_refused_light_files(folder, name, text, message):
    (folder / "light_directions.txt").unlink()
    (folder / name).write_text(text)
    with pytest.raises(InputError) as refused:
        open_capture(folder)
    assert str(refused.value).startswith(f"{folder / name}:") and message in str(refused.value)


def test_intensities_of_the_json_count_unless_a_file_is_given(folder, tmp_path):
    (folder / "light_directions.txt").unlink()
    (folder / "lights.json").write_text(alice(NUMBERS, intensity=[2.0, 1.0, 0.5]))
    assert open_capture(folder).light_intensities.tolist() == [[2.0, 1.0, 0.5]] * 12
    (tmp_path / "intensities.txt").write_text("3\n" * 12)
    assert (
        open_capture(
            folder, CaptureOptions(intensities=tmp_path / "intensities.txt")
        ).light_intensities.tolist()
        == [[3.0] * 3] * 12
    )


def test_umlauts_of_older_programs_and_images_that_are_not_named(folder):
    (folder / "light_directions.txt").unlink()
    for path in folder.glob("*.png"):
        path.rename(folder / f"schräg {path.name}")
    lines = re.sub("^", "schräg ", NAMED, flags=re.MULTILINE).splitlines()[:4]
    (folder / "capture.lp").write_bytes("\n".join(["4", *lines]).encode("latin-1"))
    source = open_capture(folder)
    assert [path.name for path in source.files.images] == [
        f"schräg {number}.png" for number in NUMBERS[:4]
    ]
    assert codes(source) == ["images_left_out"]
    assert "lists 4 of the 12 images; the others were left out" in str(source.warnings[0])


@pytest.mark.parametrize(
    "name, text, hint",
    [
        ("dirs.txt", LINES, r"Add --lights .*cat/dirs\.txt\."),
        (
            "TiltSlant.txt",
            "tilt slant\n" + angles("slant-tilt"),
            r"Add .*Slant\.txt --light-format slant-tilt",
        ),
        ("lamps.csv", angles("azel"), r"Add --lights .*lamps\.csv --light-format azel"),
    ],
)
def test_light_files_that_are_named(folder, name, text, hint):
    """The option of the message reads the file."""
    (folder / "light_directions.txt").unlink()
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=hint) as refused:
        open_capture(folder)
    _, lights, *form = str(refused.value.hint).removeprefix("Add ").split()
    options = {"light_format": form[1]} if form else {}
    assert check(open_capture(folder, CaptureOptions(lights=lights, **options)), None) == []


def test_files_too_long_for_the_lights_are_not_read_for_a_hint(folder):
    """Fifty of 0.9 MB took a minute and more."""
    (folder / "light_directions.txt").unlink()
    (folder / "dirs.txt").write_text(LINES + "\n# notes" * 5000)
    with pytest.raises(InputError, match="Pass --lights FILE"):
        open_capture(folder)


def test_a_dome_has_positions(folder):
    lamps = LIGHTS * 300 + (0, 0, 20)
    positions = [dict(zip("xyz", row, strict=True)) for row in rows(lamps)]
    dome = {
        "lightConfiguration": "spherical",
        "directions": XYZ,
        "positionsSphere": positions,
        "positions3d": XYZ,
    }
    (folder / "a.dome").write_text(json.dumps(dome))
    np.testing.assert_allclose(read_light_positions(folder / "a.dome", 12), lamps, rtol=1e-12)
    (folder / "a.dome").write_text(json.dumps({"directions": XYZ}))
    with pytest.raises(InputError, match=r"found no list of positions3d or .*, expected a dome"):
        read_light_positions(folder / "a.dome", 12)


@pytest.mark.parametrize("vector", ["0.1 0.2 -0.1", "0 0 0"])
def test_one_bad_light_is_left_out(folder, vector):
    lines = LINES.splitlines()
    lines[4] = vector
    (folder / "light_directions.txt").write_text("\n".join(lines))
    source = open_capture(folder)
    assert check(source, None) == ["images_left_out"]
    assert str(source.warnings[0]).startswith("004.png (z = ") and source.n_lights == 11
    assert source.places_of([0, 3, 5, 11]) == [0, 3, 4, 10]
    with pytest.raises(UsageError, match=r"light 4 was left out"):
        source.places_of([0, 1, 4])
    (folder / "light_directions.txt").write_text("\n".join([*lines[:-1], vector]))
    assert "2 of 12 images were left out" in str(open_capture(folder).warnings[0])
    (folder / "light_directions.txt").write_text("\n".join([*lines[:5], *[vector] * 7]))
    with pytest.raises(InputError, match=":5: found a"):
        open_capture(folder)


def test_copies_are_one_photograph(folder):
    for number, image in enumerate(PICTURES):
        write_image(folder / f"{number:03}.jpg", (image >> 8).astype(np.uint8))
    source = open_capture(folder)
    assert check(source, None) == ["images_left_out"]
    assert str(source.warnings[0]).startswith(
        "12 files (.jpg) were left out, because images with the same names (.png)"
    )


def test_pictures_of_results_are_left_out_where_the_count_says_so(folder):
    for name in ("demo.png", "result_1.png", "result_2.png"):
        write_image(folder / name, PICTURES[0])
    source = open_capture(folder)
    assert check(source, None) == ["images_left_out"]
    assert "no light for them, and the other images have another form of name" in str(
        source.warnings[0]
    )
    assert len(find_capture_files(folder, Overrides(needs_lights=False)).images) == 12
    for number in (12, 13):
        write_image(folder / f"{number:03}.png", PICTURES[0])
    with pytest.raises(
        InputError, match=r"found 12 light directions, expected 17.* it has none for 012\.png"
    ):
        open_capture(folder)


def write_pnm(path, image, most):
    path.with_suffix(".pgm").write_bytes(
        b"P5 # camera\n%d %d\n%d\n" % (*image.shape[::-1], most) + image.astype(">u2").tobytes()
    )


def write_stack(folder):
    tifffile.imwrite(folder / "stack.tif", PICTURES, photometric="minisblack")


WRITERS = {
    "16-bit PGM": lambda folder: [
        write_pnm(folder / f"{n}", PICTURES[n], 65535) for n in range(12)
    ],
    "12-bit PGM": lambda folder: [
        write_pnm(folder / f"{n}", PICTURES[n] >> 4, 4095) for n in range(12)
    ],
    "PPM": lambda folder: [
        write_image(folder / f"{n}.ppm", np.dstack([PICTURES[n]] * 3)) for n in range(12)
    ],
    "stack": write_stack,
    # OpenCV's TIFF is LZW
    "LZW stack": lambda folder: cv2.imwritemulti(str(folder / "stack.tif"), list(PICTURES)),
}


@pytest.mark.parametrize("form", WRITERS)
def test_images_of_other_formats(folder, form):
    for path in folder.glob("*.png"):
        path.unlink()
    WRITERS[form](folder)
    write_image(folder.parent / "mask.png", MASK)
    source = open_capture(folder, CaptureOptions(mask=folder.parent / "mask.png"))
    assert source.n_lights == 12
    check(source)
    if form == "12-bit PGM":
        assert source.facts[0].white_level == 4095
    if form in ("stack", "LZW stack"):
        assert source.files.images[3].name == "stack.tif[3]"
        assert not check_capture(source, prepare_capture(source)).warnings


@pytest.mark.parametrize("suffix", [".webp", ".avif", ".heic"])
def test_display_encoded_formats(folder, suffix):
    """An 8-bit photograph with the sRGB curve, stored with little or no loss."""
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    for number, image in enumerate(encode_srgb(PICTURES / 65535)):
        (folder / f"{number:03}.png").unlink()
        options = {"lossless": True} if suffix == ".webp" else {"quality": 100}
        Image.fromarray(np.dstack([image] * 3)).save(folder / f"{number:03}{suffix}", **options)
    write_image(folder.parent / "mask.png", MASK)
    capture = prepare_capture(
        open_capture(folder, CaptureOptions(mask=folder.parent / "mask.png")),
        options=RecipeOptions(as_stored=True),
    )
    assert "display_decoded" in codes(capture)
    normals = estimate_normals(capture, make_estimator("ls")).normal_map
    # Steps of 8 bits are half a percent of the brightness.
    assert angle_between_deg(normals[DISC], NORMALS[DISC]).mean() < 0.5


def test_formats_that_need_an_extra_or_are_not_read(folder, monkeypatch):
    for path in folder.glob("*.png"):
        path.rename(path.with_suffix(".heic"))
        path.with_suffix(".heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0" + bytes(64))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"000\.heic: .*pip install 'splinecli\[heif\]'"):
        prepare_capture(open_capture(folder))
    for path in folder.glob("*.heic"):
        path.rename(path.with_suffix(".jxl"))
    with pytest.raises(InputError, match=r"no images, but 12 \.jxl files, 1 \.txt file\. Images"):
        open_capture(folder)
    (folder / "a.pgm").write_bytes(b"P5 40 30 255\n" + bytes(100))
    with pytest.raises(InputError, match="the PGM is truncated"):
        decode_image(folder / "a.pgm")
