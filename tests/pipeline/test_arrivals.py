"""Captures that arrive in a folder: when each is complete, and that it is returned once."""

import os
import time
from pathlib import Path

import pytest

from scenes import parametrize, put, refuses
from splinecli.pipeline import incoming
from splinecli.pipeline.incoming import Arrivals


class Clock:
    seconds = 0.0

    def __call__(self):
        return self.seconds


def arriving(folder, marker=None, seconds=0, clock=time.monotonic):
    without = folder.parent / "out"
    return Arrivals(folder, marker=marker, seconds=seconds, without=without, clock=clock)


def names(arrivals):
    return " ".join(path.name for path in arrivals.take())


def test_a_capture_is_complete_when_nothing_changes_for_some_time(tmp_path):
    clock = Clock()
    arrivals = Arrivals(
        tmp_path, marker=None, seconds=5, without=tmp_path / "out/results", clock=clock
    )
    files = "part10/1.png part9/images/1.png out/results/part1/normals.png .hidden/1.png loose.png"
    for name in files.split():
        put(tmp_path / name)
    (tmp_path / "empty").mkdir()
    assert not names(arrivals)
    clock.seconds = 4
    put(tmp_path / "part9/images/2.png")
    assert not names(arrivals)
    clock.seconds = 6
    assert names(arrivals) == "part10"
    clock.seconds = 9
    assert names(arrivals) == "part9"
    assert not names(arrivals)
    put(tmp_path / "part10/2.png")
    assert not names(arrivals)
    clock.seconds = 20
    assert names(arrivals) == "part10"


def test_the_files_of_a_capture_that_is_done_are_left_alone(tmp_path, monkeypatch):
    """A folder of a thousand captures would be read again each second."""
    clock, walked = Clock(), list[Path]()
    arrivals = arriving(tmp_path, clock=clock)
    walk = os.walk
    monkeypatch.setattr(os, "walk", lambda capture: walked.append(capture) or walk(capture))
    done, other = tmp_path / "done", tmp_path / "other"
    put(done / "images/1.png")
    put(other / "1.png")
    assert arrivals.take() == [done, other]
    put(done / "images/1.png", "an image that is written in place")
    clock.seconds = 1
    assert not names(arrivals)
    assert walked == [done, other]
    put(other / "2.png")
    assert arrivals.take() == [other]
    assert walked[2:] == [other]
    clock.seconds = 1 + incoming.SECONDS_BETWEEN_FILES
    assert arrivals.take() == [done]


def test_two_at_once_come_in_natural_order_and_one_that_vanishes_is_forgotten(tmp_path):
    arrivals = arriving(tmp_path)
    put(tmp_path / "part10/1.png")
    put(tmp_path / "part9/1.png")
    assert names(arrivals) == "part9 part10"
    (tmp_path / "part9/1.png").unlink()
    (tmp_path / "part9").rmdir()
    assert not names(arrivals)
    put(tmp_path / "part9/1.png")
    assert names(arrivals) == "part9"


def test_a_marker_needs_no_time(tmp_path):
    arrivals = arriving(tmp_path, "done", 5, Clock())
    put(tmp_path / "part/1.png")
    assert not names(arrivals)
    put(tmp_path / "part/done")
    assert names(arrivals) == "part"
    assert not names(arrivals)


def test_films_are_complete_when_they_no_longer_change(tmp_path):
    clock = Clock()
    arrivals = arriving(tmp_path, "done", 5, clock)
    for name in ("clip.mp4", "clip/done", "other.MOV", ".hidden.mp4", "notes.txt"):
        put(tmp_path / name)
    assert names(arrivals) == "clip"
    clock.seconds = 4
    put(tmp_path / "other.MOV", "a longer film")
    clock.seconds = 6
    assert names(arrivals) == "clip.mp4"
    clock.seconds = 12
    assert names(arrivals) == "other.MOV"
    assert not names(arrivals)


@parametrize(
    "files",
    """
clip.mp4 | clip/1.png
in/1.png | images/1.png
""",
)
def test_captures_of_one_name_come_one_after_the_other(tmp_path, files):
    """Together they would end the batch. Results of a folder `images` have its parent's name."""
    arrivals = arriving(tmp_path / "in")
    for name in files:
        put(tmp_path / "in" / name)
    found = [arrivals.take() for _ in range(3)]
    assert [len(paths) for paths in found] == [1, 1, 0] and found[0] != found[1]


@pytest.mark.skipif(os.name == "nt", reason="POSIX links")
def test_links_to_themselves_are_passed_over(tmp_path):
    arrivals = arriving(tmp_path)
    put(tmp_path / "part/1.png")
    for name in ("loop", "loop.mp4"):
        (tmp_path / name).symlink_to(name)
    assert names(arrivals) == "part"


def test_a_folder_that_vanishes_for_a_moment(tmp_path):
    arrivals = arriving(tmp_path / "parts")
    put(tmp_path / "parts/a/1.png")
    assert names(arrivals) == "a"
    (tmp_path / "parts").rename(tmp_path / "away")
    with refuses("the folder cannot be read"):
        arrivals.take()
    (tmp_path / "away").rename(tmp_path / "parts")
    assert names(arrivals) == "a"


def test_a_folder_that_cannot_be_read(tmp_path):
    with refuses("the folder cannot be read"):
        arriving(tmp_path / "nowhere").take()
