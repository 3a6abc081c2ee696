"""`splinecli info`: what `infer` would read from a capture, and what to expect."""

from __future__ import annotations

from pathlib import Path

from splinecli.cli.console import Messages, print_report
from splinecli.cli.options import inputs, outputs
from splinecli.cli.options.values import LightForm, as_text
from splinecli.errors import InputError
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.info import InfoOptions, describe_capture, summary_lines


def info(
    capture: Path = inputs.CAPTURE,
    lights: Path | None = inputs.LIGHTS,
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
    plot: Path | None = outputs.LIGHT_PLOT,
    overwrite: bool = outputs.OVERWRITE_PLOT,
    strict: bool = outputs.STRICT,
    as_json: bool = outputs.JSON,
    quiet: bool = outputs.QUIET,
) -> int:
    """Show what `infer` would read from CAPTURE, without running it.

    Prints the layout and files of the capture, the size and bit depth of the images, their white level and exposure,
    the angles of the lights from the camera axis, and the memory and time that infer needs. Writes only the plot.
    """
    from splinecli.capture.capture_warnings import PROBABLY_WRONG

    reading = InferOptions(
        lights=as_text(lights),
        intensities=as_text(intensities),
        light_positions=as_text(light_positions),
        light_distance=light_distance,
        pixel_size=pixel_size,
        object_width=object_width,
        camera_matrix=as_text(camera_matrix),
        mask=as_text(mask),
        crop=crop,
        scale=scale,
        ground_truth=as_text(ground_truth),
        transfer=transfer,
        ambient=as_text(ambient),
        flat_field=as_text(flat_field),
        white_level=white_level,
        light_frame=light_frame,
        lights_format=lights_format.value,
        strict=strict,
    )
    options = InfoOptions(
        capture=capture, reading=reading, plot=plot, overwrite=overwrite, check_lights=check_lights
    )
    messages = Messages(quiet=quiet)
    report = describe_capture(options, messages)
    print_report(report, *summary_lines(report), as_json=as_json, quiet=quiet)
    wrong = sorted(PROBABLY_WRONG.intersection(report["warning_codes"]))
    if strict and wrong:
        messages.error(f"{capture}: an input is probably wrong ({', '.join(wrong)}), as the warnings say.")
        return InputError.exit_code
    return 0
