"""A small analytic capture, and ways to run the command line."""

import json
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import typer

import scenes
from scenes import read_json, to_uint16, vectors
from splinecli.cli.main import main
from splinecli.maths.normals import unit

SIZE = 24
LIGHTS = vectors("0 0 1; 0.5 0 1; -0.5 0 1; 0 0.5 1; 0 -0.5 1; 0.4 0.4 1; -0.4 0.4 1; 0.4 -0.4 1")
EXAMPLE = Path(__file__).resolve().parents[2] / "examples/medallion"


@pytest.fixture(autouse=True)
def in_own_folder(tmp_path, monkeypatch):
    """Let relative paths begin in a new folder, so that messages hold short paths."""
    monkeypatch.chdir(tmp_path)


def sphere_normals():
    """Normals (SIZE, SIZE, 3) of the upper part of a matte sphere, which no light above leaves in
    shadow.
    """
    x, y = scenes.square_grid(SIZE, 1 - 1 / SIZE)
    return unit(np.stack((x, y, np.full_like(x, 2.5)), axis=-1))


def write_capture(folder):
    """A capture with ground truth; its disc-shaped mask has 448 of 576 pixels."""
    normals, lights = sphere_normals(), unit(LIGHTS)
    pictures = to_uint16(np.moveaxis(normals @ lights.T, 2, 0) * 60_000)
    disc = np.hypot(*scenes.square_grid(SIZE, 1 - 1 / SIZE)) < 1
    truth = np.float32(normals)
    return scenes.write_capture(
        folder, pictures, lights, mask=disc, normals=truth, names="image{}.png", first=1
    )


@pytest.fixture(scope="session")
def truth():
    """True normals (SIZE, SIZE, 3) of the capture."""
    return sphere_normals()


@pytest.fixture
def make_capture():
    """Write captures by name into the working folder."""
    return lambda name: write_capture(Path(name))


@pytest.fixture
def capture(make_capture):
    """The capture `sphere` in the working folder."""
    return make_capture("sphere")


@pytest.fixture
def medallion():
    """A copy of the example, in an empty working folder."""
    return Path(shutil.copytree(EXAMPLE, "medallion"))


def read_report(name="sphere"):
    return read_json(f"out/{name}/report.json")


class Run(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def json(self):
        return json.loads(self.out)


COMMAND = cache(typer.main.get_command)
"""The commands are the same in all tests. Making them takes longer than many a command."""


def checked(result, code, says):
    """The result, whose exit code and messages must be these."""
    assert result.code in (code if isinstance(code, tuple) else (code,)), result
    for text in (says,) if isinstance(says, str) else says:
        assert text in result.err
    return result


@pytest.fixture
def run(capfd, monkeypatch):
    """Run the command line: run("infer sphere --json", "a name with spaces") -> Run.

    The exit code must be `code`, stdout `out` and stderr `err`, where given, with `says` in stderr.
    An `input_error` says what follows with code 3, a `usage_error` with 2.
    """
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(typer.main, "get_command", COMMAND)

    def call(
        command, *more, code=0, says=(), out=None, err=None, input_error=None, usage_error=None
    ):
        if input_error or usage_error:
            code, says = (3, input_error) if input_error else (2, usage_error)
        found = main([*command.split(), *map(str, more)])
        result = checked(Run(found, *capfd.readouterr()), code, says)
        assert out in (None, result.out) and err in (None, result.err), result
        return result

    return call


@pytest.fixture
def document(run):
    """Run a command with --json, which must succeed, and return its document: that of the only
    capture of `infer`.
    """

    def call(command, *more):
        found = run(f"{command} --json", *more).json
        return found[0] if command.startswith("infer") else found

    return call


@pytest.fixture
def refuse(run, golden):
    """Run a command that must refuse the arguments of each line, behind their exit code, and
    compare all its messages.
    """

    def check(command, cases):
        messages = []
        for code, arguments in re.findall(r"^ *(\d) ?(.*)$", cases, re.MULTILINE):
            result = run(f"{command} {arguments}", code=int(code), out="")
            messages.append(
                re.sub("[0-9a-f]{16}", "<checksum>", result.err.replace(f"{Path.cwd()}/", ""))
            )
        golden(f"{command.replace('-', '_')}_refusals.txt", "".join(messages))

    return check


@pytest.fixture
def run_without_privileges():
    """Run the command line in a process that permissions bind, also where the tests run as root."""
    command = [sys.executable, "-m", "splinecli"]
    if os.name == "nt":
        pytest.skip("POSIX permissions")
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root may read everything, and setpriv is not installed")
        rights = "-dac_override,-dac_read_search"
        command = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", *command]

    def call(words, *more, code):
        done = subprocess.run([*command, *words.split(), *more], capture_output=True, text=True)
        return checked(Run(done.returncode, done.stdout, done.stderr), code, ())

    return call
