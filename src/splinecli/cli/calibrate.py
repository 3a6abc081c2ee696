"""`splinecli calibrate`: light directions from images of mirror balls, intensities from a gray target."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from splinecli.cli.console import Messages
from splinecli.cli.options import JsonOption, OverwriteOption, QuietOption
from splinecli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splinecli.calibration.balls import CalibratedLights
    from splinecli.calibration.circle import Circle

_T = TypeVar("_T")

DIRECTIONS, INTENSITIES = "light_directions.txt", "light_intensities.txt"
PICTURE, REPORT = "calibration.png", "calibration.json"
OWN_FILES = (DIRECTIONS, INTENSITIES, PICTURE, REPORT)

UNSURE_SEEN, UNSURE_SPREAD = 0.6, 0.01
"""An outline of which less is seen, or which spreads more (of the radius), is warned of."""

DISAGREEMENT_DEG = 5.0
MISTAKEN_DEG = 3.0


def calibrate(
    balls: Annotated[
        list[Path], typer.Argument(metavar="BALL", help="Folders of photographs of one mirror ball each.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="Folder of the results.")
    ] = Path("calibration"),
    circle: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,R", help="The ball's outline in pixels, y down; once for each BALL."),
    ] = None,
    mask: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Picture that is bright on the ball; once for each BALL."),
    ] = None,
    gray_ball: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Photographs of a matte ball under the same lights.")
    ] = None,
    gray_card: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Photographs of a matte card that faces the camera.")
    ] = None,
    transfer: Annotated[
        str,
        typer.Option(metavar="CURVE", help="Of the gray target's photographs: linear, srgb or gamma:G."),
    ] = "linear",
    compare: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Say how far the light directions in this text file are off."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Find the lights in photographs of mirror balls.

    A BALL is a folder with one photograph for each light, in the order of the lights. Its outline is given by --circle,
    or is that of a mask (--mask, or a file named mask in the folder), or is looked for in a picture named ref, or in
    the photographs. The lamp is the ball's brightest spot. Directions of several balls are averaged. Writes
    OUT/light_directions.txt, for the option --lights of infer, calibration.png, to look at, and calibration.json; with
    a gray ball or card also light_intensities.txt, the lights' intensities relative to each other.
    """
    from splinecli.calibration.balls import calibrate_ball, combine_balls, find_ball_files
    from splinecli.calibration.gray import measure_light_intensities
    from splinecli.capture.lights.light_files import read_light_directions
    from splinecli.capture.linearise import is_display_encoded
    from splinecli.files import check_free, write_bytes, write_text
    from splinecli.pictures.calibration import calibration_picture
    from splinecli.pictures.png import encode_png
    from splinecli.transfer import parse_transfer

    talk = Messages(quiet=quiet)
    gamma = parse_transfer(transfer)
    if gamma != 1 and not (gray_ball or gray_card):
        raise UsageError(
            "--transfer is of the photographs of --gray-ball or --gray-card; mirror balls need none"
        )
    if gray_ball and gray_card:
        raise UsageError("--gray-ball and --gray-card exclude each other")
    circles = _for_each("--circle", [_parse_circle(text) for text in circle or []], len(balls))
    masks = _for_each("--mask", mask or [], len(balls))
    check_free(output, OWN_FILES, overwrite=overwrite)
    target = gray_ball or gray_card
    gray_files = None if target is None else find_ball_files(target)
    files = [find_ball_files(folder, mask=own) for folder, own in zip(balls, masks, strict=True)]
    with talk.progress("calibrating", sum(len(ball.images) for ball in files)) as advance:
        calibrated = [
            calibrate_ball(ball, circle=own, progress=lambda: advance(1))
            for ball, own in zip(files, circles, strict=True)
        ]
    lights = combine_balls(calibrated)
    intensities = None
    if gray_files is not None:
        intensities = measure_light_intensities(
            gray_files, lights.directions, "ball" if gray_ball is not None else "card", gamma=gamma
        )
    known = None if compare is None else read_light_directions(compare, len(lights.directions))
    report = _report(lights, intensities, known)
    if (
        gamma == 1
        and gray_files is not None
        and any(is_display_encoded(image) for image in gray_files.images)
    ):
        report["warnings"].append(
            "The photographs of the gray target look display-encoded (JPEG, or PNG that says so) but are taken to be"
            " linear; --transfer srgb undoes sRGB's curve."
        )
    output.mkdir(parents=True, exist_ok=True)
    write_text(output / DIRECTIONS, _rows(lights.directions))
    if intensities is None:
        (output / INTENSITIES).unlink(missing_ok=True)  # of earlier lights
    else:
        write_text(output / INTENSITIES, _rows(intensities))
    write_bytes(output / PICTURE, encode_png(calibration_picture(lights.balls)))
    write_text(output / REPORT, json.dumps(report, indent=2) + "\n")
    for line in _told(report):
        talk.say(line)
    for warning in report["warnings"]:
        talk.warn(warning)
    if as_json:
        print(json.dumps(report, indent=2))
    elif not quiet:
        print(output / DIRECTIONS)


def _for_each(option: str, given: list[_T], n_balls: int) -> list[_T | None]:
    if given and len(given) != n_balls:
        raise UsageError(
            f"{option} is given {len(given)} times for {n_balls} balls; give it once for each, in order"
        )
    return [*given] if given else [None] * n_balls


def _parse_circle(text: str) -> Circle:
    from splinecli.calibration.circle import Circle

    try:
        x, y, radius = (float(word) for word in text.split(","))
        if radius > 0 and abs(x) + abs(y) + radius < float("inf"):
            return Circle(x, y, radius)
    except ValueError:
        pass
    raise UsageError(f"--circle is {text!r}; expected X,Y,R in pixels, such as 512,384,200")


def _rows(values: NDArray[np.float64]) -> str:
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in values)


def _report(
    lights: CalibratedLights, intensities: NDArray[np.float64] | None, known: NDArray[np.float64] | None
) -> dict[str, Any]:
    import numpy as np

    from splinecli.normals import angle_between_deg

    warnings = []
    for ball in lights.balls:
        outline = ball.circle
        if outline.visible < UNSURE_SEEN or outline.spread > UNSURE_SPREAD * outline.radius:
            warnings.append(
                f"{ball.files.folder}: the ball's outline is unsure ({100 * outline.visible:.0f} % of it seen, spread"
                f" {outline.spread:.1f} pixels): look at {PICTURE}; if the green circle is off, give --mask or"
                " --circle."
            )
    worst = int(lights.disagreement_deg.argmax())
    if lights.disagreement_deg[worst] > DISAGREEMENT_DEG:
        warnings.append(
            f"The balls disagree by up to {lights.disagreement_deg[worst]:.1f} degrees, most under light {worst + 1}:"
            f" look at {PICTURE}."
        )
    compared = None
    if known is not None:
        off = angle_between_deg(known, lights.directions)
        compared = {"mean_deg": _round(off.mean()), "largest_deg": _round(off.max())}
        from_normals = np.mean([angle_between_deg(known, ball.normals).mean() for ball in lights.balls])
        if off.mean() > MISTAKEN_DEG and from_normals < off.mean() / 3:
            warnings.append(
                "The compared light file holds the ball's normals at the highlights, not the lights: each of its"
                " directions lies half way between the view and the light. Use the file written here."
            )
    return {
        "n_lights": len(lights.directions),
        "balls": [
            {
                "folder": str(ball.files.folder),
                "circle": {
                    "x": _round(ball.circle.x), "y": _round(ball.circle.y), "radius": _round(ball.circle.radius),
                    "from": ball.circle_from, "seen": _round(ball.circle.visible), "spread": _round(ball.circle.spread),
                },
                "highlights": [[_round(mark.x), _round(mark.y)] for mark in ball.highlights],
                "saturated": [_round(mark.saturated) for mark in ball.highlights],
            }
            for ball in lights.balls
        ],
        "light_directions": [[_round(value, 6) for value in row] for row in lights.directions],
        "light_intensities": None
        if intensities is None
        else [[_round(value, 6) for value in row] for row in intensities],
        "disagreement_deg": None
        if len(lights.balls) == 1
        else {"mean": _round(lights.disagreement_deg.mean()), "largest": _round(lights.disagreement_deg.max())},
        "compared": compared,
        "warnings": warnings,
    }  # fmt: skip


def _round(value: float, digits: int = 3) -> float:
    return round(float(value), digits)


def _told(report: dict[str, Any]) -> list[str]:
    lines = []
    for ball in report["balls"]:
        circle = ball["circle"]
        lines.append(
            f"{ball['folder']}: circle {circle['x']:.1f}, {circle['y']:.1f}, radius {circle['radius']:.1f} pixels"
            f" (from {circle['from']}, {100 * circle['seen']:.0f} % of the outline,"
            f" spread {circle['spread']:.1f} pixels)"
        )
    if report["disagreement_deg"]:
        found = report["disagreement_deg"]
        lines.append(
            f"the balls differ from their mean by {found['mean']:.1f} degrees, at most {found['largest']:.1f}"
        )
    if report["compared"]:
        found = report["compared"]
        lines.append(
            f"the compared file is {found['mean_deg']:.1f} degrees off, at most {found['largest_deg']:.1f}"
        )
    return lines
