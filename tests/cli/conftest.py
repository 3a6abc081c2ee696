"""A small analytic capture, and ways to run the command line."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import typer

import scenes
from scenes import read_json, to_uint16
from splinecli.cli.main import main
from splinecli.maths.normals import unit

SIZE = 24
LIGHTS = np.array(
    [
        (0, 0, 1),
        (0.5, 0, 1),
        (-0.5, 0, 1),
        (0, 0.5, 1),
        (0, -0.5, 1),
        (0.4, 0.4, 1),
        (-0.4, 0.4, 1),
        (0.4, -0.4, 1),
    ]
)
EXAMPLE = Path(__file__).resolve().parents[2] / "examples/medallion"


@pytest.fixture(autouse=True)
def in_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let relative paths begin in a new folder, so that messages hold short paths."""
    monkeypatch.chdir(tmp_path)


def sphere_normals() -> np.ndarray:
    """Normals (SIZE, SIZE, 3) of the upper part of a matte sphere, which no light above leaves in
    shadow.
    """
    x, y = scenes.square_grid(SIZE, 1 - 1 / SIZE)
    return unit(np.stack((x, y, np.full_like(x, 2.5)), axis=-1))


def write_capture(folder: Path) -> Path:
    """A capture with ground truth; its disc-shaped mask has 448 of 576 pixels."""
    normals, lights = sphere_normals(), unit(LIGHTS)
    pictures = to_uint16(np.moveaxis(normals @ lights.T, 2, 0) * 60_000)
    disc = np.hypot(*scenes.square_grid(SIZE, 1 - 1 / SIZE)) < 1
    truth = normals.astype(np.float32)
    return scenes.write_capture(
        folder, pictures, lights, mask=disc, normals=truth, names="image{}.png", first=1
    )


@pytest.fixture(scope="session")
def truth() -> np.ndarray:
    """True normals (SIZE, SIZE, 3) of the capture."""
    return sphere_normals()


@pytest.fixture
def make_capture() -> Callable[[str], Path]:
    """Write captures by name into the working folder."""
    return lambda name: write_capture(Path(name))


@pytest.fixture
def capture(make_capture: Callable[[str], Path]) -> Path:
    """The capture `sphere` in the working folder."""
    return make_capture("sphere")


@pytest.fixture
def medallion() -> Path:
    """A copy of the example, in an empty working folder."""
    return Path(shutil.copytree(EXAMPLE, "medallion"))


def read_report(folder: Path) -> dict:
    return read_json(folder / "report.json")


class Run(NamedTuple):
    code: int
    out: str
    err: str


COMMAND = cache(typer.main.get_command)
"""The commands are the same in all tests. Making them takes longer than many a command."""


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Run the command line: run("infer", folder, "--json") -> Run(code, out, err)."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERMINAL_WIDTH", "100")
    monkeypatch.setattr(typer.main, "get_command", COMMAND)

    def call(*args: object) -> Run:
        code = main([str(arg) for arg in args])
        return Run(code, *capfd.readouterr())

    return call


@pytest.fixture
def document(run: Callable[..., Run]) -> Callable[..., Any]:
    """Run a command with --json, which must succeed, and return its document: that of the only
    capture of `infer`.
    """

    def call(command: str, *args: object) -> Any:
        result = run(command, *args, "--json")
        assert result.code == 0, result.err
        found = json.loads(result.out)
        return found[0] if command == "infer" else found

    return call


@pytest.fixture
def refuse(run: Callable[..., Run], golden: Callable[[str, str], None]) -> Callable[..., None]:
    """Run a command with arguments that it must refuse, (exit code, arguments), and compare all its
    messages.
    """

    def check(command: str, cases: Iterable[tuple[int, list[object]]], name: str) -> None:
        messages = []
        for code, arguments in cases:
            result = run(command, *arguments)
            assert (result.code, result.out) == (code, ""), (arguments, result.err)
            messages.append(
                re.sub("[0-9a-f]{16}", "<checksum>", result.err.replace(f"{Path.cwd()}/", ""))
            )
        golden(name, "".join(messages))

    return check


@pytest.fixture
def run_without_privileges() -> Callable[..., Run]:
    """Run the command line in a process that permissions bind, also where the tests run as root."""
    command = [sys.executable, "-m", "splinecli"]
    if os.name == "nt":
        pytest.skip("POSIX permissions")
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root may read everything, and setpriv is not installed")
        rights = "-dac_override,-dac_read_search"
        command = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}", *command]

    def call(*args: object) -> Run:
        done = subprocess.run([*command, *map(str, args)], capture_output=True, text=True)
        return Run(done.returncode, done.stdout, done.stderr)

    return call
