"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from __future__ import annotations

from pathlib import Path

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import inputs, outputs
from splinecli.cli.options.values import parse_circle
from splinecli.cli.records import record_from
from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights


def calibrate(
    balls: list[Path] = inputs.BALLS,
    circle: list[str] | None = inputs.CIRCLES,
    mask: list[Path] | None = inputs.BALL_MASKS,
    ball_diameter: float | None = inputs.BALL_DIAMETER,
    camera_matrix: Path | None = inputs.BALL_CAMERA_MATRIX,
    gray_ball: Path | None = inputs.GRAY_BALL,
    gray_card: Path | None = inputs.GRAY_CARD,
    transfer: str = inputs.GRAY_TRANSFER,
    compare: Path | None = outputs.COMPARE,
    output: Path = outputs.CALIBRATION_FOLDER,
    overwrite: bool = outputs.OVERWRITE,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> None:
    """Measure light directions from images of mirror balls.

    A BALL is a folder with one image for each light, in the order of the lights. The outline of the ball comes from
    --circle or a mask (--mask, or a file named mask in the folder). Otherwise it is detected in an image named ref, or
    in the mean of all images. The brightest spot in the ball is the lamp. Directions of several balls are averaged.

    Writes OUT/light_directions.txt for the option --lights of infer, calibration.png to check the result by eye, and
    calibration.json. With a gray ball or card, it also writes light_intensities.txt, the relative light intensities.
    With two balls or more, or one ball at two places, lamps that are near and a known camera, it also writes
    light_positions.txt, pixel_size.txt and camera_matrix.txt for --light-positions of infer.
    """
    options = record_from(
        CalibrateOptions,
        locals(),
        circles=tuple(parse_circle(text) for text in circle or ()),
        masks=tuple(mask or ()),
    )
    report = calibrate_lights(options, Messages(quiet=quiet))
    print_report(report, str(output / DIRECTIONS), as_json=as_json, quiet=quiet)
