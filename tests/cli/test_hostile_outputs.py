"""An output folder that somebody else prepared: nothing outside of it changes, nothing hangs, no
traceback.
"""

import json
import os
import shutil
import signal
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from cli.test_calibrate import LIGHTS, write_balls
from scenes import parametrize, put
from splinecli.evaluation.trials import TrialStore
from system.test_publishing import LINKS

pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX links, pipes and signals")

COMMANDS = {
    "infer": (
        "infer sphere --method ls --format npy,png8 -o out",
        "out/sphere",
        "report.json normals.npy normals_8bit.png .lock",
    ),
    "infer here": (
        "infer sphere --method ls --format npy -o .",
        "sphere",
        "report.json normals.npy mesh.glb",
    ),
    "integrate": (
        "integrate n.npy --format npy,ply -o out",
        "out",
        "surface.json depth.npy mesh.ply mesh.glb",
    ),
    "evaluate": (
        "evaluate sphere --method ls --n-lights 4 --trials 1 --figures -o out",
        "out",
        "results.json results.csv trials.jsonl lights.png figures/sphere.png figures",
    ),
    "prepare": (
        "prepare sphere -o out",
        "out",
        "manifest.json contact_sheet.png sphere/mask.npy sphere",
    ),
    "calibrate": (
        "calibrate ball --circle 60,48,40 -o out",
        "out",
        "calibration.json light_directions.txt light_intensities.txt calibration.png",
    ),
}
"""A command, the folder that it writes, and names in it that somebody may have taken."""

PLANTS = LINKS | {
    "folder": lambda path, _: path.mkdir(),
    "wrong": lambda path, _: path.write_bytes(
        b'{"files": ["../../x", 5, "\\ud800"], "entries": 5}'
    ),
}


@pytest.fixture(autouse=True)
def alarm():
    """End what hangs."""
    before = signal.signal(signal.SIGALRM, Mock(side_effect=TimeoutError))
    signal.alarm(300)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def inputs(capture, monkeypatch):
    """What the commands read: five images, for speed. Figures are not drawn: these tests are about
    their files.
    """
    for number in (6, 7, 8):
        (capture / f"image{number}.png").unlink()
    lights = capture / "light_directions.txt"
    put(lights, "".join(lights.read_text().splitlines(keepends=True)[:5]))
    drawn = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint8))[1].tobytes()
    monkeypatch.setattr("splinecli.evaluation.figures.method_maps", lambda *_, **__: drawn)
    np.save("n.npy", np.tile(np.float32([0, 0, 1]), (8, 9, 1)))
    write_balls("ball", LIGHTS[:3])
    return capture


def everything_but(folder):
    """What is beside a folder: kinds, contents and targets of links."""
    state = {}
    for path in Path().rglob("*"):
        if not path.is_relative_to(folder) and not (
            folder.is_relative_to(path) or path.name == "index.html"
        ):
            status = path.lstat()
            content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
            state[str(path)] = status.st_mode, status.st_ino, content
    return state


@parametrize("plant", PLANTS)
@parametrize("name", COMMANDS)
def test_nothing_outside_of_the_folder_changes(inputs, run, name, plant):
    command, given, names = COMMANDS[name]
    again = f"{command} {'--update' if name == 'prepare' else '--overwrite'}"
    folder = Path(given)
    keep = shutil.copytree(inputs, "keep") if folder == inputs else None
    run(command)
    shutil.copytree(folder, "whole")
    # `prepare` writes an entry again only if the capture has changed.
    lights = inputs / "light_directions.txt"
    put(lights, lights.read_text() + "\n")
    for taken in names.split():
        shutil.rmtree(folder)
        shutil.copytree(keep or "whole", folder)
        place, target = folder / taken, Path("victim", Path(taken).name).absolute()
        shutil.rmtree("victim", ignore_errors=True)
        if place.is_dir():
            shutil.copytree(place, target)
            shutil.rmtree(place)
        else:
            target.parent.mkdir()
            target.write_bytes(place.read_bytes() if place.exists() else b"precious")
            place.unlink(missing_ok=True)
        if plant == "hard link" and target.is_dir():
            continue
        PLANTS[plant](place, target)
        before = everything_but(folder)
        for call in (command, again):
            assert "Traceback" not in run(call, code=(0, 3, 5)).err
            assert everything_but(folder) == before, (taken, call)


def test_trials_go_on_in_a_file_of_their_own(tmp_path):
    """Neither through a link, another name of the same file, nor a pipe; whole lines stay."""
    line = (
        json.dumps({"key": "a", "mae_deg": 1.0, "seconds": 1.0, "estimated_intensities": False})
        + "\n"
    )
    elsewhere, path = tmp_path / "elsewhere", tmp_path / "trials.jsonl"
    put(elsewhere, line + line[:20])
    path.hardlink_to(elsewhere)
    TrialStore(path)
    assert (path.read_text(), path.samefile(elsewhere)) == (line, False)
    path.unlink()
    path.symlink_to(elsewhere)
    TrialStore(path)
    assert (path.read_text(), path.is_symlink()) == ("", False)
    assert elsewhere.read_text() == line + line[:20]
    path.unlink()
    os.mkfifo(path)
    TrialStore(path)
    assert path.is_file()


def test_something_else_in_place_of_a_lock_fails_its_capture_only(inputs, run):
    shutil.copytree("sphere", "second")
    Path("out/sphere").mkdir(parents=True)
    for plant in (lambda path: path.symlink_to("/nowhere"), Path.mkdir, os.mkfifo):
        lock = Path("out/sphere/.lock")
        plant(lock)
        message = "out/sphere/.lock: the lock is not a file. Remove it."
        run("infer sphere second --method ls -o out --overwrite", code=5, says=message)
        assert Path("out/second/report.json").is_file() and Path("out/index.html").is_file()
        lock.rmdir() if lock.is_dir() else lock.unlink()
