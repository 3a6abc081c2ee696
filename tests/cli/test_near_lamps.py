"""Near lamps on the command line: the same capture, told in each way in which a user may tell where the lamps are."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bump_capture import POSITIONS, SIZE, WIDTH_MM, write_bump


@pytest.fixture
def bump(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_bump(Path("bump"))
    return Path("bump")


def infer(run, *arguments: object) -> dict:
    result = run("infer", "bump", "--method", "ls", "--json", "--overwrite", *map(str, arguments))
    assert result.code == 0, result.err
    return json.loads(result.out)[0]


def mean_error(report: dict) -> float:
    return report["angular_error_deg"]["mean"]


def test_files_in_the_folder(run, bump: Path) -> None:
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    (bump / "pixel_size.txt").write_text(f"# millimetres\n{WIDTH_MM / SIZE}\n")
    report = infer(run)
    assert mean_error(report) < 0.1
    assert report["warnings"] == []
    assert report["near_lamps"]["pixel_size"] == 2
    assert report["near_lamps"]["distances"] == pytest.approx(np.linalg.norm(POSITIONS, axis=1), abs=1e-3)
    info = run("info", "bump")
    assert "lamps        near, as in bump/light_positions.txt; a pixel is 2 wide" in info.out
    # A changed position is a change of the capture.
    moved = POSITIONS.copy()
    moved[0] += 5
    np.savetxt(bump / "light_positions.txt", moved)
    assert "other input files" in run("infer", "bump", "--method", "ls").err


def test_options_in_place_of_files(run, bump: Path) -> None:
    np.savetxt("lamps.txt", POSITIONS)
    for scale in (("--pixel-size", 2), ("--object-width", WIDTH_MM)):
        assert mean_error(infer(run, "--light-positions", "lamps.txt", *scale)) < 0.1
    # The same file as directions: distant lights, and without a scale nothing to warn of.
    assert mean_error(infer(run, "--lights", "lamps.txt")) > 5


def test_one_distance_for_all_lamps(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    positions = 170 * POSITIONS / np.linalg.norm(POSITIONS, axis=1, keepdims=True)
    folder = write_bump(Path("bump"), positions)
    np.savetxt(folder / "light_directions.txt", positions / 170)
    assert mean_error(infer(run, "--light-distance", 170, "--object-width", WIDTH_MM)) < 0.1
    assert mean_error(infer(run)) > 5
    assert mean_error(infer(run, "--light-distance", 200, "--object-width", WIDTH_MM)) < 3


def test_distant_lights_despite_positions_are_warned_of(run, bump: Path) -> None:
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    (bump / "pixel_size.txt").write_text("2\n")
    np.savetxt("directions.txt", POSITIONS)
    report = infer(run, "--lights", "directions.txt")
    assert [warning["code"] for warning in report["warnings"]] == ["near_lamps"]
    corners = np.array(
        [(x, y, 0) for x in (-31, 31) for y in (-31, 31)]
    )  # the middles of the outermost pixels
    towards = POSITIONS[:, None] - corners
    cosine = (towards * POSITIONS[:, None]).sum(axis=2) / np.linalg.norm(towards, axis=2)
    angle = np.degrees(np.arccos(cosine / np.linalg.norm(POSITIONS, axis=1)[:, None])).max()
    text = report["warnings"][0]["text"]
    assert f"by light_positions.txt, a light direction changes by up to {angle:.0f} degrees" in text
    np.savetxt(bump / "light_positions.txt", 10 * POSITIONS)
    assert infer(run, "--lights", "directions.txt")["warnings"] == []


def test_positions_without_a_scale(run, bump: Path) -> None:
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    result = run("infer", "bump", "--method", "ls")
    assert result.code == 3
    assert "light_positions.txt: nothing tells the scale of the lamps' positions" in result.err
    assert "--pixel-size or --object-width" in result.err
    # Beside directions, which are distant lights, it is a warning.
    np.savetxt(bump / "light_directions.txt", POSITIONS)
    assert [warning["code"] for warning in infer(run)["warnings"]] == ["near_lamps"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--light-distance", "170"], 2, "--light-distance needs the size of a pixel"),
        (["--light-distance", "170", "--light-positions", "l.txt"], 2, "contradict each other"),
        (["--pixel-size", "1", "--object-width", "2", "--light-distance", "3"], 2, "contradict each other"),
        (["--pixel-size", "-1"], 2, "the pixel size is -1, expected a number above 0"),
        (["--pixel-size", "1"], 2, "--pixel-size concerns near lamps, and bump has no light_positions.txt"),
        (["--light-positions", "l.txt", "--lights", "l.txt"], 2, "contradict each other"),
        (["--light-positions", "missing.txt"], 3, "missing.txt: the file does not exist"),
    ],
)
def test_refusals(run, bump: Path, arguments: list[str], code: int, message: str) -> None:
    np.savetxt(bump / "light_directions.txt", POSITIONS)
    np.savetxt("l.txt", POSITIONS)
    result = run("infer", "bump", "--method", "ls", *arguments)
    assert result.code == code, result.err
    assert message in result.err


def test_wrong_files_are_named(run, bump: Path) -> None:
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    for name, text, message in (
        ("pixel_size.txt", "1 2\n", 'pixel_size.txt:1: found "1 2", expected one number above 0'),
        ("pixel_size.txt", "# width\n0.9 mm\n", 'pixel_size.txt:2: found "0.9 mm", expected one number'),
        ("camera_matrix.txt", "1 2\n3 4\n", "camera_matrix.txt: found 2 x 2 numbers, expected 3 x 3"),
        ("light_positions.txt", "1 2 -3\n" * 7, "light_positions.txt:1: found a lamp behind the object"),
        ("light_positions.txt", "0 0 0\n" * 7, "found a zero vector, expected a lamp position"),
        ("light_positions.txt", "1 2 3\n" * 5, "found 5 lamp positions, expected 7"),
    ):
        (bump / "pixel_size.txt").write_text("2\n")
        (bump / name).write_text(text)
        result = run("infer", "bump", "--method", "ls")
        assert (result.code, message in result.err) == (3, True), result.err
        (bump / name).unlink()


@pytest.mark.parametrize("command", ["infer", "info"])
def test_positions_in_another_unit_than_the_pixel_size(run, bump: Path, command: str) -> None:
    """The bump is 64 mm wide, its lamps 162 mm away and more: in metres they would be inside the bump."""
    arguments = [
        command,
        "bump",
        *(["--method", "ls", "--overwrite"] if command == "infer" else []),
        "--strict",
    ]
    nearest = np.linalg.norm(POSITIONS, axis=1).min() / 1000
    number = int(np.linalg.norm(POSITIONS, axis=1).argmin()) + 1
    (bump / "pixel_size.txt").write_text("2\n")
    np.savetxt(bump / "light_positions.txt", POSITIONS / 1000)
    refused = run(*arguments)
    assert refused.code == 3
    assert "light_positions.txt: " in refused.err
    assert f"lamp {number} is {nearest:.3g} from the middle of the object, which is 64 wide" in refused.err
    assert "inside the object. Give all lengths in one unit, such as millimetres" in refused.err
    for factor, words in ((0.3, "A lamp is very near"), (1000, "so far that they are distant")):
        np.savetxt(bump / "light_positions.txt", POSITIONS * factor)
        warned = run(*arguments)
        assert (warned.code, words in warned.err) == (3, True), warned.err
        warned = run(*arguments[:-1])
        assert (warned.code, words in warned.err) == (0, True), warned.err
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    assert run(*arguments).code == 0


def test_evaluate_and_prepare(run, bump: Path) -> None:
    """Scoring a sample of the pixels finds the surface from all of them."""
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    (bump / "pixel_size.txt").write_text("2\n")
    for more in ((), ("--max-pixels", "50")):
        result = run(
            "evaluate", "bump", "--method", "ls", "--n-lights", "5", "--trials", "1", "--json", *more
        )
        assert result.code == 0, result.err
        assert json.loads(result.out)["results"][0]["mae_deg"] < 0.2
    noisy = run(
        "evaluate",
        "bump",
        "--method",
        "ls",
        "--n-lights",
        "all",
        "--light-noise-deg",
        "4",
        "--trials",
        "1",
        "--json",
    )
    assert json.loads(noisy.out)["results"][0]["mae_deg"] > 0.5
    refused = run("prepare", "bump", "-o", "set")
    assert refused.code == 3
    assert "near lamps, and training needs distant lights" in refused.err


def test_albedo_and_saturation(run, bump: Path) -> None:
    """The bump has one albedo, and pixels that are clipped at 70 % of the brightest are restored."""
    np.savetxt(bump / "light_positions.txt", POSITIONS)
    (bump / "pixel_size.txt").write_text("2\n")
    for path in bump.glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.minimum(image, 26_000))
    stored = infer(run, "--white-level", "26000", "--as-stored")
    restored = infer(run, "--white-level", "26000", "--maps", "albedo")
    assert mean_error(restored) < 0.5 * mean_error(stored)
    albedo = np.load("out/bump/albedo.npy") if Path("out/bump/albedo.npy").exists() else None
    if albedo is None:
        albedo = cv2.imread("out/bump/albedo.png", cv2.IMREAD_UNCHANGED).astype(float)
    assert albedo.std() < 0.03 * albedo.mean()
