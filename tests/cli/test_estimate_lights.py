"""`--lights estimate` of infer, info and evaluate."""

import base64
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.formats.test_film import path_of_lamp, sphere_film, write_film
from cli.test_schema import check
from scenes import cap_directions, codes, put, read_image, shade, sphere, write_capture, write_image
from splinecli.maths.normals import angle_between_deg

LIGHTS = cap_directions(10, 50, 4, even=True)


@pytest.fixture
def unlit():
    """A matte sphere without a light file, `ball` in the working folder."""
    normals, inside = sphere(64)
    images = shade(normals, LIGHTS, noise=0.002) * inside[..., None]
    pictures = np.moveaxis(np.uint16(images.clip(0, 1) * 60_000), 2, 0)
    truth = np.float32(normals * inside[..., None])
    return write_capture(Path("ball"), pictures, None, mask=inside, normals=truth)


def test_infer(unlit, run, document):
    report = document(f"infer {unlit} --lights estimate --method ls --html")
    check(report, "Report")
    assert report["light_file"] is None
    assert "estimated_lights" in codes(report)
    assert {"light_directions.txt", "lights.png"} <= set(report["files"])
    error = angle_between_deg(np.loadtxt("out/ball/light_directions.txt"), LIGHTS).mean()
    assert error < 5 and error < 3 * np.mean(report["light_errors_deg"])
    picture = Path("out/ball/lights.png").read_bytes()
    assert cv2.imread("out/ball/lights.png") is not None
    assert base64.b64encode(picture).decode() in Path("out/ball/page.html").read_text()
    # The files give the same normals again.
    intensities = Path("out/ball/light_intensities.txt")
    given = f"--intensities {intensities if intensities.exists() else 'equal'}"
    lights = "--lights out/ball/light_directions.txt"
    run(f"infer {unlit} {lights} --method ls -o again {given}")
    np.testing.assert_allclose(
        np.load("again/ball/normals.npy"), np.load("out/ball/normals.npy"), atol=2e-4
    )


def test_lights_are_estimated_if_there_is_no_light_file(unlit, run, document):
    """With the mask found in the images, if there is none, and only where nobody asks for more."""
    (unlit / "mask.png").unlink()
    report = document(f"infer {unlit} --method ls")
    assert "because the capture has no light file" in str(report["warnings"])
    assert report["light_source"] == "estimated"
    assert angle_between_deg(np.loadtxt("out/ball/light_directions.txt"), LIGHTS).mean() < 5
    assert Path("out/ball/found_mask.png").exists()
    info = document(f"info {unlit}")
    assert info["light_source"] == "estimated" and info["mask"] == "found in the images"
    for options in ("--strict", "--light-frame x-left", "--refine-lights"):
        says = ("--lights estimate", "splinecli calibrate")
        run(f"infer {unlit} {options} -o other", input_error=says)
    run(f"infer {unlit} --lights none.txt -o other", input_error="none.txt")
    for image in sorted(unlit.glob("*.png"))[5:]:
        image.unlink()
    run(f"infer {unlit} -o other", input_error="5 images")
    assert not Path("other").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_batch_gives_its_advice_once(unlit, run, workers):
    """Of the second capture, only what differs is said."""
    image = sorted(unlit.glob("*[0-9].png"))[3]
    write_image(image, read_image(image) // 2)
    shutil.copytree(unlit, "other")
    err = run(f"infer {unlit} other --method ls --workers {workers}").err
    for advice in ("add --lights FILE", "Use --intensities FILE if you have measured them"):
        assert err.count(advice) == 1, err
    for found in ("directions were .*[0-9] degrees on average", "intensities were .* times their"):
        names = re.findall(f"warning: (ball|other): The light {found}", err)
        assert sorted(names) == ["ball", "other"]


def test_a_light_file_of_the_user_is_kept(unlit, run):
    """Here, the results go into the folder of the capture."""
    own = "\n".join("0 0 1" for _ in LIGHTS)
    put(unlit / "light_directions.txt", own)
    command = f"infer {unlit} --lights estimate --intensities equal --method ls -o ."
    run(command, code=5, says="not written by an earlier run")
    assert (unlit / "light_directions.txt").read_text() == own
    (unlit / "light_directions.txt").unlink()
    run(command)
    # Its own files are replaced, and removed where the lights are no longer estimated.
    run(f"{command} --overwrite")
    np.savetxt("given.txt", LIGHTS)
    run(f"infer {unlit} --lights given.txt --method ls -o . --overwrite")
    assert not (unlit / "light_directions.txt").exists()


def test_info(unlit, run, document):
    report = document(f"info {unlit} --lights estimate --plot sky/lights.png")
    assert angle_between_deg(np.array(report["estimated_lights"]["directions"]), LIGHTS).mean() < 5
    assert report["light_directions"] is None and "estimated_lights" in report["warning_codes"]
    assert "estimated from the images" in run(f"info {unlit} --lights estimate").out


def test_evaluate(unlit, run):
    np.savetxt(unlit / "light_directions.txt", LIGHTS)
    put(unlit / "light_intensities.txt", "1\n" * len(LIGHTS))
    arguments = f"evaluate {unlit} --method ls --n-lights 8 --trials 2 --json -o scores"
    given = run(arguments).json
    estimated = run(
        f"{arguments} --lights estimate", says="the mean error of the estimated light directions is"
    ).json
    check(estimated, "Results")
    assert given["results"][0]["found_light_error_deg"] is None
    error = estimated["results"][0]["found_light_error_deg"]
    assert 0 < error < 6
    assert given["results"][0]["mae_deg"] < estimated["results"][0]["mae_deg"] < error + 3
    assert estimated["protocol"]["lights_estimated"]


def test_first_light(unlit, run):
    """The whole image: it shows no outline."""
    (unlit / "mask.png").unlink()
    crop = f"infer {unlit} --crop 16,16,32,32 --lights estimate --method ls"
    for command in (crop, f"info {unlit} --crop 16,16,32,32 --lights estimate"):
        says = ("--mask FILE", "the light of 000.png comes from: --first-light left, upper-left")
        result = run(command, input_error=says)
        assert result.err.startswith("splinecli: ball: the images do not show whether")
    side = str(np.degrees(np.arctan2(LIGHTS[0, 1], LIGHTS[0, 0])))
    run(f"{crop} --first-light {side}")
    assert angle_between_deg(np.loadtxt("out/ball/light_directions.txt"), LIGHTS).mean() < 15
    np.savetxt(unlit / "light_directions.txt", LIGHTS)
    run(f"infer {unlit} --first-light {side} -o given", usage_error="Add --lights estimate")
    words = "found 'north' as the side of the first light, expected one of right,"
    run(f"{crop} --first-light north", usage_error=words)


def test_contradictions(unlit, run):
    for command in (
        "infer --light-distance 100",
        "infer --light-positions x.txt",
        "infer --light-frame x-left",
        "infer --light-format azel",
        "infer --refine-lights",
        "evaluate --refine-lights",
        "evaluate --light-noise-deg 2",
    ):
        run(f"{command} {unlit} --lights estimate", usage_error="--lights estimate")
    run(f"info {unlit} --check-lights", usage_error="but the lights are estimated")
    assert not Path("out").exists()


def test_a_film(run, document):
    lights = path_of_lamp(120)
    film = write_film(Path("clip.avi"), sphere_film(lights))
    mask = sphere(96)[1]
    write_image("mask.png", np.uint8(mask) * 255)
    command = f"infer {film} --lights estimate --mask mask.png --method ls"
    report = document(command)
    check(report, "Report")
    frames = sorted(Path("out/frames/clip").glob("*.png"))
    assert report["capture"] == "clip" and report["n_lights"] == len(frames) <= 24
    true = lights[[int(frame.stem.removeprefix("frame-")) for frame in frames]]
    assert angle_between_deg(np.loadtxt("out/clip/light_directions.txt"), true).mean() < 6
    normals = np.load("out/clip/normals.npy")
    assert angle_between_deg(normals[mask], sphere(96)[0][mask]).mean() < 6
    # The frames are a capture of their own, and stay while the film does.
    document("infer out/frames/clip --lights out/clip/light_directions.txt -o b --method ls")
    times = [frame.stat().st_mtime_ns for frame in frames]
    run(command, says="already done")
    assert [frame.stat().st_mtime_ns for frame in frames] == times
    # Of another film, nothing is replaced without --update.
    write_film(film, sphere_film(lights[::-1].copy()))
    run(command, code=5, says=("frames of another video", "--update"))
    assert [frame.stat().st_mtime_ns for frame in frames] == times
    run(f"{command} --update")
    assert sorted(Path("out/frames/clip").glob("*.png")) != frames
    # Nothing else counts as a frame, and a damaged frame is taken again.
    first = min(Path("out/frames/clip").glob("*.png"))
    whole = first.read_bytes()
    first.write_bytes(b"")
    run(f"{command} --overwrite")
    assert first.read_bytes() == whole
    Path("out/frames/clip/mask.png").write_bytes(whole)
    run(f"{command} --overwrite", code=5, says="contains mask.png, which is not a frame")
    Path("out/frames/clip/mask.png").unlink()
    assert "from the camera axis" in run(f"info {film} --lights estimate --mask mask.png").out


def test_films_that_cannot_be_used(run):
    film = write_film(Path("clip.avi"), sphere_film(np.repeat(path_of_lamp(1), 10, axis=0)))
    film.with_name("...mp4").write_bytes(film.read_bytes())
    for code, arguments, words in (
        (2, f"{film} --light-frame x-left", "Leave out options that refer to given lights"),
        (
            3,
            f"{film} --lights estimate",
            "clip.avi: only 1 of 10 frames are sharp and under different lights",
        ),
        (3, "none.mp4 --lights estimate", "the video does not exist"),
        # a name that would lead out of OUT/frames is none of a film
        (3, "...mp4 --lights estimate", ""),
    ):
        run(f"infer {arguments}", code=code, says=words)
    assert not Path("out/frames").exists()


def test_a_planted_record_of_a_film_deletes_nothing(run):
    film = write_film(Path("clip.avi"), sphere_film(path_of_lamp(60)))
    Path("out/frames/clip").mkdir(parents=True)
    own = Path("out/frames/clip/frame-holiday.png")
    own.write_bytes(b"mine")
    frames = dict.fromkeys([own.name, *(f"frame-00000{i}.png" for i in range(6))], 4)
    record = {"film": "x", "sha256": "y", "frames": frames}
    put("out/frames/clip/film.json", json.dumps(record))
    run(f"infer {film} --lights estimate --update", code=5)
    assert own.read_bytes() == b"mine"
