"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import JsonOption, OverwriteOption, QuietOption
from splinecli.errors import UsageError
from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights

if TYPE_CHECKING:
    from splinecli.calibration.circle import Circle


def calibrate(
    balls: Annotated[
        list[Path], typer.Argument(metavar="BALL", help="Folders of images of one mirror ball each.")
    ],
    circle: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,R", help="Outline of the ball in pixels, y down. Once for each BALL."),
    ] = None,
    mask: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="Mask image: non-zero pixels belong to the ball. Once for each BALL."
        ),
    ] = None,
    gray_ball: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Images of a matte gray ball under the same lights.")
    ] = None,
    gray_card: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Images of a matte gray card that faces the camera.")
    ] = None,
    transfer: Annotated[
        str,
        typer.Option(
            metavar="CURVE",
            help="Transfer curve of the gray target's images: linear, srgb or gamma:G.",
            autocompletion=lambda: ["linear", "srgb", "gamma:2.2"],
        ),
    ] = "linear",
    compare: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Compare the result with the light directions in a text file."),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder of the results.")
    ] = Path("calibration"),
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
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
