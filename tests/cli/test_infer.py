"""`splinecli infer` on an analytic capture: files, report, choice of lights, batches, and what goes
wrong.
"""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from cli.conftest import EXAMPLE, read_report
from scenes import names_in, parametrize, put, read_image, read_json, to_uint16, write_image
from splinecli.capture.files import IMAGE_SUFFIXES
from splinecli.estimate.methods.estimator import LeastSquares
from splinecli.maths.normals import angle_between_deg, decode_picture
from splinecli.records.output_files import (
    ERROR_MAP,
    FOUND_MASK,
    LIGHT_PLOT,
    MAPS,
    NORMALS,
    PLOTS,
    SURFACE_FILES,
)


def test_writes_the_contract(capture, truth, run, golden):
    result = run(f"infer {capture} --method ls --format png,npy,tiff", err="")
    seconds = read_report()["seconds"]
    line = "out/sphere: 448 pixels, 8 lights, ls, MAE 0.00 deg (median 0.00)"
    assert result.out == f"{line}, {seconds['total']:.1f} s\n"
    assert sum(seconds.values()) == approx(2 * seconds["total"], abs=0.01)
    out = Path("out/sphere")
    golden("report_ls.json", (out / "report.json").read_text("utf-8"))
    assert names_in(out) == set(read_report()["files"])
    assert names_in("out") == {"sphere"}

    normals, mask = np.load(out / "normals.npy"), mask_of(capture) > 0
    assert normals.dtype == np.float32
    # 16-bit images of up to 60000 counts: half a count is 5e-4 degrees, a handful of them at most
    # 5e-3.
    assert angle_between_deg(normals[mask], truth[mask]).max() < 5e-3
    assert not normals[~mask].any()
    assert_array_equal(tifffile.imread(out / "normals.tiff"), normals)
    picture = read_image(out / "normals.png")[..., ::-1]
    assert picture.dtype == np.uint16
    assert angle_between_deg(decode_picture(picture)[mask], normals[mask]).max() < 5e-3
    assert cv2.imread(str(out / "error_map.png")).shape[0] >= mask.shape[0]


def test_albedo_and_preview_where_they_are_asked_for(capture, run):
    run(f"infer {capture} --method ls --maps albedo,preview")
    out = Path("out/sphere")
    assert {"albedo.png", "albedo.npy", "preview.png"} <= set(read_report()["files"])
    albedo = np.load(out / "albedo.npy")
    mask = mask_of(capture) > 0
    # The sphere is 60000 / 65535 white.
    assert_allclose(albedo[mask], 60_000 / 65_535, atol=2e-3)
    assert not albedo[~mask].any()
    assert cv2.imread(str(out / "albedo.png"))[mask].min() >= 254
    preview = cv2.imread(str(out / "preview.png"), cv2.IMREAD_GRAYSCALE)
    # The light comes from the upper left.
    assert preview[6, 6] > preview[12, 12] > preview[17, 17] > preview[0, 0] == 0


def test_a_surface_in_millimetres(capture, run):
    arguments = "--surface --pixel-size 0.1"
    run(f"infer {capture} --method ls {arguments}")
    surface = read_report()["surface"]
    assert surface["unit"] == "millimetre"
    assert surface["pixel_size_mm"] == 0.1
    middle, rim = np.load("out/sphere/depth.npy")[11:13, 11:13].mean(), surface["range"][0]
    assert middle - rim == approx(0.1 * 12 / (2 * 2.5), rel=0.1)
    # One of two rows and columns are read: each pixel of the map is as wide as two of the
    # photographs.
    run(f"infer {capture} --method ls --scale 1/2 {arguments} --overwrite")
    scaled = read_report()["surface"]
    assert scaled["pixel_size_mm"] == 0.2
    assert np.ptp(scaled["range"]) == approx(np.ptp(surface["range"]), rel=0.2)


def test_how_sure_the_network_is(capture, run):
    run(f"infer {capture} --maps confidence --html --overwrite")
    out, mask = Path("out/sphere"), mask_of(capture) > 0
    confidence, report = np.load(out / "confidence.npy"), read_report()
    assert confidence.dtype == np.float32
    assert confidence.shape == mask.shape
    assert not confidence[~mask].any()
    # A matte sphere is the easiest there is, which the network cannot know from one pixel.
    assert report["angular_error_deg"]["under_5"] == 1
    assert 0.5 < confidence[mask].mean() < 1
    assert report["expected_under_5"] == approx(confidence[mask].mean(), abs=1e-4)
    assert_array_equal(read_image(out / "confidence.png"), np.rint(255 * confidence))
    assert 'alt="Confidence map"' in (out / "page.html").read_text("utf-8")
    (capture / "normals_gt.npy").unlink()
    said = run(f"infer {capture} --overwrite").out
    assert f"{confidence[mask].mean():.0%} of them likely within 5 deg" in said


def mask_of(capture):
    return cv2.imread(str(capture / "mask.png"), cv2.IMREAD_GRAYSCALE)


def darken_background(capture):
    """Make the images nearly black outside of the mask, and return this."""
    mask = mask_of(capture)
    for path in capture.glob("image*.png"):
        write_image(path, np.uint16(np.where(mask > 0, read_image(path), 300)))
    return mask


def test_a_mask_is_found_where_there_is_none(capture, run, document):
    mask = darken_background(capture)
    command = f"infer {capture} --method ls --auto-mask --overwrite"
    assert "found_mask.png" not in document(command)["files"]  # the capture's own goes first
    (capture / "mask.png").unlink()
    report = document(command)
    found = read_image("out/sphere/found_mask.png")
    assert ("found_mask.png" in report["files"], report["n_pixels"]) == (
        True,
        np.count_nonzero(found),
    )
    assert (found != mask).mean() < 0.02  # corners are rounded
    run(
        f"infer {capture} --auto-mask --mask out/sphere/found_mask.png --overwrite",
        usage_error="cannot be used together. Leave one out",
    )
    for path in capture.glob("image*.png"):
        write_image(path, np.full(mask.shape, 30_000, np.uint16))
    run(
        f"infer {capture} --method ls --auto-mask -o third",
        input_error=("no mask was found", "--mask"),
    )


def test_photographs_with_a_curve_and_ambient_light(capture, document):
    light = 9_000 / 65_535
    for path in capture.glob("image*.png"):
        linear = read_image(path) / 65_535 * 0.8 + light
        write_image(path, to_uint16(65_535 * linear ** (1 / 2.2)))
    dark = np.full((24, 24), round(65_535 * light ** (1 / 2.2)), np.uint16)
    write_image("dark.png", dark)

    command = f"infer {capture} --method ls --overwrite"
    assert document(f"{command} --transfer linear")["angular_error_deg"]["mean"] > 5
    command += " --transfer gamma:2.2"
    assert document(f"{command} --ambient dark.png")["angular_error_deg"]["mean"] < 0.1
    write_image(capture / "ambient.png", dark)
    found = document(command)
    assert found["angular_error_deg"]["mean"] < 0.1
    text = "ambient.png was subtracted from all images as ambient light."
    assert found["warnings"] == [{"code": "ambient_subtracted", "text": text}]


def test_a_mended_mask_stays(capture, document):
    """A mask that was found, painted over, and given to the next call, which replaces the other
    results.
    """
    Path("out/sphere").mkdir(parents=True)
    painted = np.zeros((24, 24), np.uint8)
    painted[5:15, 5:15] = 255
    write_image("out/sphere/found_mask.png", painted)
    mended = "--mask out/sphere/found_mask.png --overwrite"
    assert document(f"infer {capture} --method ls {mended}")["n_pixels"] == 100
    assert_array_equal(read_image("out/sphere/found_mask.png"), painted)


@parametrize("part", ["--crop 1,2,22,21", "--crop 1,1,22,22 --scale 1/3"])
def test_a_found_mask_of_a_part_is_a_mask_of_the_capture(capture, run, part):
    mask = darken_background(capture)
    (capture / "mask.png").unlink()
    run(f"infer {capture} --method ls --auto-mask {part}")
    found = cv2.imread("out/sphere/found_mask.png", cv2.IMREAD_GRAYSCALE)
    assert found.shape == mask.shape
    given = "--mask out/sphere/found_mask.png -o again"
    run(f"infer {capture} --method ls {given} {part}")
    assert_array_equal(np.load("again/sphere/normals.npy"), np.load("out/sphere/normals.npy"))
    # It is a mask of whole images, too, without gaps between the rows that were read.
    run(f"infer {capture} --method ls {given} --overwrite")
    assert read_json("again/sphere/report.json")["n_pixels"] == np.count_nonzero(found)
    assert cv2.connectedComponents(found)[0] == 2


def test_lights_by_index(capture, document):
    chosen = document(f"infer {capture} --method ls --light-indices 6,0,2")
    assert chosen["n_lights"] == 3
    assert chosen["light_indices"] == [6, 0, 2]


def test_distilled(capture, run, document):
    """A quarter of the pixels are learned."""
    report = document(f"infer {capture} --distil --maps confidence")
    told = report["distillation"]
    assert 0 < told["sample"] <= report["n_pixels"] / 4
    assert told["held_out"] == approx(told["sample"] / 8, abs=1)
    assert told["angle_to_network_deg"]["mean"] < told["expected_error_deg"]
    assert report["angular_error_deg"]["mean"] < 2.5
    assert report["options"]["distil"] is True
    assert read_report()["distillation"] == told
    run(f"infer {capture} --exact", code=5, says="contains results made with")
    assert document(f"infer {capture} --exact --overwrite")["distillation"] is None


def test_output_that_cannot_be_written(capture, run, golden):
    put("out", "a file where the folder should be")
    golden("error_output.txt", run(f"infer {capture} --method ls", code=5).err)


def test_interrupted_while_estimating(capture, run, monkeypatch):
    monkeypatch.setattr(LeastSquares, "estimate", Mock(side_effect=KeyboardInterrupt))
    run(f"infer {capture} --method ls", code=130, out="", err="splinecli: interrupted.\n")
    assert not Path("out").exists()


@pytest.mark.skipif(os.name == "nt", reason="POSIX redirections")
def test_closed_streams_and_ascii_terminals(capture, make_capture):
    make_capture("naïve ☃")

    def call(name, redirection):
        command = (
            f'"{sys.executable}" -m splinecli infer "{name}" --method ls --overwrite {redirection}'
        )
        environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
        return subprocess.run(
            ["sh", "-c", command], stderr=subprocess.PIPE, env=environment
        ).returncode

    assert call("naïve ☃", "> seen.txt") == 0
    assert "na\\xefve" in Path("seen.txt").read_text()
    assert call("sphere", ">&-") == 0
    assert call("sphere", "2>&-") == 0
    if Path("/dev/full").exists():
        assert call("sphere", "> /dev/full") == 5


@parametrize(
    "maps, scales",
    [("relief,curvature,gradient", (1, 0.05)), ("relief:0.5, curvature:0.1,gradient", (0.5, 0.1))],
)
def test_scales_of_pictures(capture, run, maps, scales):
    run(f"infer {capture} --method ls --format npy,tiff --maps", maps)
    assert np.isfinite(np.load(f"out/{capture.name}/gradient.npy")).sum() == 2 * 448
    for name in ("gradient", "relief", "curvature"):
        tiff = tifffile.imread(f"out/{capture.name}/{name}.tiff")
        assert_array_equal(tiff, np.load(f"out/{capture.name}/{name}.npy"))
    for name, scale in zip(("relief", "curvature"), scales, strict=True):
        values = np.atleast_3d(np.load(f"out/{capture.name}/{name}.npy"))[..., 0]
        assert values.dtype == np.float32
        assert np.isfinite(values).sum() == 448
        picture = read_image(f"out/{capture.name}/{name}.png")
        expected = 127.5 + 127.5 * np.clip(np.nan_to_num(values) / scale, -1, 1)
        assert_allclose(picture, expected, atol=0.51)


@parametrize("maps", "albedo:2 relief: relief:dark relief:0 curvature:inf curvature:nan")
def test_scales_that_are_none(capture, run, maps):
    run(f"infer {capture} --method ls --maps {maps}", usage_error=maps.split(":")[0], out="")


def test_each_image_is_opened_at_most_three_times(run):
    """Once for its facts, once for its pixels, and once for the colours of the albedo map."""
    opened, counting = Counter(), [True]

    def count(event, arguments):
        if counting and event == "open" and isinstance(arguments[0], str | os.PathLike):
            opened[Path(arguments[0])] += 1

    sys.addaudithook(count)  # for good, so that it has a switch
    code = run(f"infer {EXAMPLE} --method ls --n-lights 5 --maps albedo").code
    counting.clear()
    assert code == 0
    assert sorted(opened[path] for path in EXAMPLE.glob("[0-9]*.png")) == 5 * [1] + 5 * [3]


def test_no_result_beside_the_images_counts_as_one_of_them(run, document, capture):
    """With every file that infer and integrate write, and the pictures of the other commands."""
    formats = [name for name in NORMALS if name != "exr"]
    arguments = f"infer {capture} --method ls -o . --surface --html"
    maps = ",".join(name for name in MAPS if name != "confidence")  # not of this method
    first = document(f"{arguments} --maps {maps} --format {','.join(formats)}")
    surface = [name for name in SURFACE_FILES if name != "exr"]
    run(f"integrate {capture} --format {','.join(surface)} --overwrite")
    for name in (*PLOTS, LIGHT_PLOT, ERROR_MAP, "confidence.png", FOUND_MASK):
        if not (capture / name).exists():
            write_image(capture / name, np.zeros((24, 24), np.uint8))
    pictures = {path.name for path in capture.glob("*") if path.suffix in IMAGE_SUFFIXES} - {
        "mask.png"
    }
    assert len(pictures) > 8 + 20
    assert document(f"info {capture}")["images"] == 8
    assert document(f"{arguments} --overwrite")["n_lights"] == first["n_lights"] == 8
