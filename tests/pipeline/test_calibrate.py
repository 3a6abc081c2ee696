"""The options of `calibrate`, and the command without a terminal."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest

from splinecli.calibration.circle import Circle
from splinecli.errors import InputError, OutputError, UsageError
from splinecli.pipeline.calibrate import CalibrateOptions, calibrate_lights

BALLS = (Path("one"), Path("two"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transfer": "srgb"}, "--transfer needs --gray-ball or --gray-card"),
        ({"transfer": "sRGB"}, "the transfer curve is 'sRGB'"),
        ({"gray_ball": Path("a"), "gray_card": Path("b")}, "contradict each other. Leave one out"),
        ({"circles": (Circle(1, 1, 1),)}, "--circle is given once for 2 balls"),
        ({"masks": (Path("a"),) * 3}, "--mask is given 3 times for 2 balls"),
    ],
)
def test_options_that_contradict_each_other(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        CalibrateOptions(balls=BALLS, **options)


def test_options_are_frozen() -> None:
    options = CalibrateOptions(balls=BALLS, gray_card=Path("card"), transfer="gamma:2.2")
    assert options.curve == 2.2
    with pytest.raises(FrozenInstanceError):
        options.transfer = "linear"  # type: ignore[misc]


def test_files_are_checked_before_images_are_read(tmp_path: Path) -> None:
    """A wrong path is reported at once: the images here are not images, which only reading them would show."""
    ball = tmp_path / "ball"
    ball.mkdir()
    (ball / "1.png").write_bytes(b"not an image")
    output = tmp_path / "out"
    for options, missing in (
        ({"compare": tmp_path / "missing.txt"}, "missing.txt: the file does not exist"),
        ({"gray_card": tmp_path / "missing"}, "missing: the folder does not exist"),
    ):
        with pytest.raises(InputError, match=missing):
            calibrate_lights(CalibrateOptions(balls=(ball,), output=output, **options))
    output.mkdir()
    (output / "calibration.json").touch()
    with pytest.raises(OutputError, match=r"calibration\.json"):
        calibrate_lights(CalibrateOptions(balls=(ball,), output=output))
