"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from pathlib import Path

from typer import Argument, Option

from splinecli.cli import shared
from splinecli.cli.console import Messages, print_report


def calibrate(
    balls: list[Path] = Argument(..., metavar="BALL", help="Folders of images of one mirror ball each."),
    circle: list[str] | None = Option(
        None, metavar="X,Y,R", help="Outline of the ball in pixels, y down. May be repeated, once for each BALL."
    ),
    mask: list[Path] | None = Option(
        None, metavar="FILE", help=f"{shared.MASK_IMAGE.format('ball')} May be repeated, once for each BALL."
    ),
    ball_diameter: float | None = Option(
        None,
        metavar="D",
        help="Diameter of each ball in any unit, such as millimeters: the unit of the lamps' positions."
        " [default: pixels]",
    ),
    camera_matrix: Path | None = Option(
        None,
        metavar="FILE",
        help="Text file of the 3 x 3 camera matrix in pixels. [default: focal length from EXIF, or a distant camera]",
    ),
    gray_ball: Path | None = Option(None, metavar="DIR", help="Images of a matte gray ball under the same lights."),
    gray_card: Path | None = Option(None, metavar="DIR", help="Images of a matte gray card that faces the camera."),
    transfer: str = Option(
        "auto",
        metavar="CURVE",
        help="Transfer curve of the gray target's images: auto, linear, srgb or gamma:G.",
        autocompletion=shared.complete_curves,
    ),
    compare: Path | None = Option(
        None, metavar="FILE", help="Compare the result with the light directions in a text file."
    ),
    output: Path = Option(Path("calibration"), "--output", "-o", metavar="OUT", help="Folder of the results."),
    overwrite: bool = shared.OVERWRITE,
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
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
    given = locals()

    from splinecli.pipeline.calibrate import DIRECTIONS, CalibrateOptions, calibrate_lights

    circles = tuple(shared.parse_circle(text) for text in circle or ())
    options = shared.record_from(CalibrateOptions, given, circles=circles, masks=tuple(mask or ()))
    report = calibrate_lights(options, Messages(quiet=quiet))
    print_report(report, str(output / DIRECTIONS), as_json=as_json, quiet=quiet)
