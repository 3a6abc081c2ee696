"""Every kind of bad input gets one line on stderr, its exit code, and leaves nothing behind.

The texts stand in tests/golden/bad_input/, a file a case.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file

from cli.conftest import write_capture

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
            cv2.imwrite(str(capture / name), content)

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


def keep_two_images(capture: Path) -> None:
    for index in range(3, 9):
        (capture / f"image{index}.png").unlink()
    lights(lambda lines: lines[:2])(capture)


CASES: list[tuple[str, int, Spoil]] = [
    ("corrupt image", 3, write("image2.png", b"\x89PNG\r\n\x1a\nrubbish")),
    ("truncated image", 3, truncate),
    ("not an image", 3, write("image2.png", b"text")),
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
