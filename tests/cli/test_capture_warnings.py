"""Warnings about a capture, its mask and its values, from the files to the messages of `infer` and
`info`.
"""

import shutil
import warnings
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose

import splinecli
from cli.conftest import read_report
from scenes import (
    parametrize,
    read_image,
    read_json,
    shade,
    sphere,
    spiral_lights,
    to_uint16,
    write_capture,
    write_image,
)
from splinecli.judge import checks
from test_notebook import read_medallion


def move(path, right, down):
    write_image(path, np.roll(read_image(path), (down, right), axis=(0, 1)))


def codes():
    report = read_json("out/medallion/report.json")
    return [warning["code"] for warning in report["warnings"]]


def refused(run, command=""):
    """Run infer with --strict, which must refuse the capture and write nothing;
    return the message.
    """
    result = run(f"infer medallion --strict -o refused {command}", code=3, out="")
    assert not Path("refused/medallion").exists()
    return result.err


def test_shifted_images_are_named(run, medallion):
    move(medallion / "04.png", 2, -1)
    move(medallion / "09.png", 0, 4)
    words = (
        "2 of 10 images are shifted relative to the others, in pixels: 04.png 2 right 1 up, 09.png"
        " 4 down."
    )
    run(f"infer {medallion} --method ls", says=(words, "The images were aligned to"))
    aligned = read_report("medallion")
    assert aligned["mended"] == ["images_shifted"]
    run(f"infer {medallion} --method ls --as-stored --overwrite")
    stored = read_report("medallion")
    assert (stored["mended"], codes()) == ([], ["images_shifted"])
    assert aligned["angular_error_deg"]["mean"] < stored["angular_error_deg"]["mean"]
    assert "images_aligned" in run(f"info {medallion} --json", says=words).json["warning_codes"]
    assert words.removesuffix(".") in refused(run, "--method ls")


def test_a_camera_that_moved_once(run, medallion):
    for number in range(1, 6):
        move(medallion / f"{number:02}.png", 4, 4)
    run(f"info {medallion}", says="5 of 10 images are shifted relative to the others")


def test_exchanged_images_take_their_intensities_along(run, medallion):
    one, other = medallion / "03.png", medallion / "08.png"
    order = [0, 1, 7, 3, 4, 5, 6, 2, 8, 9]
    lights = np.loadtxt(medallion / "light_directions.txt")
    one.rename("one.png")
    other.rename(one)
    Path("one.png").rename(other)
    run(f"infer {medallion} --method ls", says="They and the intensities were corrected")
    assert codes() == ["lights_mended"]
    assert_allclose(np.loadtxt("out/medallion/mended_lights.txt"), lights[order], atol=1e-5)


def test_the_same_file_under_two_lights(run, medallion):
    """Each colour of the medallion has its own intensity, so equal files give unequal
    observations.
    """
    for copy, original in (("02", "01"), ("07", "03")):
        shutil.copy(medallion / f"{original}.png", medallion / f"{copy}.png")
    words = (
        "01.png and 02.png are the same image (and 1 more pair), but their lights differ. Remove"
        " one,"
    )
    run(f"infer {medallion} --method ls", says=words)
    assert codes() == ["repeated_images"]
    assert words.removesuffix(" Remove one,") in refused(run, "--method ls")


@parametrize(
    "signs, negated, code",
    [((1, 1, -1), "z", "ground_truth_z"), ((1, -1, 1), "y", "ground_truth_frame")],
)
def test_ground_truth_in_another_frame(run, medallion, signs, negated, code):
    (medallion / "normals_gt.png").rename("truth.png")
    picture = read_image("truth.png")[..., ::-1]
    normals = picture / np.iinfo(picture.dtype).max * 2 - 1
    np.save(medallion / "normals_gt.npy", normals * signs)
    run(
        f"infer {medallion} --method ls",
        says=f"degrees with {negated} negated: it is probably in this frame",
    )
    assert codes() == [code]
    assert f"with {negated} negated" in refused(run, "--method ls")
    evaluation = run(f"evaluate {medallion} --method ls --n-lights 8 --trials 1")
    assert (
        f"degrees with {negated} negated: it is probably in this frame"
        in evaluation.out + evaluation.err
    )


def test_lights_that_crowd(run, medallion):
    given = np.loadtxt(medallion / "light_directions.txt")
    for change, words in (
        ((0.1, 0.1, 1), "are in a narrow cone"),
        ((1, 0.05, 1), "are nearly in one plane"),
    ):
        np.savetxt(medallion / "light_directions.txt", given * change)
        run(f"info {medallion}", says=f"All lights {words}")
    run(f"infer {medallion} --method ls")
    assert "lights_ill_conditioned" in codes()


def test_images_of_which_the_network_makes_little(run, medallion, monkeypatch, rng):
    """Noise in place of photographs, on an object of few pixels. The usual limit is nearer to what
    the network says.
    """
    monkeypatch.setattr(checks, "LEAST_EXPECTED", 0.3)
    for path in medallion.glob("[01]*.png"):
        shape = read_image(path).shape
        write_image(path, np.uint16(65_535 * rng.uniform(size=shape) ** 4))
    mask = np.zeros(shape[:2], np.uint8)
    mask[60:68, 60:68] = 255
    write_image(medallion / "mask.png", mask)
    run(f"infer {medallion}", says="The network predicts errors below 5 degrees for only")
    assert "low_confidence" in codes()
    assert "The network predicts errors below 5 degrees for only" in refused(run)


def test_python_gives_the_same_warnings(medallion):
    move(medallion / "04.png", 2, -1)
    images, lights, intensities, mask = read_medallion(medallion)
    lights *= (1, -1, 1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        estimate = splinecli.estimate_normals(
            images, lights, mask, light_intensities=intensities, method="ls"
        )
    # arrays cannot be aligned
    found = [warning.code for warning in estimate.capture.warnings]
    assert found == ["lights_mended", "images_shifted"]
    assert estimate.capture.mended == ("light_frame",)
    assert [str(warning.message) for warning in caught] == [
        str(w) for w in estimate.capture.warnings
    ]
    assert all(warning.filename == __file__ for warning in caught)
    assert "as_stored=True keeps them as given" in str(caught[0].message)
    assert "images[3] 2 right 1 up" in str(caught[1].message)


LIGHTS = spiral_lights(10, 55, 12)


def ball(*, background=0.0):
    """Images (F, H, W) from 0 to 1 of a ball before a plane of this brightness, and its mask."""
    normals, mask = sphere(80)
    normals, mask = (
        np.pad(array, ((16, 16), (16, 16), *((0, 0),) * (array.ndim - 2)))
        for array in (normals, mask)
    )
    plane = (
        background * np.random.default_rng(1).uniform(0.6, 1, mask.shape)[..., None] * LIGHTS[:, 2]
    )
    images = np.where(mask[..., None], 0.7 * shade(normals, LIGHTS, noise=0.002), plane)
    return np.moveaxis(images, 2, 0), mask


def stored(images, full_scale=65_535):
    return to_uint16(images * full_scale)


def codes_of(run, command):
    return run(f"info --json {command}").json["warning_codes"]


@parametrize("background", [0.0, 0.6])
def test_an_inverted_mask(run, background):
    images, mask = ball(background=background)
    right = write_capture(Path("right"), stored(images), LIGHTS, mask=mask)
    wrong = write_capture(Path("wrong"), stored(images), LIGHTS, mask=~mask)
    assert codes_of(run, right) == []
    found = codes_of(run, wrong)
    assert "mask_inverted" in found and "dark_images" not in found
    run(
        f"infer {wrong} --method ls --strict",
        input_error="mask.png excludes a bright area in the middle",
    )


def test_a_mask_around_a_dark_hole_is_right(run):
    images, mask = ball(background=0.6)
    images[:, mask] *= 0.02
    assert "mask_inverted" not in codes_of(
        run, write_capture(Path("frame"), stored(images), LIGHTS, mask=~mask)
    )


def test_twelve_bits_in_files_of_sixteen(run):
    images, mask = ball()
    folder = write_capture(Path("twelve"), stored(images, 4095), LIGHTS, mask=mask)
    result = run(
        f"info {folder} --json",
        says=("as in 16-bit files from a 12-bit camera", "--white-level 4095"),
    )
    assert result.json["warning_codes"] == ["white_level"]
    assert codes_of(run, f"{folder} --white-level 4095") == []


def test_dark_values_of_sixteen_bits_are_dark(run):
    """Shifted to fill 16 bits, as PNG asks for, values of 12 bits have a common divisor."""
    images, mask = ball()
    dark = stored(images / 40, 4095) * np.uint16(16)
    assert codes_of(run, write_capture(Path("dark"), dark, LIGHTS, mask=mask)) == ["dark_images"]


@parametrize(
    ("share", "words", "is_dark"),
    [
        (0.9, "The images have 8 bits, which costs less than 1 degree.", False),
        (0.4, "The images have 8 bits and use 40 % of the range, which costs up to 1.2", False),
        (0.2, "The images have 8 bits and use 20 % of the range, which costs up to 2.5", True),
        (
            0.1,
            "10 of 10 images use less than 25 % of the range, such as 000.png. A longer exposure",
            True,
        ),
    ],
)
def test_what_8_bits_cost_depends_on_the_exposure(run, share, words, is_dark):
    images, mask = ball()
    images *= share / np.quantile(images[:, mask], 0.99, axis=1).max()
    eight = np.uint8(stored(images, 255))
    write_capture(Path("eight"), eight, LIGHTS, mask=mask)
    found = run("info eight --json", says=words).json["warning_codes"]
    assert found == ["eight_bit", *["dark_images"] * is_dark]


@parametrize("others", [False, True])
def test_one_file_of_another_scale(run, others):
    images, mask = ball()
    values = stored(images, 4095 if others else 65_535)
    values[4] = stored(images[4], 65_535 if others else 4095)
    folder = write_capture(Path("mixed"), values, LIGHTS, mask=mask)
    assert "image_scale" in codes_of(run, folder)
    run(
        f"infer {folder} --method ls --strict",
        code=3,
        says=(
            f"004.png is 16 times {'brighter' if others else 'darker'}",
            f"scale it by 2^{-4 if others else 4}",
        ),
    )
    picture = read_image(folder / "004.png")
    write_image(folder / "004.png", picture // 16 if others else picture * np.uint16(16))
    assert "image_scale" not in codes_of(run, folder)
