"""Near lamps on the command line: the same capture, told in each way in which a user may tell where
the lamps are.
"""

from pathlib import Path

import numpy as np
import pytest
from pytest import approx

from cli.test_schema import check
from scenes import (
    BUMP_LAMPS,
    BUMP_MM,
    codes,
    parametrize,
    pinhole,
    put,
    read_image,
    write_bump,
    write_image,
)
from splinecli.maths.normals import unit


@pytest.fixture
def bump():
    return write_bump(Path("bump"))


@pytest.fixture
def infer(document):
    return lambda words="": document(f"infer bump --method ls --overwrite {words}")


@pytest.fixture
def mean_error(infer):
    return lambda words="": infer(words)["angular_error_deg"]["mean"]


def test_one_distance_for_all_lamps(mean_error, bump):
    positions = 170 * unit(BUMP_LAMPS)
    write_bump(bump, positions)
    np.savetxt(bump / "light_directions.txt", positions / 170)
    assert mean_error(f"--light-distance 170 --object-width {BUMP_MM}") < 0.1
    assert mean_error() > 5
    assert mean_error(f"--light-distance 200 --object-width {BUMP_MM}") < 3


@pytest.fixture
def near(bump):
    """The bump with the files that tell where its lamps are."""
    np.savetxt(bump / "light_positions.txt", BUMP_LAMPS)
    put(bump / "pixel_size.txt", "2\n")
    return bump


def test_files_and_options_mean_the_same(run, infer, mean_error, near):
    report = infer()
    assert report["angular_error_deg"]["mean"] < 0.1
    assert codes(report) == ["few_lights"]
    assert report["near_lamps"]["pixel_size"] == 2
    assert report["near_lamps"]["distances"] == approx(np.linalg.norm(BUMP_LAMPS, axis=1), abs=1e-3)
    assert (
        "lamps        near, as in bump/light_positions.txt; a pixel is 2 wide"
        in run("info bump").out
    )
    # A changed position is a change of the capture.
    moved = BUMP_LAMPS.copy()
    moved[0] += 5
    np.savetxt(near / "light_positions.txt", moved)
    run("infer bump --method ls", code=5, says="other input files")
    for name in ("light_positions.txt", "pixel_size.txt"):
        (near / name).unlink()
    np.savetxt("lamps.txt", BUMP_LAMPS)
    for scale in ("--pixel-size 2", f"--object-width {BUMP_MM}"):
        assert mean_error(f"--light-positions lamps.txt {scale}") < 0.1
    np.save("lamps.npy", BUMP_LAMPS)
    assert mean_error("--light-positions lamps.npy --pixel-size 2") < 0.1
    # The same file as directions: distant lights, and without a scale nothing to warn of.
    assert mean_error("--lights lamps.txt") > 5


def test_distant_lights_despite_positions_are_warned_of(infer, near):
    np.savetxt("directions.txt", BUMP_LAMPS)
    warning, _ = infer("--lights directions.txt")["warnings"]
    assert warning["code"] == "near_lamps"
    # The middles of the outermost pixels.
    towards = BUMP_LAMPS[:, None] - np.array([(x, y, 0) for x in (-31, 31) for y in (-31, 31)])
    cosine = (towards * BUMP_LAMPS[:, None]).sum(axis=2) / np.linalg.norm(towards, axis=2)
    angle = np.degrees(np.arccos(cosine / np.linalg.norm(BUMP_LAMPS, axis=1)[:, None])).max()
    assert f"a light direction changes by up to {angle:.0f} degrees" in warning["text"]
    np.savetxt(near / "light_positions.txt", 10 * BUMP_LAMPS)
    (warning,) = infer("--lights directions.txt")["warnings"]
    assert warning["code"] == "few_lights"


REFUSED = """
--light-distance 170 | 2 | --light-distance requires the size of a pixel
--light-distance 170 --light-positions l.txt | 2 | cannot be used together
--pixel-size 1 --object-width 2 --light-distance 3 | 2 | cannot be used together
--pixel-size -1 | 2 | --pixel-size is '-1'; expected a number above 0
--surface --pixel-size 1e9 | 2 | the pixel size is 1e+09 mm, expected
--pixel-size 1 | 2 | --pixel-size requires near lamps, but bump contains no light_positions.txt
--light-positions l.txt --lights l.txt | 2 | cannot be used together
--light-positions missing.txt | 3 | missing.txt: the file does not exist
--light-positions l.txt | 3 | the scale of the lamp positions is unknown
--light-positions l.txt --pixel-size 1 --light-format azel | 2 | applies to light directions
"""


@parametrize("arguments, code, message", REFUSED)
def test_refused_options(run, bump, arguments, code, message):
    np.savetxt(bump / "light_directions.txt", BUMP_LAMPS)
    np.savetxt("l.txt", BUMP_LAMPS)
    run(f"infer bump --method ls {arguments}", code=int(code), says=message)


WRONG_FILES = r"""
pixel_size.txt | 1 2\n | pixel_size.txt:1: found "1 2", expected one number above 0
pixel_size.txt | # width\n0.9 mm\n | pixel_size.txt:2: found "0.9 mm", expected one number
camera_matrix.txt | 1 2\n3 4\n | camera_matrix.txt: found 2 x 2 numbers, expected 3 x 3
camera_matrix.txt | -1 0 0\n0 1 0\n0 0 1\n | not a
light_positions.txt | 1 2 -3\n1 2 3\n1 2 3\n1 2 3\n1 2 3\n1 2 3\n1 2 3 | lamp behind the object
light_positions.txt | 0 0 0\n1 2 3\n1 2 3\n1 2 3\n1 2 3\n1 2 3\n1 2 3 | found a zero vector
light_positions.txt | 1 2 3\n1 2 3\n1 2 3\n1 2 3\n1 2 3 | found 5 lamp positions, expected 7
light_lobes.txt | 0 0 -1 2\n0 0 -1 2\n0 0 -1 2\n | lobes.txt: found 3 lines, expected 1 or 7
light_lobes.txt | # LEDs\n0 0 -1\n | light_lobes.txt:2: found "0 0 -1", expected x y z mu
light_lobes.txt | 0 0 -1 -2\n | light_lobes.txt:1: found "0 0 -1 -2", expected x y z mu
light_lobes.txt | # LED\n0 0 1 2\n | light_lobes.txt:2: lamp 1 shines away from the object
"""


@parametrize("name, text, message", WRONG_FILES)
def test_wrong_files_are_named(run, near, name, text, message):
    put(near / name, text)
    run("infer bump --method ls", input_error=message)


def test_a_near_camera_under_distant_lights(run, document, infer, mean_error, bump):
    """The camera is in the report, and comes from the option or the folder. A changed matrix
    changes the capture.
    """
    np.savetxt(bump / "light_directions.txt", BUMP_LAMPS)
    orthographic = infer()
    assert orthographic["camera_matrix"] is None
    matrix = pinhole(40, 16.5, 15.5)
    np.savetxt("camera.txt", matrix)
    np.savetxt(bump / "camera_matrix.txt", matrix)
    run("infer bump --method ls", code=5, says="other input files")
    found = infer()
    check(found, "Report")
    assert found["camera_matrix"] == matrix.tolist()
    assert found["near_lamps"] is None
    assert found["inputs_sha256"] != orthographic["inputs_sha256"]
    assert found["angular_error_deg"] == orthographic["angular_error_deg"]
    assert "camera       perspective, focal length 40 pixels" in run("info bump").out
    given = infer("--camera-matrix camera.txt --crop 4,2,20,24")
    assert given["camera_matrix"] == pinhole(40, 12.5, 13.5).tolist()
    scored = document("evaluate bump --method ia14 --n-lights all")["results"][0]
    assert scored["mae_deg"] == approx(mean_error("--method ia14"), abs=1e-3)
    (bump / "camera_matrix.txt").unlink()
    assert scored["mae_deg"] != approx(mean_error("--method ia14"), abs=1e-3)


def test_a_file_of_lobes(run, infer, mean_error, near):
    """One line is for all lamps. The frame of the positions is that of the lobes, too."""
    without = infer()
    put(near / "light_lobes.txt", "0 0.2 -1 0\n")
    run("infer bump --method ls", code=5, says="other input files")
    even = infer()
    check(even, "Report")
    assert even["near_lamps"]["lobes"] == [approx([0, 0.1961, -0.9806, 0], abs=1e-4)] * 7
    assert even["angular_error_deg"]["mean"] == approx(
        without["angular_error_deg"]["mean"], abs=1e-3
    )
    put(near / "light_lobes.txt", "0 0.2 -1 5\n")
    narrow = infer()
    assert narrow["angular_error_deg"]["mean"] > without["angular_error_deg"]["mean"] + 0.1
    np.savetxt(near / "light_positions.txt", BUMP_LAMPS * (1, -1, 1))
    put(near / "light_lobes.txt", "0 -0.2 -1 5\n")
    assert mean_error("--light-frame y-down") == narrow["angular_error_deg"]["mean"]


@parametrize("command", "infer info")
def test_positions_in_another_unit_than_the_pixel_size(run, near, command):
    """The bump is 64 mm wide, its lamps 162 mm away and more: in metres they would be inside the
    bump.
    """
    arguments = f"{command} bump {'--method ls --overwrite' if command == 'infer' else ''}"
    distances = np.linalg.norm(BUMP_LAMPS, axis=1) / 1000
    np.savetxt(near / "light_positions.txt", BUMP_LAMPS / 1000)
    lamp = (
        f"lamp {distances.argmin() + 1} is {distances.min():.3g} away from the centre of the"
        " object, which is 64"
    )
    words = (
        "so it would be inside the object. Use the same unit, such as millimetres, for all lengths"
    )
    run(f"{arguments} --strict", input_error=(lamp, words))
    far = "so far away that their light is practically parallel"
    for factor, words in ((0.3, "A lamp is very near"), (1000, far)):
        np.savetxt(near / "light_positions.txt", BUMP_LAMPS * factor)
        for strict, code in (("--strict", 3), ("", 0)):
            run(f"{arguments} {strict}", code=code, says=words)
    np.savetxt(near / "light_positions.txt", BUMP_LAMPS)
    run(f"{arguments} --strict")


def test_evaluate_and_prepare(run, document, near):
    """Scoring a sample of the pixels finds the surface from all of them."""

    def error(words):
        return document(f"evaluate bump --method ls --trials 1 {words}")["results"][0]["mae_deg"]

    assert max(error("--n-lights 5"), error("--n-lights 5 --max-pixels 50")) < 0.2
    assert error("--n-lights all --light-noise-deg 4") > 0.5
    run("prepare bump -o set", input_error="near lamps, and training needs distant lights")


def test_albedo_and_saturation(infer, near):
    """The bump has one albedo, and pixels that are clipped at 70 % of the brightest are
    restored.
    """
    for path in near.glob("*.png"):
        write_image(path, np.minimum(read_image(path), 26_000))
    stored = infer("--white-level 26000 --as-stored")
    restored = infer("--white-level 26000 --maps albedo")
    assert restored["angular_error_deg"]["mean"] < 0.5 * stored["angular_error_deg"]["mean"]
    albedo = np.load("out/bump/albedo.npy")
    assert albedo.std() < 0.03 * albedo.mean()
