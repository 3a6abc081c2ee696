"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from __future__ import annotations

from pathlib import Path

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import inputs, outputs
from splinecli.cli.options.values import parse_circle
from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights


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
        circles=tuple(parse_circle(text) for text in circle or ()),
        masks=tuple(mask or ()),
        gray_ball=gray_ball,
        gray_card=gray_card,
        transfer=transfer,
        compare=compare,
        output=output,
        overwrite=overwrite,
    )
    report = calibrate_lights(options, Messages(quiet=quiet))
    print_report(report, str(output / DIRECTIONS), as_json=as_json, quiet=quiet)
