"""What all commands share: panels in the help, `~` in paths, closed pipes, and threads that sleep while they wait."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from splinecli.cli.app import app
from splinecli.cli.panels import OTHERS, PANELS, sort_into_panels

COMMANDS = typer.main.get_command(app).commands


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_stands_in_a_panel(name):
    command = COMMANDS[name]
    options = [max(one.opts, key=len) for one in command.params if one.param_type_name == "option"]
    panels = sort_into_panels(name, options)
    assert OTHERS not in panels
    assert sorted(option for names in panels.values() for option in names) == sorted(options)


def test_an_option_that_no_panel_names_is_still_shown():
    assert sort_into_panels("infer", ["--new", "--lights"]) == {"Lights": ["--lights"], OTHERS: ["--new"]}
    assert set(PANELS) == set(COMMANDS)


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_shows_no_python_types_and_cuts_nothing(name, run):
    text = run(*filter(None, [name]), "--help").out
    for unwanted in ("list[", "Path", "<str>", "<int>", "<float>", "{", "<=x", "..."):
        if unwanted != "..." or not name:
            assert unwanted not in text.replace("[ARGS]...", "")


def test_home_folders_are_expanded(capture, run, monkeypatch):
    monkeypatch.setenv("HOME", str(capture.parent.absolute()))
    monkeypatch.setenv("USERPROFILE", str(capture.parent.absolute()))
    call = ("infer", "~/sphere", "--lights=~/sphere/light_directions.txt", "--output=~/results")
    assert run(*call, "--method", "ls").code == 0
    assert Path("results/sphere/report.json").is_file()
    assert run("info", "~/sphere", "--mask=~/sphere/mask.png", "--plot=~/sky.png").code == 0
    assert Path("sky.png").is_file()
    assert run("integrate", "~/results/sphere", "--output=~/surface", "--format", "npy").code == 0
    assert Path("surface/depth.npy").is_file()
    assert "sphere/light_directions.txt" in run("calibrate", "~/sphere/light_directions.txt").err
    # The weights are a name or a file.
    missing = run("infer", "~/sphere", "--weights=~/none.safetensors", "--output=~/others").err
    assert str(capture.parent.absolute() / "none.safetensors") in missing
    assert not Path("~").exists()


@pytest.mark.skipif(os.name == "nt", reason="POSIX pipes")
@pytest.mark.parametrize("command", ["info", "infer"])
def test_a_closed_pipe_is_no_error(command, capture):
    read, write = os.pipe()
    os.close(read)
    arguments = [sys.executable, "-m", "splinecli", command, str(capture)]
    arguments += ["--method", "ls"] if command == "infer" else []
    done = subprocess.run(arguments, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    unexpected = [line for line in done.stderr.splitlines() if not line.startswith("splinecli: warning: ")]
    assert (done.returncode, unexpected) == (0, [])


@pytest.mark.parametrize(
    ("variables", "expected"),
    [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active"), ({"GOMP_SPINCOUNT": "9"}, None)],
)
def test_waiting_threads_sleep_unless_the_user_says_otherwise(variables, expected):
    script = "import os; from splinecli.cli import main; main(['--version']); print(os.environ.get('OMP_WAIT_POLICY'))"
    clean = {
        name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    }
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env={**clean, **variables}
    )
    assert done.stdout.splitlines()[-1] == str(expected)
