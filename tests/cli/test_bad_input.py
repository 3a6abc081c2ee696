"""Every kind of bad input gets one line on stderr, its exit code, and leaves nothing behind.

The texts stand in tests/golden/bad_input/, a file a case. Usage errors name what was found and what
was expected; those of the parser also the help.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from cli.conftest import write_capture
from scenes import write_image

Spoil = Callable[[Path], list[object] | None]


def lights(change: Callable[[list[str]], list[str]]) -> Spoil:
    def spoil(capture: Path) -> None:
        path = capture / "light_directions.txt"
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return spoil


def replace_line(number: int, text: str) -> Spoil:
    return lights(lambda lines: [*lines[: number - 1], text, *lines[number:]])


def write(name: str, content: bytes | np.ndarray) -> Spoil:
    def spoil(capture: Path) -> None:
        if isinstance(content, bytes):
            (capture / name).write_bytes(content)
        else:
            write_image(capture / name, content)

    return spoil


def truncate(capture: Path) -> None:
    path = capture / "image2.png"
    path.write_bytes(path.read_bytes()[:-200])


def option(*arguments: object) -> Spoil:
    return lambda _: list(arguments)


def foreign_weights(_: Path) -> list[object]:
    save_file({"w": np.zeros(3, np.float32)}, "foreign.safetensors")
    return ["--method", "spline-net", "--weights", "foreign.safetensors"]


def pickled_weights(_: Path) -> list[object]:
    Path("weights.pt").write_bytes(b"\x80\x04\x95 not to be unpickled")
    return ["--method", "spline-net", "--weights", "weights.pt"]


def remove_images(capture: Path) -> None:
    for path in capture.iterdir():
        path.unlink()


def without_pixels(capture: Path) -> list[object]:
    """PGM files are recognised by their content."""
    for path in (*capture.glob("image*.png"), capture / "mask.png"):
        path.write_bytes(b"P5\n0 0\n255\n")
    return ["--auto-mask"]


def keep_two_images(capture: Path) -> None:
    for index in range(3, 9):
        (capture / f"image{index}.png").unlink()
    lights(lambda lines: lines[:2])(capture)


CASES: list[tuple[str, int, Spoil]] = [
    ("corrupt image", 3, write("image2.png", b"\x89PNG\r\n\x1a\nrubbish")),
    ("truncated image", 3, truncate),
    ("not an image", 3, write("image2.png", b"text")),
    ("images without pixels", 3, without_pixels),
    ("images of different sizes", 3, write("image2.png", np.ones((24, 25), np.uint16))),
    ("mask of another size", 3, write("mask.png", np.full((20, 24), 255, np.uint8))),
    ("mask all zero", 3, write("mask.png", np.zeros((24, 24), np.uint8))),
    ("empty folder", 3, remove_images),
    ("light with a word", 3, replace_line(3, "0.1 north 0.9")),
    ("light below the horizon", 3, replace_line(3, "0.1 0.2 -0.9")),
    ("fewer lights than images", 3, lights(lambda lines: lines[:-1])),
    ("more lights than images", 3, lights(lambda lines: [*lines, "0 0 1"])),
    ("lights in one plane", 3, option("--light-indices", "0,1,2")),
    ("two lights chosen", 2, option("--n-lights", 2)),
    ("more lights chosen than there are", 2, option("--n-lights", 9)),
    ("light index out of range", 2, option("--light-indices", "0,1,8")),
    ("light indices are words", 2, option("--light-indices", "a,b,c")),
    ("lights chosen twice over", 2, option("--light-indices", "0,1,3", "--n-lights", 3)),
    ("unknown method", 2, option("--method", "magic")),
    ("unknown device", 2, option("--device", "tpu")),
    ("unknown format", 2, option("--format", "bmp")),
    ("unknown option", 2, option("--magic")),
    ("unknown weights", 4, option("--method", "spline-net", "--weights", "magic")),
    ("missing weight file", 4, option("--method", "spline-net", "--weights", "none.safetensors")),
    ("foreign weights", 4, foreign_weights),
    ("pickled weights", 4, pickled_weights),
    ("missing light file", 3, option("--lights", "none.txt")),
    ("two images", 3, keep_two_images),
    ("same names", 2, lambda _: [write_capture(Path("others/sphere"))]),
]


@pytest.mark.parametrize(("name", "code", "spoil"), CASES, ids=[case[0] for case in CASES])
def test_bad_input(name, code, spoil, capture, run, golden):
    extra = spoil(capture) or []
    result = run("infer", capture, "--method", "ls", *extra)
    assert (result.code, result.out) == (code, "")
    assert result.err.startswith("splinecli: ")
    assert result.err.count("\n") == 1
    golden(f"bad_input/{name.replace(' ', '_')}.txt", result.err)
    assert not Path("out").exists()


USAGE_ERRORS = {
    "inferr X": "no command 'inferr'. Did you mean 'infer' or 'info'? See 'splinecli --help'.",
    "magic": "no command 'magic'. See 'splinecli --help'.",
    "": "a command is missing. See 'splinecli --help'.",
    "infer": "CAPTURE is missing. See 'splinecli infer --help'.",
    "train": "--output is missing. See 'splinecli train --help'.",
    "infer X --lights": "--lights needs a value. See 'splinecli infer --help'.",
    "infer X --html=3": "--html takes no value. See 'splinecli infer --help'.",
    "info a b": "unexpected arguments: b. See 'splinecli info --help'.",
    "infer X -z": "no option -z. See 'splinecli infer --help'.",
    "infer X --msk": "no option --msk. Did you mean --auto-mask, --maps or --mask? See 'splinecli"
    " infer --help'.",
    "prepare -o s --lights 20": "no option --lights. Did you mean --n-lights? See 'splinecli"
    " prepare --help'.",
    "infer X --n-lights abc": "--n-lights is 'abc'; expected a whole number of at least 3.",
    "prepare -o s --n-lights 20.5": "--n-lights is '20.5'; expected a whole number of at least 16.",
    "prepare -o s --n-lights 4": "--n-lights is '4'; expected a whole number of at least 16.",
    "evaluate X --light-noise-deg 1 --light-noise-deg x": "--light-noise-deg is 'x'; expected a"
    " number of at least 0.",
    "infer X --stiffness 2": "--stiffness is now --discontinuity. See 'splinecli infer --help'.",
    "info X --lights-format azel": "--lights-format is now --light-format. See 'splinecli"
    " info --help'.",
    "info X --light-frame exchanged": "--light-frame is 'exchanged'; exchanged is now swap-xy.",
    "infer X --device tpu": "--device is 'tpu'; expected one of 'auto', 'cpu', 'cuda'.",
}


def test_usage_errors(run):
    for arguments, message in USAGE_ERRORS.items():
        assert run(*arguments.split()) == (2, "", f"splinecli: {message}\n")


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps the folder")
@pytest.mark.parametrize(
    "arguments",
    ["infer {} --method ls -o .", "integrate {} -o .", "info {} --json", "prepare -o s"],
)
def test_a_current_folder_that_was_removed(arguments, capture, run, tmp_path, monkeypatch):
    """A file cannot be created in it, although the folder exists for the system."""
    (tmp_path / "removed").mkdir()
    monkeypatch.chdir(tmp_path / "removed")
    (tmp_path / "removed").rmdir()
    result = run(*arguments.format(tmp_path / capture).split())
    message = "the current folder was removed. Change to another folder."
    assert (result.code, result.err) == (2, f"splinecli: {message}\n")


@pytest.mark.parametrize("option", ["--crosstalk", "--mask", "--output"])
def test_an_option_is_not_the_value_of_the_one_before(option, capture, run):
    result = run("infer", capture, "--lights-in-channels", option, "--strict")
    assert result.code == 2
    assert (
        f"{option} needs a file or folder, found --strict. Name it after the option." in result.err
    )


@pytest.mark.parametrize("arguments", [("--workers", "2"), ("--cluster", "tcp://127.0.0.1:1")])
def test_without_dask(arguments, capture, make_capture, run, monkeypatch):
    make_capture("second")
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run("infer", capture, "second", "--method", "ls", *arguments)
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "Run pip install 'splinecli[cluster]'" in result.err
    assert not Path("out").exists()
    # One capture needs no further process.
    if "--workers" in arguments:
        assert run("infer", capture, "--method", "ls", *arguments).code == 0
