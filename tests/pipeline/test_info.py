"""The options of `info`, and the lines of its report."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

from splinecli.pipeline.capture_memory import REFINED_PIXELS
from splinecli.pipeline.info import ORIGINS, InfoOptions, summary_lines

REPORT = {
    "capture": "cat",
    "layout": "plain folder",
    "images": 2,
    "first_image": "1.png",
    "last_image": "2.png",
    "image_kinds": [{"size": [30, 20], "channels": 3, "type": "uint8"}],
    "reads": None,
    "n_pixels": 600,
    "light_directions": "cat/lights.txt",
    "lamps": None,
    "light_intensities": None,
    "mask": None,
    "ground_truth": None,
    "axis_angle_deg": [1.4, 58.6],
    "white_level": {"value": 255.0, "origin": "full scale"},
    "exposure": {"bright": [0.25, 0.5], "saturated": 0.0123},
    "expect": {"memory_mib": 701, "seconds": 3, "seconds_with_surface": 4},
    "warnings": [],
}


def test_options_are_frozen() -> None:
    options = InfoOptions(capture=Path("cat"))
    with pytest.raises(FrozenInstanceError):
        options.overwrite = True  # type: ignore[misc]


def test_lines_of_a_report() -> None:
    assert summary_lines(REPORT) == [
        "capture      cat (plain folder)",
        "images       2 (1.png ... 2.png): 30 x 20, RGB, 8 bits",
        "lights       cat/lights.txt, 1 to 59 degrees from the camera axis",
        "intensities  none: equal, or estimated where equal ones do not fit",
        "mask         none: all pixels (600 pixels)",
        "ground truth none",
        "white level  255, the full scale of the files",
        "exposure     brightest 1 % from 25 to 50 % of the white level, at most 1.2 % of an image saturated",
        "expect       701 MiB of memory and about 3 s on a laptop, 4 s with --surface",
    ]
    assert "reads        5 x 4 pixels from (1, 2)" in summary_lines(
        {**REPORT, "reads": "5 x 4 pixels from (1, 2)"}
    )
    assert "white level  none: floating-point" in summary_lines({**REPORT, "white_level": None})


def test_the_most_refined_pixels_are_a_tile_with_its_margin() -> None:
    from splinecli.methods.refiner import MARGIN, TILE

    assert REFINED_PIXELS == (TILE + 2 * MARGIN) ** 2


def test_every_origin_of_a_white_level_has_words() -> None:
    from typing import get_args

    from splinecli.capture.restore.white_level import Origin

    assert ORIGINS.keys() == set(get_args(Origin))
