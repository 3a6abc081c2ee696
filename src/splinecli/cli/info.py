"""`splinecli info`: what `infer` would read from a capture, and what to expect."""

from pathlib import Path

from typer import Argument, Option

from splinecli.capture_warnings import PROBABLY_WRONG
from splinecli.cli import shared
from splinecli.cli.console import Messages, print_report
from splinecli.errors import InputError


def info(
    capture: Path = Argument(..., metavar="CAPTURE", help="Folder with the images of one object, or a film."),
    lights: Path | None = shared.LIGHTS,
    first_light: str | None = shared.FIRST_LIGHT,
    intensities: Path | None = shared.INTENSITIES,
    light_positions: Path | None = shared.LIGHT_POSITIONS,
    light_distance: float | None = shared.LIGHT_DISTANCE,
    pixel_size: float | None = Option(None, metavar="S", help=shared.PIXEL_SIZE),
    object_width: float | None = shared.OBJECT_WIDTH,
    camera_matrix: Path | None = shared.CAMERA_MATRIX,
    mask: Path | None = shared.MASK,
    crop: str | None = shared.CROP,
    scale: str | None = shared.SCALE,
    ground_truth: Path | None = shared.GROUND_TRUTH,
    transfer: str = shared.TRANSFER,
    ambient: Path | None = shared.AMBIENT,
    flat_field: Path | None = shared.FLAT_FIELD,
    white_level: float | None = shared.WHITE_LEVEL,
    light_frame: str | None = shared.LIGHT_FRAME,
    lights_format: shared.LightForm = shared.LIGHTS_FORMAT,
    check_lights: bool = Option(
        False, "--check-lights", help="List other readings of the light file, and how well the images fit each."
    ),
    mended_lights: Path | None = Option(
        None,
        metavar="FILE",
        help="Write the light directions in the order and frame that fit the images best, if the light file does not.",
    ),
    plot: Path | None = Option(None, metavar="FILE", help="Also plot the light directions to a PNG file."),
    overwrite: bool = Option(False, "--overwrite", help="Replace an earlier plot or file of lights."),
    strict: bool = shared.STRICT,
    as_json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> int:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the angles of the lights from the camera axis, and the memory and time that infer needs. Writes nothing
    but the plot and the mended lights.
    """
    given = locals()

    from splinecli.pipeline.infer_options import Reading
    from splinecli.pipeline.info import describe_capture, summary_lines

    messages = Messages(quiet=quiet)
    report = describe_capture(
        capture,
        shared.record_from(Reading, given),
        messages,
        plot=plot,
        overwrite=overwrite,
        check_lights=check_lights,
        mended_lights=mended_lights,
    )
    print_report(report, *summary_lines(report), as_json=as_json, quiet=quiet)
    wrong = sorted(PROBABLY_WRONG.intersection(report["warning_codes"]))
    if strict and wrong:
        messages.error(f"{capture}: an input is probably wrong ({', '.join(wrong)}), as the warnings say.")
        return InputError.exit_code
    return 0
