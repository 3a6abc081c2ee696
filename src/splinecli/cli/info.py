"""`splinecli info`: what `infer` would read from a capture, and what to expect."""

from __future__ import annotations

from pathlib import Path

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import inputs, outputs
from splinecli.cli.options.values import FirstLight, LightForm
from splinecli.cli.records import record_from
from splinecli.errors import InputError
from splinecli.pipeline.info import InfoOptions, describe_capture, summary_lines
from splinecli.pipeline.reading import Reading


def info(
    capture: Path = inputs.CAPTURE,
    lights: Path | None = inputs.LIGHTS,
    first_light: FirstLight | None = inputs.FIRST_LIGHT,
    intensities: Path | None = inputs.INTENSITIES,
    light_positions: Path | None = inputs.LIGHT_POSITIONS,
    light_distance: float | None = inputs.LIGHT_DISTANCE,
    pixel_size: float | None = inputs.PIXEL_SIZE,
    object_width: float | None = inputs.OBJECT_WIDTH,
    camera_matrix: Path | None = inputs.LAMP_CAMERA_MATRIX,
    mask: Path | None = inputs.MASK,
    crop: str | None = inputs.CROP,
    scale: str | None = inputs.SCALE,
    ground_truth: Path | None = inputs.GROUND_TRUTH,
    transfer: str = inputs.TRANSFER,
    ambient: Path | None = inputs.AMBIENT,
    flat_field: Path | None = inputs.FLAT_FIELD,
    white_level: float | None = inputs.WHITE_LEVEL,
    light_frame: str | None = inputs.LIGHT_FRAME,
    lights_format: LightForm = inputs.LIGHTS_FORMAT,
    check_lights: bool = inputs.CHECK_LIGHTS,
    mended_lights: Path | None = outputs.MENDED_LIGHTS,
    plot: Path | None = outputs.LIGHT_PLOT,
    overwrite: bool = outputs.OVERWRITE_PLOT,
    strict: bool = outputs.STRICT,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> int:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the angles of the lights from the camera axis, and the memory and time that infer needs. Writes nothing
    but the plot and the mended lights.
    """
    given = locals()

    from splinecli.capture.capture_warnings import PROBABLY_WRONG

    options = record_from(InfoOptions, given, reading=record_from(Reading, given))
    messages = Messages(quiet=quiet)
    report = describe_capture(options, messages)
    print_report(report, *summary_lines(report), as_json=as_json, quiet=quiet)
    wrong = sorted(PROBABLY_WRONG.intersection(report["warning_codes"]))
    if strict and wrong:
        messages.error(f"{capture}: an input is probably wrong ({', '.join(wrong)}), as the warnings say.")
        return InputError.exit_code
    return 0
