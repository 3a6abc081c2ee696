"""When a network is distilled, and what becomes of a capture that cannot be learned."""

import time
from dataclasses import dataclass
from typing import get_args

import numpy as np

from scenes import Teacher, cap_directions, parametrize, refuses, spiral_lights
from splinecli.capture import Capture
from splinecli.errors import UsageError
from splinecli.estimate.methods.estimator import LeastSquares, StudentSize
from splinecli.pipeline import infer
from splinecli.pipeline.expected_seconds import AUTOMATIC_FROM, expected_seconds
from splinecli.pipeline.infer import distil_for
from splinecli.pipeline.info import ORIGINS
from splinecli.records.output_files import MAPS
from splinecli.records.white_level import Origin

LIGHTS = spiral_lights(6, 40)


def test_alignment_and_maps_are_expected_to_take_time():
    images = (12_000, 10_000_000)  # 12,000 pixels in the mask of ten images of a megapixel
    plain, aligned, material = (
        sum(expected_seconds(*images, **options).values())
        for options in ({}, {"align": True}, {"maps": (MAPS["material"],)})
    )
    assert aligned - plain > 20 and material - plain > 2


@dataclass
class Slow(Teacher):
    """Least squares with an error, or random normals, that takes its time."""

    random: bool = False
    seconds: float = 0.0

    def estimate_with_error(self, observations, light_directions, *, progress=None):
        self.asked += len(observations)
        time.sleep(self.seconds)
        errors = np.tile(np.float32((np.log(np.radians(3)), 0.7)), (len(observations), 1))
        if self.random:
            return cap_directions(len(observations), 80), errors
        return LeastSquares().estimate(observations, light_directions), errors


def capture(count):
    observations = cap_directions(count, 40) @ LIGHTS.T
    return Capture("matte", observations, LIGHTS, tuple(range(6)), np.ones((1, count), bool))


def test_small_captures_and_exact_ones_are_not_distilled():
    teacher = Slow()
    assert distil_for(capture(3000), teacher, None) == (None, [])
    assert distil_for(capture(AUTOMATIC_FROM), teacher, False) == (None, [])
    assert teacher.asked == 0


def test_wanted(monkeypatch):
    monkeypatch.setattr(infer, "student_sizes", lambda _: (StudentSize(750, 50, 16),) * 2)
    teacher = Slow()
    found, warnings = distil_for(capture(3000), teacher, True)
    assert warnings == []
    assert teacher.asked == found.distillation.sample == 750


@parametrize("seconds", [0.0, 0.02])
def test_the_size_decides_about_large_captures_not_the_speed(monkeypatch, seconds):
    """The load of a machine must not change normals."""
    monkeypatch.setattr(infer, "student_sizes", lambda _: (StudentSize(100, 20, 16),) * 2)
    found, warnings = distil_for(capture(AUTOMATIC_FROM), Slow(seconds=seconds), None)
    assert found is not None and warnings == []


def test_what_cannot_be_learned_is_left_to_the_network(monkeypatch):
    sizes = StudentSize(500, 50, 16), StudentSize(900, 50, 16)
    monkeypatch.setattr(infer, "student_sizes", lambda _: sizes)
    teacher = Slow(random=True)
    found, (warning,) = distil_for(capture(3000), teacher, True)
    assert found is None
    assert warning.code == "not_distilled" and "the full network are 2.9 degrees" in warning.text
    assert teacher.asked == 500 + 900  # both sizes were tried


def test_refused():
    for few, estimator, problem in (
        (
            capture(3000),
            LeastSquares(),
            "method ls cannot be distilled, because it does not provide confidence",
        ),
        (capture(200), Slow(), "matte: 200 pixels are too few to distil"),
    ):
        with refuses(problem, UsageError):
            distil_for(few, estimator, True)
        assert distil_for(few, estimator, None) == (None, [])


def test_a_large_capture_with_few_lit_pixels_is_left_to_the_network():
    """Without a mask, most pixels are a black background."""
    dark = capture(AUTOMATIC_FROM)
    dark.observations[100:] = 0
    with refuses("matte: only 100 pixels are lit, which is too few to distil", UsageError):
        distil_for(dark, Slow(), True)
    assert distil_for(dark, Slow(), None) == (None, [])


def test_every_origin_of_a_white_level_has_words():
    assert ORIGINS.keys() == set(get_args(Origin))
