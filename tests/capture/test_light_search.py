"""Lights where people keep them: in other folders, in .mat and JSON files, in names of images."""

import json

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import savemat

import scenes
from capture.conftest import (
    DISC,
    LIGHTS,
    LINES,
    LP,
    MASK,
    NAMED,
    NORMALS,
    PICTURES,
    check,
    pictures,
    xyz,
)
from scenes import codes, parametrize, pinhole, put, refuses, write_image
from splinecli.capture import CaptureOptions, find_captures, open_capture
from splinecli.capture.light_search import NoLightsError
from splinecli.capture.lights_in_names import lights_in_names
from splinecli.errors import InputError
from splinecli.maths.normals import unit
from splinecli.recipe import prepare_capture


def checked(folder):
    """The source of a capture whose normals are right, and its warnings."""
    source = open_capture(folder)
    return source, check(source)


PLACES = {
    "Lights/lights.csv": LINES.replace(" ", ","),
    "lighting/anything.txt": LINES,
    "../Lights/lights.txt": LINES,
    "../lights.txt": LINES,
    "../owl.lp": LP,
    "light_dir.txt": LINES,
    "data.json": json.dumps([{"file": name, "light_dir": row} for name, row in NAMED]),
}


@parametrize("of_images", ["", "images"])
@parametrize("name", PLACES)
def test_light_files_in_other_places(tmp_path, name, of_images):
    folder = tmp_path / "all/owl"
    scenes.write_capture(folder / of_images, PICTURES, None)
    put(folder / name, PLACES[name])
    put(tmp_path / "all/cat.lp", LP.replace("0.0", "0.9"))
    (tmp_path / "all/cat").mkdir()  # which owns the other file
    source, found = checked(folder)
    assert found == ["lights_found"] and source.files.name == "owl"
    assert str((folder / name).resolve()) in str(source.warnings[0])
    assert find_captures(folder) == [folder]


def test_lights_among_the_images_of_a_folder_inside(tmp_path):
    scenes.write_capture(tmp_path / "images", PICTURES, LIGHTS)
    assert check(open_capture(tmp_path)) == ["lights_found"]


def test_a_folder_of_images_beside_the_lights(tmp_path):
    scenes.write_capture(tmp_path / "owl/Images", PICTURES, None, mask=DISC)
    put(tmp_path / "owl/Lights/lights.txt", LINES)
    for folder in (tmp_path / "owl", tmp_path / "owl/Images"):
        source, found = checked(folder)
        assert found == ["lights_found"]
        assert source.name == "owl"
        assert (source.read_mask(DISC.shape) == DISC).all()


def test_files_that_do_not_fit_or_differ(tmp_path):
    folder = scenes.write_capture(tmp_path / "all/owl", PICTURES, None)
    put(tmp_path / "all/lights.txt", LINES + "\n0 0 1")
    with refuses(r"found 12 images \(000.png, .* Pass --lights FILE"):
        open_capture(folder)
    put(folder / "Lights/a.txt", LINES)
    put(folder / "Lights/b.txt", LINES)
    assert check(open_capture(folder)) == ["lights_found"]
    put(folder / "Lights/b.txt", "\n".join(LINES.splitlines()[::-1]))
    with refuses(r"2 files that fit the images: a\.txt, b\.txt"):
        open_capture(folder)


@pytest.mark.parametrize("name", ["Lights/light_directions.txt", "my_lights.txt", "cat_lights.csv"])
@pytest.mark.parametrize(
    ("text", "says"), [("1 a 2\n", "expected a number"), (LINES[: LINES.rindex("\n")], "found 11")]
)
def test_nothing_is_estimated_beside_wrong_lights(tmp_path, name, text, says):
    scenes.write_capture(tmp_path, pictures(), None)
    put(tmp_path / name, text)
    with refuses(says) as error:
        open_capture(tmp_path)
    assert error.value.path == tmp_path / name
    assert not isinstance(error.value, NoLightsError)


def test_other_tables_in_the_folder_above(tmp_path):
    scenes.write_capture(tmp_path / "owl", pictures(), None)
    put(tmp_path / "outside.csv", PLACES["Lights/lights.csv"])
    with pytest.raises(NoLightsError):
        open_capture(tmp_path / "owl")


def test_a_picture_of_another_size_is_left_out_without_lights(tmp_path):
    scenes.write_capture(tmp_path, pictures(), None)
    write_image(tmp_path / "Thumbs.png", pictures()[0][:9, :9])
    source = open_capture(tmp_path, CaptureOptions(needs_lights=False))
    assert source.n_lights == len(pictures()) and "images_left_out" in codes(source)


def test_ways_out_that_work(tmp_path):
    scenes.write_capture(tmp_path / "owl/photos", pictures(), None)
    with refuses(r"no images\. Pass .*, such as .*photos\."):
        open_capture(tmp_path / "owl")
    scenes.write_capture(tmp_path / "one", pictures()[:1], None)
    for rows, named in (("0 0 1\n", False), ("0 0 1\n0.5 0 1\n0 0.5 1\n", True)):
        put(tmp_path / "one/output.txt", rows)
        with pytest.raises(InputError) as error:
            open_capture(tmp_path / "one")
        assert ("output.txt" in str(error.value)) is named


OBJECTS = {
    "file and light_dir": [{"file": name, "light_dir": row} for name, row in NAMED],
    "in a list of images": {
        "version": 1,
        "images": [{"filename": name, "light": xyz(row)} for name, row in NAMED],
    },
    "with positions, too": [
        {"image": f"C:\\rti\\{name}", "light_dir": row, "light_position": [1, 2, 3]}
        for name, row in NAMED
    ],
    "by name": {name: {"direction": row, "exposure": 0.1} for name, row in NAMED},
    "x, y and z": {"lights": [{"path": name, **xyz(row)} for name, row in NAMED]},
    "angles": [
        {
            "name": name,
            "azimuth": np.degrees(np.arctan2(y, x)),
            "elevation": np.degrees(np.arcsin(z)),
        }
        for name, (x, y, z) in NAMED
    ],
}


@parametrize("case", OBJECTS)
def test_json_objects(tmp_path, case):
    folder = scenes.write_capture(tmp_path, PICTURES, None)
    put(folder / "lights.json", json.dumps(OBJECTS[case]))
    assert check(open_capture(folder)) == []
    for damaged in ([{"file": 1}], [{"file": "a"}, 3], [{"light_dir": [1]}], {"a": {"b": {}}}):
        put(folder / "lights.json", json.dumps(damaged))
        with refuses('found no list "lights"'):
            open_capture(folder)


IMAGES = np.moveaxis(PICTURES, 0, -1)
MAT = {
    "I, L, mask": {"I": IMAGES, "L": LIGHTS, "mask": MASK},
    "I, S, M": {"I": IMAGES / 65535, "S": LIGHTS.T, "M": DISC.astype(float)},
    "colour": {"images": np.repeat(IMAGES[:, :, None], 3, axis=2), "lights": LIGHTS, "mask": DISC},
    "as NumPy has it": {"imgs": PICTURES, "light_directions": LIGHTS, "mask": DISC},
    "with normals": {"I": IMAGES, "S": LIGHTS, "N": NORMALS, "mask": DISC},
    "numbered": {
        "mask": DISC,
        **{f"im{number}": picture for number, picture in enumerate(PICTURES)},
        **{f"l{number}": light[None] for number, light in enumerate(LIGHTS)},
    },
}


@parametrize("compressed", [False, True])
@parametrize("case", MAT)
def test_mat_files(tmp_path, case, compressed):
    savemat(tmp_path / "owl.mat", MAT[case], do_compression=compressed)
    source, found = checked(tmp_path)
    assert found == [] and source.n_lights == 12 and source.files.images[2].name == "owl.mat[2]"
    assert (source.read_mask(DISC.shape) == DISC).all()
    stamp = source.stamp
    savemat(tmp_path / "owl.mat", {**MAT[case], "x": 1})
    assert open_capture(tmp_path).stamp != stamp


def test_mat_files_that_are_not_read(tmp_path):
    put(tmp_path / "a.mat", "MATLAB 7.3 MAT-file" + 300 * " ")
    with refuses(r"a\.mat: found a MATLAB 7\.3 file, .* -v7\."):
        open_capture(tmp_path)
    savemat(tmp_path / "a.mat", {"I": np.zeros((4, 5), object)})
    with refuses(r"no images, but 1 \.mat file\. .* numeric array H x W x"):
        open_capture(tmp_path)
    for name in "ab":
        savemat(tmp_path / f"{name}.mat", MAT["I, L, mask"])
    with refuses(r"2 \.mat files with photographs \(a\.mat, b\.mat\)"):
        open_capture(tmp_path)


def yale(azimuth, elevation):
    azimuth, elevation = np.radians((azimuth, elevation))
    level = np.cos(elevation)
    return -level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)


AT_45 = {"left": (-1, 0, 1), "right": (1, 0, 1), "top": (0, 1, 1), "bottom": (0, -1, 1)}
IN_NAMES = {
    "Yale": {f"B01_P00A{a:+04}E{e:+03}": yale(a, e) for a in (-35, 0, 35) for e in (-20, 0, 40)},
    "x and y": {f"a_{x}_{y}": (x, y, 1) for x in (-0.7, 0.0, 0.5) for y in (-0.5, 0.0, 0.75)},
    "unit vectors": {
        f"x{x}_y{y}": (x, y, np.sqrt(1 - x * x - y * y)) for x in (-0.5, 0.3) for y in (-0.2, 0.4)
    },
    "vectors": {f"owl {x:.6f},{y:.6f},{z:.6f}": (x, y, z) for x, y, z in LIGHTS.tolist()},
    "angles": {
        f"az{azimuth}_el50": scenes.directions_at(np.radians([azimuth]), np.radians(40))[0]
        for azimuth in range(0, 360, 45)
    },
    "sides": {f"{n}_brick_{side}": light for n, (side, light) in enumerate(AT_45.items())},
    "corners": {
        **{f"Light{side.title()}": light for side, light in AT_45.items()},
        "LightTopLeft": (-1, 1, np.sqrt(2)),
        "LightFront": (0, 0, 1),
    },
}


@parametrize("case", IN_NAMES)
def test_lights_in_names(tmp_path, case):
    lights = unit(np.array([*IN_NAMES[case].values()], np.float64))
    for name, picture in zip(IN_NAMES[case], pictures(lights), strict=True):
        write_image(tmp_path / f"{name}.png", picture)
    write_image(tmp_path / "owl_mask.pgm", MASK)
    source, found = checked(tmp_path)
    assert found == ["lights_found", "mask_choice"]
    assert "were read from the names of the images: " in str(source.warnings[0])
    put(tmp_path / "lights.lp", "\n".join(f"{name} 0 0 1" for name in IN_NAMES[case]))
    assert (open_capture(tmp_path).light_directions == (0, 0, 1)).all()  # a file takes precedence


@parametrize(
    "names", ["a_1_2 a_3_4 a_5_6", "left right top owl cat", "left_a right_b top_c", "a-1_1 a-1_2"]
)
def test_names_without_lights(tmp_path, names):
    assert lights_in_names([tmp_path / f"{name}.png" for name in names.split()]) is None


def test_lights_behind_the_image_plane_are_left_out(tmp_path):
    """Fifteen of the 64 lights of Yale B are at 90 degrees or more from the camera axis."""
    angles = [(azimuth, 20) for azimuth in (-130, -110, -90, -60, -30, 0, 30, 60, 90, 110, 130)]
    for azimuth, elevation in (*angles, (0, 40)):
        light = np.array(yale(azimuth, elevation))
        write_image(tmp_path / f"A{azimuth:+04}E{elevation:+03}.png", pictures(light[None])[0])
    write_image(tmp_path / "P00_Ambient.png", np.zeros((32, 32), np.uint16))
    source = open_capture(tmp_path)
    assert codes(source) == ["images_left_out", "lights_found", "ambient_subtracted"]
    assert "...: 6 of 12 images were left out, because their lights" in str(source.warnings[0])
    assert source.files.ambient == tmp_path / "P00_Ambient.png" and source.n_lights == 6


def test_near_ps(tmp_path):
    """Lamps of near_ps are the same as those in light_positions.txt and light_lobes.txt."""
    folder = scenes.write_bump(tmp_path / "bump")
    (width, focal, distance), (u, v) = (2.0, 600.0, 1200.0), (15.0, 17.0)
    matrix = pinhole(focal, u, v)
    np.savetxt(folder / "light_positions.txt", scenes.BUMP_LAMPS)
    axes = unit(-scenes.BUMP_LAMPS)
    np.savetxt(folder / "light_lobes.txt", np.column_stack((axes, np.full(len(axes), 1.5))))
    np.savetxt(folder / "camera_matrix.txt", matrix)
    put(folder / "pixel_size.txt", str(width))
    np.savetxt(folder / "light_intensities.txt", np.linspace(1, 2, len(axes)))
    expected = prepare_capture(open_capture(folder)).lamps
    for path in folder.glob("*.txt"):
        path.unlink()
    # The rule of docs/light-files.md, the other way round
    middle = distance * (np.array((15.5, 15.5)) - (u, v)) / focal
    x, y, z = scenes.BUMP_LAMPS.T
    positions = np.stack((x + middle[0], middle[1] - y, distance - z), axis=1)
    squares = np.square(scenes.BUMP_LAMPS).sum(axis=1, keepdims=True)
    lamps = {
        "S": positions,
        "Dir": axes * (1, -1, -1),
        "mu": np.full((len(axes), 1), 1.5),
        "Phi": np.linspace(1, 2, len(axes))[:, None] * squares,  # on the axes
    }
    savemat(folder / "light.mat", lamps)
    savemat(folder / "camera.mat", {"K": matrix})
    with refuses(r"light\.mat: the scale .* Add --pixel-size: the"):
        open_capture(folder)
    put(folder / "pixel_size.txt", str(width))
    source = open_capture(folder)
    assert_allclose(source.light_intensities[:, 0], np.linspace(1, 2, len(axes)))
    found = prepare_capture(source).lamps
    assert expected is not None and found is not None
    for name in ("positions", "lobes", "reference_distances", "camera_matrix"):
        assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
    (folder / "camera.mat").unlink()
    with refuses(r"relative to the camera, .* Add --camera-matrix and"):
        open_capture(folder)


def test_opencv_reads_what_cv2_writes(tmp_path):
    """A matrix in XML, with a name that only its place makes one of lights."""
    folder = scenes.write_capture(tmp_path, PICTURES, None)
    file = cv2.FileStorage(str(folder / "lights.xml"), cv2.FILE_STORAGE_WRITE)
    file.write("L", LIGHTS)
    file.release()
    assert check(open_capture(folder)) == ["lights_found"]
