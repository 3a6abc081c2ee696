"""Films of an analytic sphere, written by OpenCV: which frames are taken, and what is refused."""

import os
import shutil

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_array_equal

from scenes import directions_at, parametrize, refuses, run_python, shade, sphere
from splinecli.capture.formats.facts import read_header
from splinecli.capture.formats.film import (
    FEWEST_FRAMES,
    MOST_FRAMES,
    choose_frames,
    is_film,
    read_frames,
)
from splinecli.maths.transfer import BT709
from splinecli.pictures.maps import encode_png

SIZE = 96


def encode_bt709(linear):
    """The curve of ITU-R BT.709, from its text."""
    return np.where(linear < 0.018, 4.5 * linear, 1.099 * np.maximum(linear, 1e-9) ** 0.45 - 0.099)


def sphere_film(lights, texture=0.3):
    """Frames (F, SIZE, SIZE) of a matte sphere with fine texture, under lights (F, 3),
    with noise.
    """
    normals, inside = sphere(SIZE)
    rng = default_rng(1)
    albedo = inside * (0.9 - texture * rng.uniform(size=inside.shape))
    linear = np.moveaxis(shade(normals, lights), 2, 0) * albedo
    linear = linear + 0.003 * rng.normal(size=linear.shape)
    return np.uint8(np.rint(255 * encode_bt709(linear.clip(0, 1))))


def write_film(path, frames, codec="MJPG"):
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, frames.shape[:0:-1])  # type: ignore[attr-defined]
    assert video.isOpened()
    for frame in frames:
        video.write(cv2.merge([frame, frame, frame]))
    video.release()
    return path


def path_of_lamp(count):
    """Lights (count, 3) along a slow spiral, as a lamp is carried."""
    return directions_at(np.linspace(0, 6 * np.pi, count), np.radians(np.linspace(15, 50, count)))


@parametrize(
    "name, codec",
    """
clip.avi | MJPG
clip.mp4 | mp4v
""",
)
def test_frames_under_different_lights_are_chosen(tmp_path, name, codec):
    lights, frames = path_of_lamp(150), sphere_film(path_of_lamp(150))
    film = write_film(tmp_path / name, frames, codec)
    chosen = choose_frames(film)
    assert FEWEST_FRAMES <= len(chosen) <= MOST_FRAMES and list(chosen) == sorted(set(chosen))
    # They cover the path: each light has a chosen one near it.
    assert (lights @ lights[list(chosen)].T).max(axis=1).min() > np.cos(np.radians(20))
    for number, found in zip(chosen, read_frames(film, chosen), strict=True):
        assert found.shape == (SIZE, SIZE, 3)
        assert np.abs(found.mean(axis=2) - frames[number]).mean() < 6  # compression


def test_blurred_overexposed_and_dark_frames_are_not_chosen(tmp_path):
    frames = sphere_film(path_of_lamp(120))
    blurred, bright, dark = range(20, 24), range(60, 63), range(90, 94)
    for number in blurred:
        frames[number] = cv2.GaussianBlur(frames[number], (0, 0), 3)
    frames[bright] = np.uint8(np.minimum(frames[bright] * 2.5, 255))
    frames[dark] //= 8
    chosen = choose_frames(write_film(tmp_path / "clip.avi", frames))
    assert not {*blurred, *bright, *dark}.intersection(chosen)


@parametrize("number, curve", [(1, BT709), (8, 1.0), (13, None)])
def test_code_points_go_before_other_curves(tmp_path, number, curve):
    """cICP, ITU-T H.273: BT.709, linear and sRGB. 16 and 18 are those of films with a high dynamic
    range.
    """
    file = encode_png(np.zeros((4, 4), np.uint8), film=True)
    place = file.index(b"cICP") + 5
    for value, expected in ((number, (curve, False)), (16, (1.0, True))):
        (tmp_path / "image.png").write_bytes(file[:place] + bytes([value]) + file[place + 1 :])
        found = read_header(tmp_path / "image.png").curve
        assert (found.curve, found.unread) == expected


def test_what_is_no_film_or_truncated_is_refused(tmp_path):
    for content, problem in (
        (b"", "is not a video"),
        (b"#EXTM3U\n#EXTINF:1,\nother.ts\n", "is not a video"),
        (b"ffconcat version 1.0\nfile other.mp4\n", "is not a video"),
        (b"\0\0\0\x18ftypisom" + bytes(200), "the video is damaged"),
    ):
        path = tmp_path / "clip.mp4"
        path.write_bytes(content)
        assert is_film(path)
        with refuses(problem):
            choose_frames(path)
    for name, codec, message in (
        ("clip.mp4", "mp4v", "damaged"),  # the index at the end is missing
        ("clip.avi", "MJPG", r"incomplete: only \d+ of 40 frames|damaged"),
    ):
        film = write_film(tmp_path / name, sphere_film(path_of_lamp(40)), codec)
        film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
        with refuses(message):
            choose_frames(film)


def test_a_film_whose_name_is_not_utf8(tmp_path):
    """OpenCV crashes on such a name."""
    film, other = tmp_path / "clip.mp4", tmp_path / os.fsdecode(b"clip-\xff.mp4")
    write_film(film, sphere_film(path_of_lamp(60)), "mp4v")
    try:
        shutil.copy(film, other)
    except OSError:
        pytest.skip("the file system has no such names")
    chosen = choose_frames(other)
    assert chosen == choose_frames(film)
    assert_array_equal(list(read_frames(other, chosen)), list(read_frames(film, chosen)))


def test_what_ffmpeg_prints_of_a_damaged_film_is_caught(tmp_path):
    """Its threads also print between the calls, so a process of its own reads the film, slowly."""
    rng = default_rng(2)
    film = write_film(tmp_path / "clip.avi", sphere_film(path_of_lamp(100)), "XVID")
    content = bytearray(film.read_bytes())
    for place in rng.integers(9000, len(content) - 9000, 100):
        content[place] ^= 0xFF
    film.write_bytes(content)
    code = """
import sys, time
from pathlib import Path
from splinecli.capture.formats.film import read_frames
for _ in read_frames(Path(sys.argv[1]), range(0, 60, 2)):
    time.sleep(0.01)
"""
    done = run_python(code, film)
    assert (done.returncode, done.stderr) == (0, "")
