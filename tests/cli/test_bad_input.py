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

from scenes import parametrize, put, table, write_image


def lights(change):
    def spoil(capture):
        path = capture / "light_directions.txt"
        put(path, "\n".join(change(path.read_text().splitlines())))

    return spoil


def image(content):
    return lambda capture: (capture / "image2.png").write_bytes(content)


def remove_images(capture):
    for path in capture.iterdir():
        path.unlink()


def without_pixels(capture):
    """PGM files are recognised by their content."""
    for path in (*capture.glob("image*.png"), capture / "mask.png"):
        path.write_bytes(b"P5\n0 0\n255\n")


def keep_two_images(capture):
    for index in range(3, 9):
        (capture / f"image{index}.png").unlink()
    lights(lambda lines: lines[:2])(capture)


SPOILT = {
    "corrupt image": image(b"\x89PNG\r\n\x1a\nrubbish"),
    "truncated image": lambda capture: os.truncate(capture / "image2.png", 300),
    "not an image": image(b"text"),
    "images without pixels": without_pixels,
    "images of different sizes": lambda capture: write_image(
        capture / "image2.png", np.ones((24, 25), np.uint16)
    ),
    "mask of another size": lambda capture: write_image(
        capture / "mask.png", np.full((20, 24), 255, np.uint8)
    ),
    "mask all zero": lambda capture: write_image(
        capture / "mask.png", np.zeros((24, 24), np.uint8)
    ),
    "empty folder": remove_images,
    "light with a word": lights(lambda lines: [*lines[:2], "0.1 north 0.9", *lines[3:]]),
    "light below the horizon": lights(
        lambda lines: [*lines[:2], *["0.1 0.2 -0.9"] * 3, *lines[5:]]
    ),
    "fewer lights than images": lights(lambda lines: lines[:-1]),
    "more lights than images": lights(lambda lines: [*lines, "0 0 1"]),
    "two images": keep_two_images,
}
OPTIONS = """
lights in one plane | 3 | --light-indices 0,1,2
two lights chosen | 2 | --n-lights 2
more lights chosen than there are | 2 | --n-lights 9
light index out of range | 2 | --light-indices 0,1,8
light indices are words | 2 | --light-indices a,b,c
lights chosen twice over | 2 | --light-indices 0,1,3 --n-lights 3
unknown method | 2 | --method magic
unknown device | 2 | --device tpu
unknown format | 2 | --format bmp
unknown option | 2 | --magic
unknown weights | 4 | --method spline-net --weights magic
missing weight file | 4 | --method spline-net --weights none.safetensors
foreign weights | 4 | --method spline-net --weights foreign.safetensors
pickled weights | 4 | --method spline-net --weights weights.pt
missing light file | 3 | --lights none.txt
same names | 2 | others/sphere
"""


@parametrize("name, code, options", [*table(OPTIONS), *((n, 3, "") for n in SPOILT)])
def test_bad_input(name, code, options, capture, make_capture, run, golden):
    make_capture("others/sphere")
    save_file({"w": np.zeros(3, np.float32)}, "foreign.safetensors")
    Path("weights.pt").write_bytes(b"\x80\x04\x95 not to be unpickled")
    if not options:
        SPOILT[name](capture)
        options = "--auto-mask"  # where there is no mask
    result = run(f"infer {capture} --method ls {options}", code=int(code), out="")
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
@parametrize(
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


@parametrize("option", "--crosstalk --mask --output")
def test_an_option_is_not_the_value_of_the_one_before(option, capture, run):
    run(
        f"infer {capture} --lights-in-channels {option} --strict",
        usage_error=f"{option} needs a file or folder, found --strict. Write the",
    )


@parametrize("arguments", ["--workers 2", "--cluster tcp://127.0.0.1:1"])
def test_without_dask(arguments, capture, make_capture, run, monkeypatch):
    make_capture("second")
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run(
        f"infer {capture} second --method ls {arguments}",
        usage_error="Run pip install 'splinecli[cluster]'",
    )
    assert result.err.count("\n") == 1
    assert not Path("out").exists()
    # One capture needs no further process.
    if "--workers" in arguments:
        run(f"infer {capture} --method ls {arguments}")
