"""Wrong light files are told on the command line, with the option that mends them; --strict makes them errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/medallion"


@pytest.fixture
def medallion(tmp_path, monkeypatch):
    """A copy of the example, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "medallion"
    shutil.copytree(EXAMPLE, folder)
    return folder


def write_lights(folder: Path, change) -> None:
    lights = np.loadtxt(EXAMPLE / "light_directions.txt")
    np.savetxt(folder / "light_directions.txt", change(lights), fmt="%.6f")


def test_infer_names_a_flipped_axis_and_the_frame_mends_it(run, medallion):
    write_lights(medallion, lambda lights: lights * (1, -1, 1))
    result = run("infer", medallion, "--method", "ls")
    assert result.code == 0
    assert "with y negated (curl 0.03 against 0.52, outline +1.00 against -0.00)" in result.err
    assert "run again with --light-frame y-down." in result.err
    report = json.loads(Path("out/medallion/report.json").read_text())
    assert [warning["code"] for warning in report["warnings"]] == ["light_frame"]
    wrong = report["angular_error_deg"]["mean"]

    mended = run("infer", medallion, "--method", "ls", "--light-frame", "y-down", "--overwrite")
    assert (mended.code, mended.err) == (0, "")
    report = json.loads(Path("out/medallion/report.json").read_text())
    assert report["options"]["light_frame"] == "y-down"
    assert report["angular_error_deg"]["mean"] < wrong / 5


def test_the_advice_counts_from_the_file_not_from_the_frame_given(run, medallion):
    write_lights(medallion, lambda lights: lights * (-1, 1, -1))
    result = run("infer", medallion, "--method", "ls", "--light-frame", "z-away")
    assert "run again with --light-frame x-left,z-away." in result.err


def test_lights_that_all_point_away(run, medallion):
    write_lights(medallion, lambda lights: -lights)
    result = run("infer", medallion, "--method", "ls")
    assert result.code == 3
    assert "z points away from the camera in this file: add --light-frame z-away" in result.err


def test_strict_writes_nothing_and_ends_with_3(run, medallion):
    write_lights(medallion, lambda lights: np.roll(lights, 1, axis=0))
    result = run("infer", medallion, "--method", "ls", "--strict")
    assert (result.code, result.out) == (3, "")
    assert "much better if image 1 belongs to light 2, image 2 to the next, and so on" in result.err
    assert "Leave --strict out to go on nevertheless." in result.err
    assert not Path("out/medallion").exists()


@pytest.mark.parametrize("options", [(), ("--intensities", "equal")])
@pytest.mark.parametrize(
    ("order", "words"),
    [
        (np.roll(np.arange(10), 1), "if image 1 belongs to light 2, image 2 to the next, and so on"),
        (np.arange(10)[::-1], "in reversed order, beginning with light 10"),
        (np.r_[0, 5, 2:5, 1, 6:10], "with those of 02.png and 06.png exchanged"),
    ],
    ids=["shifted", "reversed", "exchanged"],
)
def test_orders_are_named_although_the_intensities_are_unequal_and_unknown(
    run, medallion, order, words, options
):
    (medallion / "light_intensities.txt").unlink()
    for number in (3, 7, 8):
        path = str(medallion / f"{number:02}.png")
        cv2.imwrite(path, np.rint(0.6 * cv2.imread(path, cv2.IMREAD_UNCHANGED)).astype(np.uint16))
    for command in (("info", medallion), ("infer", medallion, "--method", "ls")):
        assert "light" not in run(*command, *options).err.replace("The light intensities were estimated", "")
    write_lights(medallion, lambda lights: lights[order])
    for command in (("info", medallion), ("infer", medallion, "--method", "ls", "--overwrite")):
        assert f"much better {words} (misfit" in run(*command, *options).err


def test_info_lists_the_readings(run, medallion):
    good = run("info", medallion, "--strict", "--check-lights", "--json")
    assert good.code == 0
    rows = json.loads(good.out)["light_candidates"]
    assert rows[0]["reading"] == "as given"
    assert rows[0]["rim"] > 0.99 and max(row["advantage"] for row in rows) == 0
    assert len(rows) >= 8
    write_lights(medallion, lambda lights: lights[:, [1, 0, 2]])
    wrong = run("info", medallion, "--strict", "--check-lights")
    assert wrong.code == 3
    assert "--light-frame exchanged" in wrong.err
    assert "x and y exchanged  " in wrong.out


def test_unknown_frames_are_refused_before_anything_is_read(run, medallion):
    result = run("infer", medallion, "--light-frame", "down")
    assert result.code == 2
    assert (
        "--light-frame is 'down'; expected words of x-right, x-left, y-up, y-down, z-camera, z-away, exchanged"
        in result.err
    )


def test_lights_as_angles(run, medallion):
    def angles(lights):
        return np.degrees(np.stack((np.arctan2(lights[:, 1], lights[:, 0]), np.arcsin(lights[:, 2])), axis=1))

    write_lights(medallion, angles)
    refused = run("infer", medallion, "--method", "ls")
    assert refused.code == 3
    assert "found 2 columns of angles, expected 3 columns (x y z). If they are" in refused.err
    read = run("infer", medallion, "--method", "ls", "--lights-format", "azel")
    assert (read.code, read.err) == (0, "")


def test_a_relief_without_outline_gets_both_mends(run, medallion):
    mask = cv2.imread(str(medallion / "mask.png"), cv2.IMREAD_GRAYSCALE)
    height, width = mask.shape
    inner = np.zeros_like(mask)
    inner[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 255
    cv2.imwrite(str(medallion / "mask.png"), inner)
    write_lights(medallion, lambda lights: lights * (1, -1, 1))
    err = run("info", medallion).err
    assert "--light-frame x-left or y-down." in err or "--light-frame y-down or x-left." in err
    assert "without a closed outline, only you can tell which is right" in err


def test_other_faults_of_captures(run, medallion):
    shutil.copy(medallion / "03.png", medallion / "08.png")
    result = run("info", medallion, "--intensities", "equal", "--strict", "--json")
    assert result.code == 3
    report = json.loads(result.out)
    assert "repeated_images" in report["warning_codes"]
    assert any(text.startswith("03.png and 08.png are the same image, but") for text in report["warnings"])
