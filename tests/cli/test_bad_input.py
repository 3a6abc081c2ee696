"""Every kind of bad input gets one line on stderr, its exit code, and leaves nothing behind.

The texts stand in tests/golden/bad_input/, a file a case. Usage errors name what was found and what
was expected; those of the parser also the help.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from cli.conftest import write_capture
from scenes import write_image


def lights(change):
    def spoil(capture):
        path = capture / "light_directions.txt"
        path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")

    return spoil


def replace_line(number, text):
    return lights(lambda lines: [*lines[: number - 1], text, *lines[number:]])


def write(name, content):
    def spoil(capture):
        if isinstance(content, bytes):
            (capture / name).write_bytes(content)
        else:
            write_image(capture / name, content)

    return spoil


def truncate(capture):
    path = capture / "image2.png"
    path.write_bytes(path.read_bytes()[:-200])


def foreign_weights(_):
    save_file({"w": np.zeros(3, np.float32)}, "foreign.safetensors")
    return "--method spline-net --weights foreign.safetensors"


def pickled_weights(_):
    Path("weights.pt").write_bytes(b"\x80\x04\x95 not to be unpickled")
    return "--method spline-net --weights weights.pt"


def remove_images(capture):
    for path in capture.iterdir():
        path.unlink()


def without_pixels(capture):
    """PGM files are recognised by their content."""
    for path in (*capture.glob("image*.png"), capture / "mask.png"):
        path.write_bytes(b"P5\n0 0\n255\n")
    return "--auto-mask"


def keep_two_images(capture):
    for index in range(3, 9):
        (capture / f"image{index}.png").unlink()
    lights(lambda lines: lines[:2])(capture)


CASES = [
    ("corrupt image", 3, write("image2.png", b"\x89PNG\r\n\x1a\nrubbish")),
    ("truncated image", 3, truncate),
    ("not an image", 3, write("image2.png", b"text")),
    ("images without pixels", 3, without_pixels),
    ("images of different sizes", 3, write("image2.png", np.ones((24, 25), np.uint16))),
    ("mask of another size", 3, write("mask.png", np.full((20, 24), 255, np.uint8))),
    ("mask all zero", 3, write("mask.png", np.zeros((24, 24), np.uint8))),
    ("empty folder", 3, remove_images),
    ("light with a word", 3, replace_line(3, "0.1 north 0.9")),
    (
        "light below the horizon",
        3,
        lights(lambda lines: [*lines[:2], *["0.1 0.2 -0.9"] * 3, *lines[5:]]),
    ),
    ("fewer lights than images", 3, lights(lambda lines: lines[:-1])),
    ("more lights than images", 3, lights(lambda lines: [*lines, "0 0 1"])),
    ("lights in one plane", 3, "--light-indices 0,1,2"),
    ("two lights chosen", 2, "--n-lights 2"),
    ("more lights chosen than there are", 2, "--n-lights 9"),
    ("light index out of range", 2, "--light-indices 0,1,8"),
    ("light indices are words", 2, "--light-indices a,b,c"),
    ("lights chosen twice over", 2, "--light-indices 0,1,3 --n-lights 3"),
    ("unknown method", 2, "--method magic"),
    ("unknown device", 2, "--device tpu"),
    ("unknown format", 2, "--format bmp"),
    ("unknown option", 2, "--magic"),
    ("unknown weights", 4, "--method spline-net --weights magic"),
    ("missing weight file", 4, "--method spline-net --weights none.safetensors"),
    ("foreign weights", 4, foreign_weights),
    ("pickled weights", 4, pickled_weights),
    ("missing light file", 3, "--lights none.txt"),
    ("two images", 3, keep_two_images),
    ("same names", 2, lambda _: write_capture(Path("others/sphere"))),
]


@pytest.mark.parametrize("name, code, spoil", CASES, ids=[case[0] for case in CASES])
def test_bad_input(name, code, spoil, capture, run, golden):
    extra = spoil if isinstance(spoil, str) else spoil(capture) or ""
    result = run(f"infer {capture} --method ls {extra}", code=code, out="")
    assert result.err.startswith("splinecli: ")
    assert result.err.count("\n") == 1
    golden(f"bad_input/{name.replace(' ', '_')}.txt", result.err)
    assert not Path("out").exists()


USAGE_ERRORS = """
inferr X
magic
infer
train
infer X --lights
infer X --html=3
info a b
infer X -z
infer X --msk
prepare -o s --lights 20
infer X --n-lights abc
prepare -o s --n-lights 20.5
prepare -o s --n-lights 4
evaluate X --light-noise-deg 1 --light-noise-deg x
infer X --stiffness 2
info X --lights-format azel
info X --light-frame exchanged
infer X --device tpu
infer X --device cud
infer X --method LS
infer X --maps preview,albdo
info X --transfer sgrb
train -o run --preset compat
"""


def test_usage_errors(run, golden):
    """Each line has one error, and one message."""
    told = [run(line, code=2, out="").err for line in USAGE_ERRORS[1:].split("\n")]
    assert [message.count("\n") for message in told] == [1] * len(told)
    golden("usage_errors.txt", "".join(told))


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
    message = "splinecli: the current folder was removed. Change to another folder.\n"
    run(arguments.format(tmp_path / capture), code=2, err=message)


@pytest.mark.parametrize("option", ["--crosstalk", "--mask", "--output"])
def test_an_option_is_not_the_value_of_the_one_before(option, capture, run):
    run(
        f"infer {capture} --lights-in-channels {option} --strict",
        code=2,
        says=f"{option} needs a file or folder, found --strict. Write the file or folder after",
    )


@pytest.mark.parametrize("arguments", ["--workers 2", "--cluster tcp://127.0.0.1:1"])
def test_without_dask(arguments, capture, make_capture, run, monkeypatch):
    make_capture("second")
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run(
        f"infer {capture} second --method ls {arguments}",
        code=2,
        says="Run pip install 'splinecli[cluster]'",
    )
    assert result.err.count("\n") == 1
    assert not Path("out").exists()
    # One capture needs no further process.
    if "--workers" in arguments:
        run(f"infer {capture} --method ls {arguments}")
