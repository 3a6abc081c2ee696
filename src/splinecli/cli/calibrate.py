"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from splinecli.cli.console import Messages
from splinecli.cli.options import inputs, outputs
from splinecli.errors import UsageError
from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights

if TYPE_CHECKING:
    from splinecli.calibration.circle import Circle


def calibrate(
    balls: inputs.Balls,
    circle: inputs.Circles = None,
    mask: inputs.BallMasks = None,
    gray_ball: inputs.GrayBall = None,
    gray_card: inputs.GrayCard = None,
    transfer: inputs.GrayTransfer = "linear",
    compare: outputs.Compare = None,
    output: outputs.CalibrationFolder = Path("calibration"),
    overwrite: outputs.Overwrite = False,
    as_json: outputs.Json = False,
    quiet: outputs.Quiet = False,
) -> None:
    """Measure light directions from images of mirror balls.

    A BALL is a folder with one image for each light, in the order of the lights. The outline of the ball comes from
    --circle, from a mask (--mask, or a file named mask in the folder), or from an image named ref or the mean of all
    images, where it is detected. The brightest spot in the ball is the lamp. Directions of several balls are averaged.

    Writes OUT/light_directions.txt for the option --lights of infer, calibration.png to check the result by eye, and
    calibration.json. With a gray ball or card, it also writes light_intensities.txt, the relative light intensities.
    """
    options = CalibrateOptions(
        balls=tuple(balls),
        circles=tuple(_parse_circle(text) for text in circle or ()),
        masks=tuple(mask or ()),
        gray_ball=gray_ball,
        gray_card=gray_card,
        transfer=transfer,
        compare=compare,
        output=output,
        overwrite=overwrite,
    )
    report = calibrate_lights(options, Messages(quiet=quiet))
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        print(output / DIRECTIONS)


def _parse_circle(text: str) -> Circle:
    from splinecli.calibration.circle import Circle

    try:
        x, y, radius = (float(word) for word in text.split(","))
        if radius > 0 and abs(x) + abs(y) + radius < float("inf"):
            return Circle(x, y, radius)
    except ValueError:
        pass
    raise UsageError(f"--circle is {text!r}; expected X,Y,R in pixels, such as 512,384,200")
