"""What is wrong with files, names and limits gets one line and a documented exit code, and nothing
hangs.
"""

import os
import signal
import subprocess
import sys
import time
import tomllib
from itertools import chain, repeat
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import cv2
import numpy as np
import pytest

from scenes import parametrize, put, run_python, shell
from splinecli.cli import main
from splinecli.cli.signals import TOLD, report_interruption

posix = pytest.mark.skipif(os.name == "nt", reason="POSIX files, signals and limits")


@posix
def test_devices_and_pipes_are_refused_at_once(capture, run):
    os.mkfifo("pipe")
    for option in ("--lights", "--mask", "--ground-truth"):
        for path, kind in (("/dev/zero", "a device"), ("pipe", "a pipe")):
            message = f"splinecli: {path}: found {kind}, expected a file.\n"
            run(f"infer {capture} --method ls {option} {path}", code=3, err=message)
    run(f"infer {capture} --method ls")
    for command, code, expected in (
        ("integrate out/sphere --camera-matrix /dev/zero", 3, "a text file"),
        ("train -o run --config /dev/zero", 4, "a text file"),
        ("integrate /dev/zero -o surface", 3, "a normal map"),
    ):
        run(command, code=code, err=f"splinecli: /dev/zero: found a device, expected {expected}.\n")


@posix
@parametrize(
    "name",
    "mask.png ambient.tif light_intensities.txt image9.png Normal_gt.npy rti.lp",
)
@parametrize("kind", ["a pipe", "a broken link"])
def test_what_is_no_file_is_not_passed_over(capture, run, name, kind):
    for other in ("mask.png", "normals_gt.npy", "light_directions.txt"):
        (capture / other).unlink()
    if name != "rti.lp":
        put(capture / "lights.txt", "0 0 1\n1 0 1\n0 1 1\n1 1 1\n" * 2)
    if kind == "a pipe":
        os.mkfifo(capture / name)
    else:
        (capture / name).symlink_to("nothing")
    problem = "found a pipe, expected a file" if kind == "a pipe" else "the file does not exist"
    run(f"infer {capture} --method ls", code=3, err=f"splinecli: sphere/{name}: {problem}.\n")


@posix
def test_process_substitution_in_place_of_light_directions(capture, run):
    run(f"infer {capture} --method ls -o expected")
    command = f"{sys.executable} -m splinecli infer {capture} --method ls --lights"
    for _ in range(2):  # the second time, the same content counts as done
        result = shell(f"{command} <(cat {capture}/light_directions.txt)")
        assert result.returncode == 0, result.stderr
    assert "already done" in result.stderr
    assert np.array_equal(np.load("out/sphere/normals.npy"), np.load("expected/sphere/normals.npy"))


@posix
def test_a_pipe_that_is_too_long_is_refused_not_cut(capture):
    """The first megabyte is a whole light file."""
    command = f"{sys.executable} -m splinecli infer {capture} --method ls --lights"
    result = shell(
        f"{command} <(cat {capture}/light_directions.txt; head -c 1000000 /dev/zero | tr '\\0' ' ')"
    )
    assert result.returncode == 3
    assert result.stderr.endswith(
        "found more than 1.0 MB, expected a text file of at most 1.0 MB.\n"
    )
    assert not Path("out").exists()


def test_a_zero_byte_in_a_list_of_images(capture, run):
    put(capture / "filenames.txt", "image1.png\na\0b.png\n")
    says = 'splinecli: sphere/filenames.txt:2: the image "a\\x00b.png" does not exist'
    run(f"infer {capture} --method ls", input_error=says)


def test_names_cannot_forge_lines_or_move_the_cursor(make_capture, run, tmp_path):
    forged = "a\nsplinecli: warning: fake"
    for name in (forged, "\x1b[2J\u202eb"):
        make_capture("plain").rename(tmp_path / name)
        results = [
            run("infer --method ls", name),
            run("infer --method ls", name),
            run("infer none --method ls --overwrite", name, code=3),
            run("info", name),
            run("evaluate --method ls --n-lights 4 --trials 1 --overwrite", name),
            run("infer --method ls", name, "--lights", f"{name}/none\n", code=3),
        ]
        for _, out, err in results:
            text = out + err
            assert "\nsplinecli: warning: fake" not in text and not set("\x1b\u202e") & set(text)
    make_capture("plain").rename(tmp_path / "a\nb")
    assert run("infer --method ls", "a\nb").out.startswith("out/a\\nb: 448 pixels")


def test_cells_are_no_formulas(make_capture, run):
    for name, cell in {"=1+1": "'=1+1", "\r=1": "\\r=1", " \n=1": " \\n=1"}.items():
        make_capture(name)
        run("evaluate --method ls --n-lights 4 --trials 1 --overwrite", name)
        # also splits at \r
        header, row = Path("evaluation/results.csv").read_bytes().decode().splitlines()
        assert dict(zip(header.split(","), row.split(","), strict=True))["capture"] == cell


def test_a_list_of_images_stays_in_its_folder(capture, make_capture, run):
    elsewhere = make_capture("elsewhere")
    names = [f"../elsewhere/image{number}.png" for number in range(1, 9)]
    put(capture / "filenames.txt", "\n".join(names))
    message = (
        "splinecli: sphere/filenames.txt:1: the image"
        ' "../elsewhere/image1.png" is outside the folder of the list.'
    )
    for command in ("infer --method ls", "info", "evaluate --method ls --n-lights 4"):
        run(f"{command} {capture}", input_error=(message, "create a link to it there"))
    put(capture / "filenames.txt", "\n".join(str((elsewhere / n).absolute()) for n in names))
    run(f"info {capture}", input_error="is outside the folder of the list")
    # It may name links to images elsewhere.
    for number in range(1, 9):
        (capture / f"photo{number}.png").symlink_to(elsewhere.absolute() / f"image{number}.png")
    put(capture / "filenames.txt", "".join(f"photo{number}.png\n" for number in range(1, 9)))
    run(f"info {capture}")


@posix
def test_a_low_limit_on_memory_is_one_line(capture):
    arguments = f"{sys.executable} -m splinecli infer {capture}"
    for limit in (600_000, 1_100_000):
        result = shell(f"ulimit -v {limit}; {arguments}")
        assert result.returncode == 1
        assert result.stderr.startswith("splinecli: the memory limit of this process is")
        assert result.stderr.count("\n") == 1
    assert not Path("out").exists()


def test_memory_that_runs_out_is_one_line(capture, make_capture, run, monkeypatch):
    make_capture("second")
    decoded = chain([MemoryError()], repeat(DEFAULT))  # the first time only
    monkeypatch.setattr(cv2, "imdecode", Mock(wraps=cv2.imdecode, side_effect=decoded))
    message = "splinecli: sphere: there is not enough memory. Close other programs, or use smaller"
    run(f"infer {capture} second --method ls -q", code=1, err=f"{message} images.\n")
    assert Path("out/second/normals.png").exists()


def test_the_end_of_a_file_is_no_interruption(capture, run, monkeypatch):
    monkeypatch.setattr("splinecli.pipeline.info.describe_capture", Mock(side_effect=EOFError))
    run(f"info {capture}", code=1)


@posix
@parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_the_program_starts(capture, number):
    """It comes when the first module of the command line is imported,
    before PyTorch and the rest.
    """
    script = (
        "import os, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)  # a"
        " job in the background ignores it\nclass Finder:\n    def find_spec(self, name, *_):\n  "
        "      if name == 'splinecli.cli.main': os.kill(os.getpid(),"
        f" {int(number)})\nsys.meta_path.insert(0, Finder())\nfrom splinecli.__main__ import"
        f" run\nsys.argv = ['splinecli', 'infer', {str(capture)!r}]\nrun()"
    )
    done = run_python(script)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "splinecli: interrupted.\n")


def start(code):
    """Start a process that runs the code as the command line would, and wait until it says so."""
    script = "import importlib, signal, time\n"
    # A job in the background ignores Ctrl-C.
    script += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    script += "m = importlib.import_module('splinecli.cli.main')"
    script += (
        f"\ndef work(*_):\n    {code}\nm.main = work\nfrom splinecli.__main__ import run\nrun()"
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([sys.executable, "-c", script], text=True, **pipes)
    assert process.stdout.readline() == "ready\n"
    return process


# An interruption that somebody swallows.
SWALLOWED = (
    "print('ready', flush=True)\n    while True:\n        try: time.sleep(60)\n        except"
    " BaseException: pass"
)


@posix
@parametrize(
    ("number", "code"),
    [
        (signal.SIGTERM, "print('ready', flush=True); time.sleep(60)"),
        (signal.SIGTERM, SWALLOWED),
        # A call into C that no signal interrupts.
        (
            signal.SIGTERM,
            "import numpy; a = numpy.ones((3000, 3000)); print('ready', flush=True)\n    for _ in"
            " range(60): a @ a",
        ),
        (signal.SIGINT, SWALLOWED),
        # PyTorch is imported in another thread, which the main thread waits for.
        (
            signal.SIGINT,
            "from splinecli.system.machine import meanwhile\n    with meanwhile(lambda:"
            " time.sleep(60)):\n        print('ready', flush=True); time.sleep(60)",
        ),
    ],
)
def test_a_signal_always_ends_a_process(number, code):
    process = start(code)
    began = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "splinecli: interrupted.\n"
    assert time.monotonic() - began < 40  # the machine may be busy


@posix
def test_a_signal_at_the_end_does_not_change_the_exit_code():
    code = "import atexit; atexit.register(time.sleep, 0.5); print('ready', flush=True); return 3"
    process = start(code)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 3


def test_the_dependencies_have_no_known_holes():
    """Floors above the versions with published holes in what is used here."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8")
    listed = tomllib.loads(text)["project"]["dependencies"]
    floors = {
        name: tuple(map(int, floor.split(".")))
        for name, floor in (item.split(">=") for item in listed)
    }
    for name, floor in {
        "torch": (2, 6),  # CVE-2025-32434: code runs from a file read with weights_only
        "pillow": (12, 3),  # writes beyond buffers, and bombs, in many formats
        "jinja2": (3, 1, 6),  # CVE-2025-27516
        # CVE-2025-53644: writes beyond a buffer in 4.10 and 4.11
        "opencv-python-headless": (4, 12),
        "safetensors": (0, 5),
    }.items():
        assert floors[name] >= floor, name


LIBRARY = """
import os, signal
try:
    os.kill(os.getpid(), signal.{signal})
    for _ in range(100_000):
        pass
except BaseException:
    print("swallowed")
"""
IMPORTING = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
from splinecli import __main__
from splinecli.cli import main
def work():
    import library
    print("imported", flush=True)
    for _ in range(200):
        time.sleep(0.1)
main.main = work
__main__.run()
"""


@posix
@parametrize("name", "SIGINT SIGTERM")
def test_a_library_that_swallows_interrupts_while_it_is_imported(tmp_path, name):
    put(tmp_path / "library.py", LIBRARY.format(signal=name))
    done = run_python(IMPORTING, cwd=tmp_path)
    interrupted = 130, "imported\n", "splinecli: interrupted.\n"
    assert (done.returncode, done.stdout, done.stderr) == interrupted


def test_libraries_print_nothing(tmp_path):
    command = """
import logging, sys, warnings
from splinecli import __main__
from splinecli.cli import main
@main.app.command()
def noisy():
    logging.getLogger("library").error("a log")
    warnings.warn("a warning", RuntimeWarning)
sys.argv = ["splinecli", "noisy"]
__main__.run()
"""
    done = run_python(command)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_an_interruption_is_told_once(capfd, monkeypatch):
    """The thread that ends the process after a SIGTERM may come when the command has told of it."""
    monkeypatch.setattr(
        "typer.main.get_command", lambda _: type("Stub", (), {"main": lambda *_, **__: 130})
    )
    try:
        assert main.main([]) == report_interruption() == 130
    finally:
        TOLD.clear()
    assert capfd.readouterr().err == "splinecli: interrupted.\n"
