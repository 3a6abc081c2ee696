"""splinecli.toml in the folder of a capture."""

from pathlib import Path

import numpy as np
import pytest

from scenes import codes, parametrize, put


@pytest.fixture
def unusual(capture):
    """A capture whose lights have another name and another frame."""
    np.savetxt(capture / "lamps.dat", np.loadtxt(capture / "light_directions.txt") * (1, -1, 1))
    (capture / "light_directions.txt").unlink()
    return capture


def test_written_settings_are_read(unusual, run, document):
    given = f"--lights {unusual}/lamps.dat --light-frame y-down"
    expected = document(f"infer {unusual} {given} --method ls")
    run(f"info {unusual} {given} --write-settings")
    text = (unusual / "splinecli.toml").read_text()
    assert text == 'lights = "lamps.dat"\nlight-frame = "y-down"\n'
    run(f"info {unusual} {given} --write-settings")  # the same again
    run(f"info {unusual} --align {given} --write-settings", code=5, says="splinecli.toml")
    found = document(f"infer {unusual} --method ls -o again")
    assert found["light_directions"] == expected["light_directions"]
    assert "settings_read" in codes(found) and "settings_read" not in codes(expected)
    assert "splinecli.toml sets" in run(f"info {unusual}").err
    run(f"infer {unusual} --method ls -o again", says="already done")
    # The command line wins.
    other = document(f"infer {unusual} --light-frame x-left --as-stored --method ls -o other")
    assert other["light_directions"] != expected["light_directions"]


@pytest.mark.parametrize("options", ["--lights estimate", "--light-positions {}/positions.txt"])
def test_options_that_conflict_with_settings_win(unusual, run, options):
    text = 'lights = "lamps.dat"\nmask = "mask.png"\nlight-frame = "y-down"\n'
    (unusual / "splinecli.toml").write_text(text)
    positions = 100 * np.loadtxt(unusual / "lamps.dat") * (1, -1, 1)
    np.savetxt(unusual / "positions.txt", positions)
    (unusual / "pixel_size.txt").write_text("1")
    run(f"info {unusual} {options.format(unusual)}")


def test_conflicts_with_settings_name_the_file(unusual, run):
    (unusual / "splinecli.toml").write_text('lights = "estimate"\nfirst-light = "left"\n')
    lights = f"--lights {unusual}/lamps.dat"
    run(f"info {unusual} {lights}", code=2, says=("splinecli.toml", "first-light"))


@parametrize(
    ("text", "says"),
    [
        ("transfer = ", "is not valid TOML"),
        ("a = 1\n", ("toml:1:", "unknown setting 'a'", "light-frame")),
        ("light_frame = 'y-down'\n", "Did you mean light-frame?"),
        ("\nwhite-level = 'high'", ("toml:2:", "white-level")),
        ("output = 'x'", "unknown setting 'output'"),
        ("lights = '../lights.txt'", "expected a path inside the folder"),
        ("light-frame = 'z-up'", "z-up"),
    ],
)
def test_wrong_settings(capture, run, text, says):
    put(capture / "splinecli.toml", text)
    for command in ("infer", "info"):
        run(f"{command} {capture}", input_error=("splinecli.toml", *np.atleast_1d(says)))
    assert not Path("out").exists()


def test_settings_from_a_windows_editor(unusual, run):
    text = "lights = 'lamps.dat'\nlight-frame = 'y-down'\nalign = true\n"
    (unusual / "splinecli.toml").write_text(text, "utf-8-sig")
    assert 'light-frame = "y-down", align = true' in run(f"info {unusual}").err.replace("\n", " ")


def test_settings_that_cannot_be_written(unusual, run):
    run(f"info {unusual} --lights lamps.txt --write-settings", usage_error="outside")
    Path("unusual").mkdir()
    given = f"--lights {unusual}/lamps.dat"
    run(f"info {unusual} --write-settings", usage_error="needs options")
    assert not (unusual / "splinecli.toml").exists()
    np.savetxt(unusual / "few.dat", np.eye(3))
    for wrong in ("--lights {0}/few.dat", "--lights {0}/none.dat", "--white-level 1e9 " + given):
        run(f"info {unusual} --write-settings {wrong.format(unusual)}", code=3)
        assert not (unusual / "splinecli.toml").exists()
    run(f"info {unusual} {given} --light-frame y-down --write-settings")
    run(f"info {unusual} {given} --write-settings", code=5, says="Add --overwrite")
    run(f"info {unusual} {given} --write-settings --overwrite")
    assert (unusual / "splinecli.toml").read_text() == 'lights = "lamps.dat"\n'
