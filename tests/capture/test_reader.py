"""Whole captures: observations against the photographs written, what the record refuses, and files
that are decoded at once.
"""

from contextlib import suppress

import cv2
import numpy as np
import pytest
import tifffile
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from scenes import (
    FOUR_LIGHTS,
    parametrize,
    refuses,
    ring_lights,
    run_python,
    vectors,
    write_capture,
)
from splinecli.capture import Capture, open_capture
from splinecli.capture.formats.images import decode_image
from splinecli.errors import InputError, UsageError
from splinecli.recipe import prepare_capture, read_capture
from splinecli.system.machine import in_order

INTENSITIES = vectors("1 2 4; 2 2 2; 0.5 1 3; 1 1 1")


@pytest.fixture
def photographs():
    """(4, 5, 6, 3) 16-bit RGB values, none of them saturated."""
    return np.uint16(default_rng(1).integers(0, 65000, (4, 5, 6, 3)))


@pytest.fixture
def capture_folder(tmp_path, photographs):
    """tmp_path/vase: four photographs and light_directions.txt, nothing else."""
    # img8, img9, img10, img11: not in the order of text
    return write_capture(tmp_path / "vase", photographs, FOUR_LIGHTS, names="img{}.png", first=8)


def texts(warnings):
    return tuple(str(warning) for warning in warnings)


def expected(photographs, intensities):
    """(P, F) for the whole image, in float64."""
    return np.asarray(
        (photographs / 65535 / intensities[:, None, None])
        .mean(axis=-1)
        .reshape(len(photographs), -1)
        .T
    )


def test_observations_mask_and_ground_truth(capture_folder, write_image, photographs):
    capture = read_capture(capture_folder)
    assert_allclose(capture.observations, expected(photographs, np.ones((4, 3))), rtol=1e-6)
    assert capture.observations.dtype == np.float32
    assert capture.name == "vase"
    assert capture.light_indices == (0, 1, 2, 3)
    assert capture.ground_truth is None
    assert (capture.warnings, capture.mask.shape, capture.mask.all()) == ((), (5, 6), True)
    assert_allclose(capture.light_directions, FOUR_LIGHTS)
    np.savetxt(capture_folder / "light_intensities.txt", INTENSITIES)
    mask = default_rng(4).random((5, 6)) < 0.5
    write_image("vase/mask.png", np.uint8(mask) * 255)
    normals = np.broadcast_to([0.0, 0.6, 0.8], (5, 6, 3))
    np.save(capture_folder / "normals_gt.npy", normals)
    capture = read_capture(capture_folder)
    assert_array_equal(capture.mask, mask)
    assert_allclose(
        capture.observations, expected(photographs, INTENSITIES)[mask.ravel()], rtol=1e-6
    )
    assert_allclose(capture.ground_truth, normals * mask[..., None], atol=1e-7)


def test_only_the_chosen_images_are_read(capture_folder, photographs):
    (capture_folder / "img9.png").write_bytes(b"damaged")
    calls = []
    source = open_capture(capture_folder)
    assert source.n_lights == 4
    assert [path.name for path in source.files.images] == [
        "img8.png",
        "img9.png",
        "img10.png",
        "img11.png",
    ]
    capture = prepare_capture(source, [3, 0, 2], advance=lambda *_: calls.append(1))
    assert len(calls) == 3
    assert capture.light_indices == (3, 0, 2)
    assert_allclose(capture.light_directions, FOUR_LIGHTS[[3, 0, 2]])
    assert_allclose(
        capture.observations, expected(photographs[[3, 0, 2]], np.ones((3, 3))), rtol=1e-6
    )
    with refuses(r"img9\.png: found neither PNG, TIFF, .* nor HEIC"):
        prepare_capture(source)


def test_dark_pixels_are_kept_and_values_outside_the_mask_ignored(capture_folder, write_image):
    for number in range(8, 12):
        (capture_folder / f"img{number}.png").unlink()
        tifffile.imwrite(capture_folder / f"{number}.tif", np.array([[0, np.nan, 2.5]], np.float32))
    write_image("vase/mask.png", np.array([[1, 0, 1]], np.uint8))
    capture = read_capture(capture_folder)
    assert_array_equal(capture.observations, [[0] * 4, [2.5] * 4])
    (warning,) = texts(capture.warnings)
    assert (
        warning.startswith("50.0 % of the pixels are black")
        and "Leave them out with a mask or" in warning
    )
    (capture_folder / "mask.png").unlink()
    with refuses(r"8\.tif: found a value that is not finite"):
        read_capture(capture_folder)


def test_warnings(capture_folder, write_image):
    pixels = np.full((10, 10, 3), 200, np.uint8)
    pixels[0, :5, 1] = 255
    for number in range(8, 12):
        write_image(f"vase/img{number}.png", pixels)
    assert texts(read_capture(capture_folder).warnings) == (
        "5.0 % of the observations are saturated. A shorter exposure gives better normals.",
        "The images have 8 bits, which costs less than 1 degree.",
    )
    for n_black, share in ((1, None), (2, "2.0"), (100, "100.0")):
        for number in range(8, 12):
            pixels = np.full((10, 10), 1, np.uint16)
            pixels.flat[:n_black] = 0
            pixels[9, 9] = number == 8 and n_black < 100  # lit once: not black
            write_image(f"vase/img{number}.png", pixels)
        found = texts(
            warning
            for warning in read_capture(capture_folder).warnings
            if warning.code == "black_pixels"
        )
        assert len(found) == (share is not None)
        assert all(
            text.startswith(f"{share} % of the pixels are black under every light")
            for text in found
        )


@parametrize("scale, spread, warned", [(1, 0.3, False), (600, 0, False), (200, 0.3, True)])
def test_positions_given_as_directions_are_named(tmp_path, scale, spread, warned):
    """Vectors of one length, or of about 1, are directions."""
    lights = ring_lights(8) * scale * (1 + spread * np.linspace(0, 1, 8)[:, None])
    folder = write_capture(tmp_path / "a", np.full((8, 4, 5), 100, np.uint8), lights)
    found = [str(w) for w in read_capture(folder).warnings if w.code == "near_lamps"]
    assert len(found) == warned
    if warned:
        assert "from 200 to 260" in found[0] and "--light-positions" in found[0]


MASK = np.array([[True, False, True], [True, True, False]])


def make(**changes):
    fields = {"name": "vase", "observations": np.arange(16).reshape(4, 4), "mask": MASK}
    return Capture(
        **(fields | {"light_directions": FOUR_LIGHTS, "light_indices": (0, 1, 2, 7)} | changes)
    )


def test_positions_that_cannot_be_meant():
    for positions, message in (
        ([0, 1, -1], "light index -1 is out of range"),
        ([0, 1, 2, 1], "light index 1 is listed twice. List each light once."),
        ([0, 1], "2 lights chosen, expected at least 3."),
    ):
        with refuses(message, UsageError):
            make().choose_lights(positions)


NO_NORMAL = "a ground-truth normal is neither a unit vector nor zero"


@parametrize(
    "changes, message",
    [
        (
            {"observations": np.zeros((5, 4))},
            r"observations of shape \(5, 4\), expected .* = \(4, 4\)",
        ),
        ({"observations": np.full((4, 4), np.nan)}, "an observation is not finite"),
        (
            {"light_directions": FOUR_LIGHTS[:, :2]},
            r"light directions of shape \(4, 2\), expected \(4, 3\)",
        ),
        ({"light_directions": FOUR_LIGHTS * 1.01}, "a light direction is not a unit vector"),
        (
            {"light_directions": FOUR_LIGHTS * [1, 1, -1]},
            r"light 0 is below the horizon \(z <= 0\)",
        ),
        ({"mask": np.zeros((2, 3), bool)}, "the mask is empty"),
        ({"mask": np.ones(4, bool)}, r"a mask of shape \(4,\), expected \(H, W\)"),
        (
            {"ground_truth": np.zeros((3, 2, 3))},
            r"ground truth of shape \(3, 2, 3\), expected .* \(2, 3, 3\)",
        ),
        ({"ground_truth": np.full((2, 3, 3), 0.1)}, NO_NORMAL),
    ],
)
def test_fields_that_do_not_fit(changes, message):
    with refuses(f"vase: {message}"):
        make(**changes)


def test_restored_observations_follow_the_choice():
    restored = np.arange(16).reshape(4, 4) % 3 == 0
    capture = make(restored=restored)
    assert_array_equal(capture.choose_lights([3, 0, 2]).restored, restored[:, [3, 0, 2]])
    chosen = capture.choose_pixels(np.array([0, 3]))
    assert_array_equal(chosen.restored, restored[[0, 3]])
    assert_array_equal(chosen.observations, capture.observations[[0, 3]])
    assert_array_equal(chosen.mask, [[True, False, False], [False, True, False]])
    assert make().choose_lights([0, 1, 2]).restored is None
    with refuses(r"vase: restored flags of shape \(4, 3\), expected .* = \(4, 4\)"):
        make(restored=restored[:, :3])


def test_only_the_damaged_one_of_files_that_are_decoded_at_once_is_refused(tmp_path):
    """The messages of all decoders arrive in one place."""
    content = bytearray(
        cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 255, (400, 400), np.uint8))[1]
    )
    right, damaged = (tmp_path / name for name in ("right.jpg", "damaged.jpg"))
    right.write_bytes(content)
    content[len(content) // 2 : len(content) // 2 + 2] = b"\xff\xd9"  # the end marker
    damaged.write_bytes(content)

    def refuses(path):
        with suppress(InputError):
            return decode_image(path) is None
        return True

    paths = [right, right, damaged, right, right, damaged] * 8
    assert list(in_order(refuses, paths, threads=6)) == [path == damaged for path in paths]


def test_messages_of_the_command_are_not_caught_with_those_of_the_libraries():
    script = """
import os, sys
from contextlib import redirect_stderr
from splinecli.capture.formats.decoders import native_stderr, stderr_is_apart
from splinecli.cli.main import _apart
assert not stderr_is_apart()
with redirect_stderr(_apart(sys.stderr)):
    assert stderr_is_apart()
    with native_stderr() as messages:
        print("12 %", file=sys.stderr)
        os.write(2, b"libpng warning")
assert messages == ["libpng warning"], messages
"""
    assert run_python(script, check=True).stderr == "12 %\n"
