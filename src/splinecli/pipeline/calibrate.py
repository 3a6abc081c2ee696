"""Calibrate lights from images of balls and a gray target, and write light files and a report."""

import json
from typing import Any

from splinecli.capture.channel_lights import CROSSTALK
from splinecli.capture.light_files import read_light_directions, rows_text
from splinecli.capture.linearise import RadiometricCalibration
from splinecli.errors import InputError
from splinecli.lights.calibration.balls import (
    BallCalibration,
    BallFiles,
    CalibratedLights,
    NoHighlightError,
    calibrate_ball,
    combine_balls,
    find_ball_files,
)
from splinecli.lights.calibration.circle import Circle
from splinecli.lights.calibration.crosstalk import measure_crosstalk
from splinecli.lights.calibration.lamps import (
    Target,
    calibration_lines,
    calibration_report,
    measure_light_intensities,
    triangulate_lamps,
)
from splinecli.maths import Float64Array
from splinecli.maths.transfer import AUTOMATIC, parse_transfer
from splinecli.pictures.plots import calibration_picture
from splinecli.pipeline.options import CalibrateOptions
from splinecli.records.output_files import CALIBRATION
from splinecli.system.files import check_free
from splinecli.system.progress import SILENT, Observer, Progress
from splinecli.system.publishing import held_folder, new_files

DIRECTIONS, INTENSITIES = "light_directions.txt", "light_intensities.txt"
POSITIONS, PIXEL_SIZE, CAMERA_MATRIX = "light_positions.txt", "pixel_size.txt", "camera_matrix.txt"
PICTURE, REPORT = CALIBRATION, "calibration.json"
OUTPUT_FILES = (
    *(DIRECTIONS, INTENSITIES, CROSSTALK, POSITIONS, PIXEL_SIZE, CAMERA_MATRIX, PICTURE, REPORT),
)


def calibrate_lights(options: CalibrateOptions, observer: Observer = SILENT) -> dict[str, Any]:
    """Calibrate the lights, write OUTPUT_FILES and return the report.

    Raises InputError or OutputError.
    """
    with held_folder(options.output, observer.warn):
        check_free(options.output, OUTPUT_FILES, overwrite=options.overwrite)
        # Report a wrong path before all images are read.
        balls, target_files = _find_files(options, observer)
        known = None
        if options.compare is not None:
            known = read_light_directions(options.compare, len(balls[0].images))
        circles: list[Circle | None] = [Circle(*numbers) for numbers in options.circles]
        with observer.progress("calibrating", sum(len(ball.images) for ball in balls)) as advance:
            calibrated = [
                _calibrate(ball, circle, options, advance)
                for ball, circle in zip(balls, circles or [None] * len(balls), strict=True)
            ]
        lights = combine_balls(calibrated)
        intensities = crosstalk = None
        warnings: list[str] = []
        if target_files is not None:
            intensities, crosstalk, warnings = _measure_target(options, target_files, lights)
        lamps = triangulate_lamps(lights.balls, ball_diameter=options.ball_diameter)
        report = calibration_report(lights, intensities, known, picture=PICTURE, lamps=lamps)
        report["warnings"] += warnings
        report["crosstalk"] = None if crosstalk is None else crosstalk.round(6).tolist()
        texts = {DIRECTIONS: rows_text(lights.directions)}
        said = calibration_lines(report)
        if intensities is not None:
            texts[INTENSITIES] = rows_text(intensities)
            said.append(f"The light intensities were written to {options.output / INTENSITIES}")
        if crosstalk is not None:
            texts[CROSSTALK] = rows_text(crosstalk.reshape(-1, 3))
            place = options.output / CROSSTALK
            said.append(f"The crosstalk was written to {place} for infer --lights-in-channels")
        if lamps is not None and lamps.known:
            texts[POSITIONS] = rows_text(lamps.positions)
            texts[PIXEL_SIZE] = f"{lamps.pixel_size:.9g}\n"
            place = options.output / POSITIONS
            said.append(f"The lamp positions were written to {place} for infer --light-positions")
            if lamps.view.known:
                texts[CAMERA_MATRIX] = rows_text(lamps.view.matrix)
        # Earlier files that are not overwritten are removed, because they belong to other lights.
        with new_files(options.output, report=REPORT, stale=OUTPUT_FILES) as new:
            for name, text in texts.items():
                new.write(name, text)
            new.write(PICTURE, calibration_picture(lights.balls))
            new.write(REPORT, json.dumps(report, indent=2) + "\n")
        for line in said:
            observer.say(line)
        for warning in report["warnings"]:
            observer.warn(warning)
        return report


def _find_files(
    options: CalibrateOptions, observer: Observer
) -> tuple[list[BallFiles], BallFiles | None]:
    """Return the files of the balls, and of the gray target if there is one. Raises InputError."""
    target = options.gray_ball or options.gray_card
    target_files = None if target is None else find_ball_files(target)
    masks = options.masks or [None] * len(options.balls)
    balls = [find_ball_files(*pair) for pair in zip(options.balls, masks, strict=True)]
    for files in (*balls, *filter(None, [target_files])):
        for warning in files.warnings:
            observer.warn(f"{files.folder}: {warning}")
    return balls, target_files


def _calibrate(
    files: BallFiles, circle: Circle | None, options: CalibrateOptions, progress: Progress
) -> BallCalibration:
    """Return the lights of one ball.

    If a highlight is not found, or the outline may not belong to a ball, write the picture and
    raise InputError.
    """
    where, way_out = options.output / PICTURE, "and add --overwrite"
    other = f"Give the ball's circle with --circle X,Y,R, or a mask with --mask FILE, {way_out}"
    try:
        ball = calibrate_ball(files, circle, options.camera_matrix, progress)
        if ball.doubt is None:
            return ball
        outline = ball.circle
        refusal = InputError(
            f"the circle in the images (centre {outline.x:.0f}, {outline.y:.0f}, radius"
            f" {outline.radius:.0f} pixels) may not be the ball's edge: {ball.doubt}",
            files.folder,
            hint=f"{where} shows it. {other}",
        )
    except NoHighlightError as error:
        ball = error.ball
        hint = f"{where} shows the circle that was searched. {error.hint}, {way_out}"
        if ball.circle_from == "picture":
            hint += f". If the circle is wrong, {other[0].lower()}{other[1:]}"
        refusal = InputError(error.problem, error.path, hint=hint)
    with new_files(options.output, report=None) as new:
        new.write(PICTURE, calibration_picture([ball]))
    raise refusal


def _measure_target(
    options: CalibrateOptions, files: BallFiles, lights: CalibratedLights
) -> tuple[Float64Array | None, Float64Array | None, list[str]]:
    """Return the light intensities or the crosstalk from images of a gray target, and warnings."""
    radiometry, warnings = RadiometricCalibration(
        parse_transfer(options.transfer), automatic=options.transfer == AUTOMATIC
    ).with_stated_curve(files.facts)
    named = [f"{files.folder}: {warning}" for warning in warnings]
    directions = lights.directions
    if options.lights_in_channels:
        return None, measure_crosstalk(files, directions, radiometry=radiometry), named
    shape: Target = "card" if options.gray_ball is None else "ball"
    return measure_light_intensities(files, directions, shape, radiometry=radiometry), None, named
